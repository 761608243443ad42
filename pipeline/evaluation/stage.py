"""Measure a finished run: metrics.json and metrics.parquet. docs/reference/metrics.md says what every number means."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from duagc.pipeline.base.component_names import robot_of, submap_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.worker_reports import OF_TEAM, Hear
from duagc.pipeline.evaluation import (
    cameras,
    coverage,
    depth_scales,
    groundtruth,
    map_errors,
    pixel_errors,
    trajectory_errors,
)
from duagc.pipeline.evaluation.map_agreement import MatchedViews
from duagc.pipeline.evaluation.network import Session
from duagc.pipeline.evaluation.rendering import (
    CENTRAL,
    MOST_VIEWS,
    rendering_sections,
)
from duagc.pipeline.evaluation.results import (
    Absent,
    Row,
    group_reasons,
    leaves,
    mean,
    split_reasons,
    write_json,
    write_parquet,
)
from duagc.pipeline.evaluation.robot_measures import RobotMeasures, RobotTask, measuring
from duagc.pipeline.evaluation.trajectory_errors import Paired, TeamError
from duagc.pipeline.evaluation.true_paths import TruePaths
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs.folder import METRICS_SCHEMA, RobotRun, RunFolder
from duagc.pipeline.splat.gaussians import Gaussians

PROTOCOL = {
    "alignment": "se3",
    "ate": "root mean square over all frames that have ground truth within 20 ms; robots: own alignment each",
    "team_ate": "one alignment for all robots of the largest component, pooled root mean square",
    "rpe": "root mean square from each frame to the next",
    "depth_agreement": "pairs of at most 40 held-out views that share 30 % under all poses compared; median of medians",
    "feature_agreement": "matched features of the same views, sifted by the images alone; median of medians",
    "initial_relative_poses": "unknown",
    "held_out": "index % 8 == 4",
    "training": "keyframes, a quarter as many",
    "team": "held-out and peers' views together, of robots that have peers",
    "common": "pixels that own, fused and refined all cover; else what a map does not cover is no part of "
    "its depth error and lowers its completeness",
    "peers": "held-out views of the other robots of the component, at their own poses; own map moved into the world",
    "poses": "own: odometry.tum in the robot's map frame; fused: trajectory.tum in the world frame",
    "exposure": "none; psnr_interpolated: between those that the robot found of the mapped frames before and after the "
    "view, the identity where it found none; psnr_exposure_*: gain and offset of each channel by robust least squares "
    "between render and image on one half of the view, scored on the other half alone",
    "colors": "those of the camera that took the view; at peers' views the map's, which are its own camera's, are put "
    "into them by the robot's own estimate from matched Gaussians (/<robot>/peer_colors)",
    "background": "black",
    "psnr": "render clamped to 0..1, mean over views, at most 100 dB",
    "ssim": "one scale, 11x11 Gaussian window of sigma 1.5, windows inside the image",
    "ms_ssim": "five scales, weights of Wang et al. 2003",
    "oracle": "same factors and final closure weights solved in one place, from the robots' answer downhill",
    "depth": "blended depth / alpha where alpha >= 0.5, of a Gaussian as its map says: that of its center or of its "
    "plane; mean over pixels with both depths, then over views",
    "own_unrefined": "the own map before its final refinement, seen as the own map",
    "own_longer": "if asked for, the own map trained again as the refined one was, alone; seen as the own map",
    "refined": "the final map: the fused one trained again on own images and peers' maps, seen as the fused map",
    "calibration": "distance of fused Gaussians from the true surface against sigma along its normal; mean of robots",
    "pixel_calibration": "rendered against exact depth, else against recorded depth, whose own noise then counts in "
    f"sigma; every {pixel_errors.EVERY_PX}th pixel of at most {pixel_errors.MOST_VIEWS} views; mean of robots",
}


def evaluate(
    run_dir: str | Path,
    recording: str | Path,
    *,
    threads: int = 2,
    workers: int = 1,
    progress: bool = True,
    own_longer: Mapping[str, Gaussians] | None = None,
    most_views: int = MOST_VIEWS,
    saved: str | Path | None = None,
    matched: Mapping[str, MatchedViews] | None = None,
    hear: Hear = lambda step: None,
) -> dict[str, Any]:
    """Measure a run against its recording and write metrics.json and metrics.parquet into its folder.

    Args:
        run_dir: folder of the run.
        recording: folder of its recording; its ground truth is optional.
        threads: views rendered at the same time; changes no bit of the result.
        workers: robots measured at the same time, in processes of their own if more than one; changes no bit either.
        progress: show it on standard error.
        own_longer: own maps trained as long as the final ones, by robot, to be scored too
            (`experiments.own_longer`).
        most_views: of a set that maps are scored at, evenly spread.
        saved: folder of the parts that are done, from which a process goes on that follows one that was killed;
            None: nothing is saved.
        matched: what is known already of the features of robots, by name (`robot_measures.matched_views_of`);
            changes no bit.
        hear: gets steps; changes nothing.

    Returns:
        The content of metrics.json.

    Raises:
        DuagError: the run or the recording is incomplete or they do not fit together.
    """
    run_dir, recording = Path(run_dir), Path(recording)
    saved = None if saved is None else Path(saved)
    run, source = RunFolder(run_dir), Recording(recording)
    unknown = sorted({robot_of(name) for name in run.robots} - set(source.robots))
    if unknown:
        raise DuagError(f"{recording}: has no robot {unknown[0]}, expected the robots of {run_dir}")
    truth, session = TruePaths.of(run, source), Session(run)
    longer, central, rows = own_longer or {}, dict[str, Gaussians](), list[Row]()
    if run.config.evaluation.central_map:
        from duagc.pipeline.evaluation.central_map import central_maps

        central = central_maps(run, source, threads)
    further = {
        name: {
            kind: maps[name] for kind, maps in (("own_longer", longer), (CENTRAL, central)) if name in maps
        }
        for name in run.robots
    }
    task = RobotTask(run_dir, recording, threads, progress, most_views, saved, matched=matched or {})
    with measuring(task, run, source, truth, workers=workers, further=further, hear=hear) as measures:
        of_team = {
            "team": _team_section(run, truth) | session.loop_closure_counts(),
            "coverage": coverage.of_robots(run),
            "components": coverage.of_components(run, truth.after),
            "exchange": session.exchange_section(),
            "consensus": session.consensus_section() | _matching_section(run, source, truth, session),
        }
        scales = depth_scales.depth_scales(run, source, session.loop_closures)
        of_robots = measures()
    hear((OF_TEAM, "team", 0, 1))
    rendering = rendering_sections(
        {name: m.scores for name, m in of_robots.items()}, longer=own_longer is not None
    )
    tree = {
        "schema": METRICS_SCHEMA,
        "robots": {
            name: _robot_section(robot, truth)
            | of_robots[name].agreement
            | {
                "camera": cameras.section(robot),
                "depth_scale": depth_scales.section(robot, scales),
                "rendering": rendering.robots[name],
            }
            for name, robot in run.robots.items()
        },
        "team": of_team["team"],
        "coverage": of_team["coverage"],
        "components": of_team["components"],
        "rendering": rendering.team,
        "calibration": _calibration_section(source, of_robots, rows),
        "pixel_calibration": _pixel_section(of_robots, rows),
        "exchange": of_team["exchange"],
        "consensus": of_team["consensus"],
        "protocol": PROTOCOL | {"views": f"at most {most_views} of a set, evenly spread"},
    }
    metrics, reasons = split_reasons(tree)
    metrics["reasons"] = group_reasons(reasons, run.robots)
    write_json(run_dir / "metrics.json", metrics)
    write_parquet(run_dir / "metrics.parquet", [*_rows_of(tree), *rendering.rows, *rows])
    return metrics


# --- trajectories ------------------------------------------------------------------------------------------------


def _robot_section(robot: RobotRun, truth: TruePaths) -> dict[str, Any]:
    after, before = truth.after[robot.robot], truth.before[robot.robot]
    section: dict[str, Any] = {
        "frames": len(robot.frames),
        "tracked": sum(frame.status != "lost" for frame in robot.frames),
        "keyframes": len(robot.keyframes),
        "gaussians": len(robot.own_map.gaussians),
        "gaussians_fused": len(robot.fused_map.gaussians),
        "stated_scale": _stated_scale(robot),
        "robots_in_component": len({robot_of(name) for name in robot.component}),
    }
    if isinstance(after, Absent) or isinstance(before, Absent):
        absent = after if isinstance(after, Absent) else before
        names = ("ate_rmse_m", "ate_rmse_m_before_consensus", "ate_rmse_m_keyframes", "ate_rmse_m_joint")
        return (
            section | dict.fromkeys((*names, "rpe_trans_m", "rpe_rot_rad"), absent) | {"frames_with_truth": 0}
        )
    log_stamps_ns = np.array([frame.stamp_ns for frame in robot.frames], dtype=np.int64)
    relative = trajectory_errors.rpe(after, log_stamps_ns)
    rpe_trans_m, rpe_rot_rad = (relative, relative) if isinstance(relative, Absent) else relative
    return section | {
        "ate_rmse_m": trajectory_errors.ate_rmse_m(after),
        "ate_rmse_m_before_consensus": trajectory_errors.ate_rmse_m(before),
        "ate_rmse_m_keyframes": _ate_of_keyframes(robot, after),
        "ate_rmse_m_joint": _joint_error(truth.team, robot.robot),
        "rpe_trans_m": rpe_trans_m,
        "rpe_rot_rad": rpe_rot_rad,
        "frames_with_truth": len(after),
    }


def _stated_scale(robot: RobotRun) -> float:
    """The factor on stated deviations of the fused map; 1 where it states none."""
    information = robot.fused_map.information
    return 1.0 if information is None else information.stated_scale


def _ate_of_keyframes(robot: RobotRun, pairs: Paired) -> float | Absent:
    """The ATE that many published tables give: keyframes only."""
    stamps = {keyframe.stamp_ns for keyframe in robot.keyframes}
    keep = np.array([stamp in stamps for stamp in pairs.stamps_ns.tolist()], dtype=bool)
    return trajectory_errors.ate_rmse_m(
        Paired(pairs.stamps_ns[keep], pairs.true[keep], pairs.estimated[keep])
    )


def _joint_error(team: TeamError | Absent, robot: str) -> float | Absent:
    if isinstance(team, Absent):
        return team
    return team.ate_rmse_m_of.get(robot, Absent(f"{robot} is not in the largest component"))


def _team_section(run: RunFolder, truth: TruePaths) -> dict[str, Any]:
    solo: list[float | Absent] = [
        p if isinstance(p, Absent) else trajectory_errors.ate_rmse_m(p)
        for name, p in truth.after.items()
        if submap_of(name) is None  # the largest component stands for its robot
    ]
    missing = [s for s in solo if isinstance(s, Absent)]
    return {
        "robots": len({robot_of(name) for name in run.robots}) + len(run.unmapped),
        "robots_in_largest_component": len({robot_of(name) for name in run.largest_component}),
        "ate_rmse_m": truth.team if isinstance(truth.team, Absent) else truth.team.ate_rmse_m,
        "ate_rmse_m_mean_of_robots": missing[0] if missing else mean(solo),
    }


# --- calibration -------------------------------------------------------------------------------------------------


def _calibration_section(
    source: Recording, robots: Mapping[str, RobotMeasures], rows: list[Row]
) -> dict[str, Any]:
    """Mean over robots of the calibration of their fused maps; the values of each robot go into rows."""
    surface = groundtruth.surface(source)
    if isinstance(surface, Absent):
        return dict.fromkeys(map_errors.NAMES, surface)
    of_robots = {name: robot.calibration for name, robot in robots.items()}
    for robot in robots.values():
        rows += robot.reliability
    for name, values in of_robots.items():
        rows += [Row("calibration", name, "", -1, key, value) for key, value in values.items()]
    return {
        key: _mean_or_sum(key, [values[key] for values in of_robots.values()]) for key in map_errors.NAMES
    }


def _pixel_section(robots: Mapping[str, RobotMeasures], rows: list[Row]) -> dict[str, Any]:
    """Mean over robots of the calibration of rendered depth; the values of each robot go into rows."""
    for name, robot in robots.items():
        rows += [
            Row("pixel_calibration", name, "/".join(path[:-1]), -1, path[-1], value)
            for path, value in leaves(robot.pixels)
        ]
    return pixel_errors.team_scores([robot.pixels for robot in robots.values()])


def _mean_or_sum(name: str, values: list[float | Absent]) -> float | Absent:
    """Counts add up over robots, scores average."""
    if name.startswith("gaussians"):
        counts = [v for v in values if not isinstance(v, Absent)]
        return int(math.fsum(counts)) if counts else values[0]
    return mean(values)


def _matching_section(
    run: RunFolder, source: Recording, truth: TruePaths, session: Session
) -> dict[str, float | Absent]:
    """Matches next to the true surface, if asked for."""
    if not run.config.evaluation.matching:
        return {}
    from duagc.pipeline.evaluation.matching_truth import matching_section

    return matching_section(run, source, truth, session.pairs)


# --- the long table ----------------------------------------------------------------------------------------------


def _rows_of(tree: Mapping[str, Any]) -> list[Row]:
    """The numbers of metrics.json as rows of the long table."""
    rows = []
    for path, value in leaves(tree):
        if isinstance(value, str) or path == ("schema",):
            continue
        scope, name = path[0].removesuffix("s") if path[0] == "robots" else path[0], path[-1]
        robot = path[1] if path[0] in ("robots", "coverage", "components") else ""
        of_maps = next((k for k, part in enumerate(path) if part in ("rendering", "pixel_calibration")), None)
        view_set = "" if of_maps is None else "/".join(path[of_maps + 1 : -1])
        rows.append(
            Row(scope, robot, view_set, -1, name, value if isinstance(value, Absent) else float(value))
        )
    return rows
