"""The report of a run: gathers figures, pictures and numbers, and fills the page."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import DuagError
from pipeline.evaluation.cameras import CHANNELS
from pipeline.evaluation.network import Session
from pipeline.evaluation.paths import Path3, paths, top_view_axes
from pipeline.evaluation.rendering import COMPARED_SETS, in_colors_of, in_world, mates, poses_by_stamp
from pipeline.evaluation.results import Absent
from pipeline.evaluation.views import score_view, surface_depth
from pipeline.fusion.stage import peer_colors
from pipeline.geometry import se3
from pipeline.messages import GaussianMap
from pipeline.recording import Recording, open_rgbd
from pipeline.report import figures, pictures, words
from pipeline.run_folder import RobotRun, RunFolder, position_information

if TYPE_CHECKING:
    from pipeline.kernels import Rasterizer, Render
    from pipeline.recording import RgbdFrame, RgbdLog

Array = NDArray[np.float64]
TEMPLATE = "page.html.j2"
PICTURE_WIDTH_PX = 400
VIEWS_PER_ROBOT = 2
COLOR_ERROR_END = 0.3
DEPTH_ERROR_END_M = 0.05
NO_EXACT = Absent("not needed for a picture")
UNDETERMINED_GREY = 0.75

SECTIONS = (
    ("paths", "Paths"),
    ("views", "Rendered views"),
    ("agreement", "Agreement"),
    ("exchange", "Exchange"),
    ("uncertainty", "Uncertainty"),
    ("time", "Time"),
    ("absent", "Absent values"),
    ("protocol", "Protocol and configuration"),
)


def write_report(run_dir: Path, recording: Path) -> Path:
    """Write report/index.html of an evaluated run: one file that needs no network.

    Args:
        run_dir: folder of the run, with metrics.json. recording: folder of its recording.
    Returns:
        The path of the page.
    Raises:
        DuagError: the run was not evaluated, or run and recording do not fit together.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    run, source = RunFolder(run_dir), Recording(recording)
    if not run.metrics:
        raise DuagError(
            f"{run_dir / 'metrics.json'}: not found, expected an evaluated run; `duagc evaluate` writes it"
        )
    environment = Environment(
        loader=PackageLoader("pipeline.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    html = environment.get_template(TEMPLATE).render(**content(run, source))
    path = run_dir / "report" / "index.html"
    path.parent.mkdir(exist_ok=True)
    partial = path.with_name(path.name + ".part")
    partial.write_text(html, encoding="utf-8")
    partial.replace(path)
    return path


def content(run: RunFolder, source: Recording) -> dict[str, Any]:
    """Everything that the template shows, by name."""
    metrics = run.metrics
    reasons = metrics["reasons"]
    session = Session(run)
    shown_views, information_views = _pictures(run, source)
    return {
        "title": f"{source.name}: {_count(len(run.robots), 'robot')}",
        "subtitle": _subtitle(metrics),
        "sections": SECTIONS,
        "cards": _cards(metrics, reasons),
        **_paths_content(run, source, metrics),
        "comparison_sets": [words.VIEW_SETS[s] for s in COMPARED_SETS],
        "comparison_columns": list(words.COMPARISON.values()),
        "comparison": words.comparison_rows(metrics),
        "rendering_columns": list(words.RENDERING.values()),
        "rendering": _rendering_rows(metrics),
        "own_longer": words.is_scored(metrics, "own_longer"),
        "exposure_note": " ".join(["No exposure is fitted to a view.", *_cameras(metrics)]),
        "views": shown_views,
        **_agreement_content(session, metrics, reasons),
        "exchange_charts": _exchange_charts(session),
        "exchange": words.rows(metrics["exchange"], words.EXCHANGE, reasons, "exchange"),
        "uncertainty_lead": _uncertainty_lead(run),
        "information_views": information_views,
        "reliability_chart": _reliability_chart(run),
        "calibration": words.rows(metrics["calibration"], words.CALIBRATION, reasons, "calibration"),
        **_timing_content(run),
        "absent": _absent(reasons),
        "protocol": list(metrics["protocol"].items()),
        "config": run.config_text or "The run has no config.toml.",
        "recording": json.dumps(source.description, indent=2),
    }


def _cameras(metrics: dict[str, Any]) -> list[str]:
    """How the robots' cameras differ, a sentence for each that was compared with the first of its component."""
    said = []
    for name, robot in metrics["robots"].items():
        camera = robot.get("camera", {})  # runs of earlier versions have none
        if camera.get("gain_red") is not None:
            gains = ", ".join(
                f"{camera[f'gain_{channel}']:.3f} ± {camera[f'sigma_gain_{channel}']:.3f}"
                for channel in CHANNELS
            )
            said.append(
                f"By the robots' own estimate {name}'s camera has {gains} times the red, green and blue of the first "
                "robot's; peers' views are compared in the colours of the camera that took them."
            )
    return said


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _subtitle(metrics: dict[str, Any]) -> str:
    team, robots = metrics["team"], metrics["robots"]
    frames = sum(robot["frames"] for robot in robots.values())
    agree = team["robots_in_largest_component"]
    shared = (
        "no two robots share a world" if agree < 2 else f"{agree} of {team['robots']} robots share one world"
    )
    return f"{words.text('frames', frames)} frames of {', '.join(robots)} · {shared} · relative poses {_known(metrics)}"


def _known(metrics: dict[str, Any]) -> str:
    return {"unknown": "unknown at the start", "given": "given at the start"}[
        metrics["protocol"]["initial_relative_poses"]
    ]


def _cards(metrics: dict[str, Any], reasons: dict[str, str]) -> list[dict[str, str]]:
    """The few numbers to look at first."""
    own = metrics["rendering"]["own"]
    final = "fused" if metrics["rendering"]["refined"]["held_out"]["psnr_db"] is None else "refined"

    def meaning(view_set: str, name: str, what: str) -> str:
        return f"{final} maps, {what}; own maps: {words.text(name, own[view_set][name])}"

    held_out, peers = f"rendering.{final}.held_out", f"rendering.{final}.peers"
    chosen = (
        ("team.ate_rmse_m", *words.TEAM["ate_rmse_m"]),
        ("team.ate_rmse_m_mean_of_robots", *words.TEAM["ate_rmse_m_mean_of_robots"]),
        (f"{held_out}.psnr_db", "PSNR", meaning("held_out", "psnr_db", "views never mapped")),
        (f"{peers}.psnr_db", "PSNR, peers' views", meaning("peers", "psnr_db", "where the others stood")),
        (
            f"{held_out}.depth_l1_common_m",
            "Depth L1",
            meaning("held_out", "depth_l1_common_m", "views never mapped, pixels that all maps cover"),
        ),
        ("team.inter_robot_closures", *words.TEAM["inter_robot_closures"]),
        ("exchange.bytes_sent", *words.EXCHANGE["bytes_sent"]),
        ("exchange.rounds", *words.EXCHANGE["rounds"]),
    )
    cards = []
    for path, label, what in chosen:
        value: Any = metrics
        for part in path.split("."):
            value = value[part]
        name = path.rsplit(".", 1)[1]
        cards.append(
            {
                "label": label,
                "value": words.text(name, value),
                "meaning": what,
                "reason": reasons.get(path, ""),
            }
        )
    return cards


# --- paths -------------------------------------------------------------------------------------------------------


def _paths_content(run: RunFolder, source: Recording, metrics: dict[str, Any]) -> dict[str, Any]:
    ways = paths(run, source)
    shown = [way for way in ways if way.component == run.robots[run.largest_component[0]].component]
    others = [way.robot for way in ways if way not in shown]
    lead = "Seen from above, in the world that the robots agreed on."
    if others:
        lead += f" Not in that world, so not shown: {', '.join(others)}."
    if any(isinstance(way.true, Absent) for way in shown):
        lead += (
            " The recording has no ground truth of the paths."
            if all(isinstance(way.true, Absent) for way in shown)
            else " Ground truth is missing for some robots."
        )
    columns = {
        name: word for name, word in words.ROBOT.items() if any(name in r for r in metrics["robots"].values())
    }
    return {
        "paths_lead": lead,
        "paths_chart": pictures.svg_uri(_top_view(shown, list(run.robots))),
        "robot_columns": list(columns.values()),
        "robots": [
            {
                "robot": name,
                "color": figures.color_of(i),
                "values": [words.text(column, metrics["robots"][name][column]) for column in columns],
            }
            for i, name in enumerate(run.robots)
        ],
    }


def _top_view(ways: Sequence[Path3], names: Sequence[str]) -> str:
    axes = top_view_axes(np.concatenate([way.after.poses for way in ways]))
    return figures.top_view(
        [
            {
                "robot": way.robot,
                "index": names.index(way.robot),
                "before": way.before.positions @ axes.T,
                "after": way.after.positions @ axes.T,
                "true": None if isinstance(way.true, Absent) else way.true.positions @ axes.T,
            }
            for way in ways
        ]
    )


# --- views -------------------------------------------------------------------------------------------------------


def _rendering_rows(metrics: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        {
            "map": word,
            "view_set": words.VIEW_SETS[view_set],
            "values": [
                words.text(name, metrics["rendering"][kind][view_set][name]) for name in words.RENDERING
            ],
        }
        for kind, word in words.MAPS.items()
        for view_set in words.VIEW_SETS
        if view_set in metrics["rendering"][kind] and words.is_scored(metrics, kind)
    ]


def _pictures(run: RunFolder, source: Recording) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Renders beside images, and the fused map coloured by its uncertainty, for a few held-out views per robot, and
    beside the image of a peer."""
    from pipeline.kernels import Rasterizer

    rasterizer = Rasterizer(threads=1)
    shown, colored = [], []
    for i, (name, robot) in enumerate(run.robots.items()):
        head = {"robot": name, "color": figures.color_of(i), "where": ""}
        final = _final(robot)
        with open_rgbd(source.log(name)) as log:
            chosen = _chosen_frames(robot, len(log))
            frames = [log.frame(index) for index in chosen]
            before, after = poses_by_stamp(robot.odometry), poses_by_stamp(robot.trajectory)
            for frame in frames:
                own = robot.own_map, before[frame.stamp_ns]
                maps = {"own": own, final[0]: (final[1], after[frame.stamp_ns])}
                shown.append(head | _view(maps, log, frame, rasterizer))
            if run.robots[name].fused_map.information is not None and frames:
                colored.append(head | _information_view(robot, log, frames, rasterizer))
        colors = peer_colors(robot.folder / "fused.mcap", name)
        for peer in mates(run, robot)[:1]:
            alike = colors.get(peer.robot)
            moved = replace(
                robot.own_map,
                gaussians=in_colors_of(alike, in_world(robot, "own", robot.own_map.gaussians)),
            )
            last = replace(final[1], gaussians=in_colors_of(alike, final[1].gaussians))
            with open_rgbd(source.log(peer.robot)) as log:
                for frame in [log.frame(index) for index in _chosen_frames(peer, len(log))[:1]]:
                    T = poses_by_stamp(peer.trajectory)[frame.stamp_ns]
                    maps = {"own": (moved, T), final[0]: (last, T)}
                    where = {"where": f" of {peer.robot}"}
                    shown.append(head | where | _view(maps, log, frame, rasterizer))
    return shown, colored


def _final(robot: RobotRun) -> tuple[str, GaussianMap]:
    """The map that a robot has in the end, and what it is called."""
    return ("fused", robot.fused_map) if robot.refined_map is None else ("refined", robot.refined_map)


def _chosen_frames(robot: RobotRun, frames: int) -> list[int]:
    """A few held-out frames with poses before and after consensus, evenly over the log."""
    before, after = poses_by_stamp(robot.odometry), poses_by_stamp(robot.trajectory)
    able = [
        f.frame_index
        for f in robot.frames
        if f.held_out and f.frame_index < frames and f.stamp_ns in before and f.stamp_ns in after
    ]
    places = [(2 * i + 1) * len(able) // (2 * VIEWS_PER_ROBOT) for i in range(VIEWS_PER_ROBOT)]
    return sorted({able[place] for place in places}) if able else []


def _view(
    maps: Mapping[str, tuple[GaussianMap, Array]], log: RgbdLog, frame: RgbdFrame, rasterizer: Rasterizer
) -> dict[str, Any]:
    """Image and renders of maps at poses, their depths, their errors."""
    renders = {
        kind: rasterizer.forward(shown.gaussians, log.camera, se3.inverse(T), depth=shown.depth)
        for kind, (shown, T) in maps.items()
    }
    measured = frame.depth > 0
    low, high = _range_m(frame.depth[measured])
    depths = {kind: surface_depth(render) for kind, render in renders.items()}

    def depth_picture(depth_m: NDArray[np.float32]) -> NDArray[np.uint8]:
        return pictures.colored(depth_m, low, high, depth_m > 0)

    def depth_error_picture(depth_m: NDArray[np.float32]) -> NDArray[np.uint8]:
        return pictures.colored(
            np.abs(depth_m - frame.depth), 0.0, DEPTH_ERROR_END_M, measured & (depth_m > 0), "magma"
        )

    def color_error_picture(render: Render) -> NDArray[np.uint8]:
        error = np.abs(np.clip(render.color, 0, 1) - frame.color / np.float32(255)).mean(axis=2)
        return pictures.colored(error, 0.0, COLOR_ERROR_END, np.ones(error.shape, dtype=bool), "magma")

    kinds = tuple(renders)
    columns = [
        ("image", frame.color),
        *((f"{kind} map", pictures.to_uint8(renders[kind].color)) for kind in kinds),
        ("recorded depth", depth_picture(frame.depth)),
        *((f"depth, {kind} map", depth_picture(depths[kind])) for kind in kinds),
        (f"colour error, {kinds[-1]} map", color_error_picture(renders[kinds[-1]])),
        *((f"depth error, {kind} map", depth_error_picture(depths[kind])) for kind in kinds),
    ]
    return {
        "frame_index": frame.index,
        "numbers": " · ".join(f"{kind}: {_view_numbers(render, frame)}" for kind, render in renders.items()),
        "pictures": [{"caption": caption, "uri": _uri(picture)} for caption, picture in columns],
        "scales": [
            _scale("viridis", f"{low:.2f} m", f"{high:.2f} m", "depth"),
            _scale("magma", "0", f"{1e3 * DEPTH_ERROR_END_M:.0f} mm and more", "depth error"),
            _scale("magma", "0", f"{COLOR_ERROR_END:g} of white and more", "colour error"),
        ],
    }


def _view_numbers(render: Render, frame: RgbdFrame) -> str:
    score = score_view(render, frame.color, frame.depth, NO_EXACT)
    depth = words.NONE if isinstance(score.depth_l1_m, Absent) else words.metres_text(score.depth_l1_m)
    return f"{score.psnr_db:.1f} dB, depth {depth}"


def _range_m(depths_m: NDArray[np.float32]) -> tuple[float, float]:
    """Near and far end of a depth scale: the middle 98 % of the values."""
    if not len(depths_m):
        return 0.0, 1.0
    low, high = np.percentile(depths_m, [1, 99])
    return float(low), float(max(high, low + 1e-3))


def _uri(picture: NDArray[np.uint8]) -> str:
    return pictures.jpeg_uri(picture, min(PICTURE_WIDTH_PX, picture.shape[1]))


def _scale(palette: str, low: str, high: str, what: str) -> dict[str, str]:
    return {"uri": pictures.scale_uri(palette), "low": low, "high": high, "what": what}


# --- agreement and exchange --------------------------------------------------------------------------------------


def _agreement_content(session: Session, metrics: dict[str, Any], reasons: dict[str, str]) -> dict[str, Any]:
    series = session.series_by_round()
    tolerance = session.run.config.get("exchange", {}).get("consensus", {}).get("tolerance")
    charts = [
        {
            "title": title,
            "uri": pictures.svg_uri(figures.lines(series[name], "round", "m or rad", log=True, level=level)),
        }
        for title, name, level in (
            ("Largest change of a pose in a round", "change", tolerance),
            ("Largest disagreement between neighbours (primal residual)", "primal", None),
        )
        if series[name]
    ]
    if metrics["team"]["robots_in_largest_component"] < 2:
        lead = "No two robots share a world, so there was nothing to agree on."
    elif metrics["consensus"]["converged"]:
        lead = "The robots adjusted the poses of their keyframes until nobody moved any more."
    else:
        lead = "The session ended before everybody had agreed: the results are those of its last round."
    return {
        "agreement_lead": lead,
        "agreement_charts": charts,
        "consensus": words.rows(metrics["consensus"], words.CONSENSUS, reasons, "consensus"),
        "closure_columns": ("Robots", "Keyframes", "Matches", "Agreeing", "Verdict", "Why", "Weight"),
        "closures": [
            (
                f"{c.robot} – {c.peer}",
                f"{c.own_keyframe} – {c.peer_keyframe}",
                c.matches,
                c.inliers,
                c.verdict,
                c.detail,
                "not used" if c.weight < 0 else f"{c.weight:.2f}",
            )
            for c in session.closures
        ],
    }


def _exchange_charts(session: Session) -> list[dict[str, str]]:
    """Bytes per round by purpose, and packets delivered and lost per link."""
    spent, links = session.series_by_round()["bytes"], session.links
    if not links:
        return []
    ticks = next(iter(spent.values()))[0]
    kilobytes = {purpose: values / 1e3 for purpose, (_, values) in spent.items()}
    names = [f"{link.sender} to {link.receiver}" for link in links]
    parts = {"delivered": [k.packets - k.dropped for k in links], "lost": [k.dropped for k in links]}
    return [
        {
            "title": "Bytes per round",
            "uri": pictures.svg_uri(figures.stacked(ticks, kilobytes, "round", "kB")),
        },
        {"title": "Packets per link", "uri": pictures.svg_uri(figures.bars(names, parts, "packets"))},
    ]


# --- uncertainty -------------------------------------------------------------------------------------------------


def position_sigma_m(geometry: NDArray[np.float32]) -> Array:
    """Standard deviation of every centre, metres [n]: sqrt trace F^-1; infinite where a direction is not determined."""
    F = position_information(geometry)
    values = np.linalg.eigvalsh(F) if len(F) else np.zeros((0, 3))
    determined = (values[:, 0] > 0) & (values[:, 2] < 1e12 * values[:, 0])
    sigma = np.full(len(F), np.inf)
    sigma[determined] = np.sqrt(np.sum(1.0 / values[determined], axis=1))
    return sigma


def sigma_colors(sigma_m: Array) -> tuple[NDArray[np.float32], float, float]:
    """Colours [n, 3] on a logarithmic scale over the middle 90 %, grey where infinite, and the ends of the scale."""
    known = np.isfinite(sigma_m)
    colors = np.full((len(sigma_m), 3), UNDETERMINED_GREY, dtype=np.float32)
    if not known.any():
        return colors, 1.0, 1.0
    low, high = np.percentile(np.log10(sigma_m[known]), [5, 95])
    colors[known] = pictures.color_by(np.log10(sigma_m[known]), low, high, "plasma")
    return colors, float(10.0**low), float(10.0**high)


def _information_view(
    robot: RobotRun, log: RgbdLog, frames: Iterable[RgbdFrame], rasterizer: Rasterizer
) -> dict[str, Any]:
    information = robot.fused_map.information
    assert information is not None
    colors, low_m, high_m = sigma_colors(position_sigma_m(information.geometry))
    gaussians = robot.fused_map.gaussians.replace(colors=colors)
    poses = poses_by_stamp(robot.trajectory)
    shown = []
    for frame in frames:
        render = rasterizer.forward(
            gaussians, log.camera, se3.inverse(poses[frame.stamp_ns]), background=(1.0, 1.0, 1.0)
        )
        shown.append({"caption": f"image, frame {frame.index}", "uri": _uri(frame.color)})
        shown.append({"caption": "uncertainty", "uri": _uri(pictures.to_uint8(render.color))})
    scale = _scale(
        "plasma",
        words.metres_text(low_m),
        words.metres_text(high_m),
        "standard deviation of a centre, log scale",
    )
    return {"pictures": shown, "scales": [scale]}


def _uncertainty_lead(run: RunFolder) -> str:
    kinds = {r.fused_map.information.kind for r in run.robots.values() if r.fused_map.information is not None}
    if not kinds:
        return "The fused maps carry no information about their Gaussians."
    return (
        "Fused maps coloured by the predicted standard deviation of each Gaussian's centre "
        f"({', '.join(sorted(kinds))} Fisher information, poses held "
        "fixed); grey where some direction is not determined by any view."
    )


def _reliability_chart(run: RunFolder) -> str:
    """Predicted against observed error per decile and robot, from metrics.parquet; empty if there is none."""
    path = run.path / "metrics.parquet"
    if not path.is_file():
        return ""
    import pyarrow.parquet as pq

    bins: dict[str, dict[str, dict[str, float]]] = {}
    for row in pq.read_table(path, filters=[("scope", "==", "reliability")]).to_pylist():
        bins.setdefault(row["robot"], {}).setdefault(row["view_set"], {})[row["name"]] = row["value"]
    if not bins:
        return ""
    curves = {
        robot: [(decile["predicted_rms_m"], decile["observed_rms_m"]) for decile in deciles.values()]
        for robot, deciles in bins.items()
    }
    return pictures.svg_uri(figures.reliability(curves))


# --- time and the rest -------------------------------------------------------------------------------------------


def _timing_content(run: RunFolder) -> dict[str, Any]:
    stages = run.timing
    rows = [
        {
            "stage": entry.get("stage", key),
            "robot": entry.get("robot") or "all",
            "wall": f"{entry['wall_s']:.1f} s",
            "cpu": f"{entry['cpu_s']:.1f} s",
            "memory": f"{entry['peak_rss_mb']:.0f} MB",
        }
        for key, entry in stages.items()
    ]
    names = [f"{row['stage']}, {row['robot']}" if row["robot"] != "all" else row["stage"] for row in rows]
    chart = figures.bars(names, {"wall": [entry["wall_s"] for entry in stages.values()]}, "seconds")
    return {"timing": rows, "timing_chart": pictures.svg_uri(chart)}


def _absent(reasons: dict[str, str]) -> list[tuple[str, str]]:
    """(reason, the values that it explains), in order of the values."""
    by_reason: dict[str, list[str]] = {}
    for path, reason in reasons.items():
        by_reason.setdefault(reason, []).append(path)
    return [(reason, ", ".join(names)) for reason, names in by_reason.items()]
