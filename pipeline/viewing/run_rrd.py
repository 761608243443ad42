"""A run as one .rrd file: maps, paths, images, rounds, network and numbers, with a layout."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.evaluation.network import Session
from duagc.pipeline.evaluation.paths import Path3, paths
from duagc.pipeline.evaluation.rendering import poses_by_stamp
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry import so3
from duagc.pipeline.geometry.masks import checkered
from duagc.pipeline.recording import Recording, open_rgbd
from duagc.pipeline.report import labels
from duagc.pipeline.report.figures import color_of
from duagc.pipeline.report.pictures import color_by
from duagc.pipeline.runs.folder import RobotRun, RunFolder, position_information
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import sigma_along
from duagc.pipeline.viewing.rrd_file import written

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION = "duagc"
TIME = "time"  # timeline of a run: time of the recording, then of the session
ROUND = "round"  # timeline of a run: rounds of the session
UNDETERMINED_GRAY = 0.75
LARGEST_LOG_SCALE = float(np.log(1e3))  # a kilometer: beyond it numbers overflow and the picture is the same


def write_rrd(run_dir: Path, recording: Path, out: Path, max_gaussians: int = 300_000) -> Path:
    """Write a run as one .rrd file with its own layout.

    Args:
        run_dir: folder of the run.
        recording: folder of its recording.
        out: the file; appears when it is complete.
        max_gaussians: of each map; a larger map is thinned to those that cover most of the image.

    Returns:
        `out`.
    """
    import rerun as rr

    run, source = RunFolder(run_dir), Recording(recording)
    stream = rr.RecordingStream(APPLICATION, recording_id=f"run-{source.name}")
    with written(stream, _blueprint(run), out):
        log_run(stream, run, source, max_gaussians)
    return out


def _world_of(run: RunFolder, component: Sequence[str]) -> str:
    """Entity that holds what the robots of one component share; robots of different components share no frame."""
    return (
        "world" if component == run.robots[run.largest_component[0]].component else f"world_of_{component[0]}"
    )


def log_run(stream: rr.RecordingStream, run: RunFolder, source: Recording, max_gaussians: int) -> None:
    """Log a run.

    Args:
        stream: gets it.
        run: finished but for its metrics.
        source: its recording.
        max_gaussians: of each map.
    """
    import rerun as rr

    names, session = list(run.robots), Session(run)
    for way in paths(run, source):
        world = _world_of(run, way.component)
        stream.log(
            world, rr.ViewCoordinates.RDF, static=True
        )  # a world is the first camera of its lowest robot
        _log_path(stream, f"{world}/paths/{way.robot}", way, names.index(way.robot))
    for i, (name, robot) in enumerate(run.robots.items()):
        world = _world_of(run, robot.component)
        _log_map(stream, f"{world}/maps/{name}", robot, max_gaussians)
        _log_keyframes(stream, f"{world}/cameras/{name}", robot, source=source, index=i)
    _log_rounds(stream, session)
    _log_network(stream, session)
    stream.log("summary", rr.TextDocument(_summary(run), media_type=rr.MediaType.MARKDOWN), static=True)


def _log_path(stream: rr.RecordingStream, entity: str, way: Path3, index: int) -> None:
    import rerun as rr

    color = color_of(index)
    parts = [("before_consensus", way.before, color + "66"), ("after_consensus", way.after, color + "ff")]
    if not isinstance(way.true, Absent):
        parts.append(("ground_truth", way.true, "#8899a6ff"))
    for name, trajectory, text in parts:
        strip = rr.LineStrips3D([trajectory.positions], colors=[rgba(text)], radii=rr.Radius.ui_points(1.5))
        stream.log(f"{entity}/{name}", strip, static=True)


def rgba(text: str) -> list[int]:
    """A color as four numbers.

    Args:
        text: "#" and eight hexadecimal digits.
    """
    return [int(text[i : i + 2], 16) for i in (1, 3, 5, 7)]


def thinned(gaussians: Gaussians, most: int) -> NDArray[np.int64]:
    """Indices, ascending, of at most `most` Gaussians: those of the greatest opacity times area; ties by position.

    Args:
        gaussians: of a map.
        most: largest number of Gaussians that stay.
    """
    if len(gaussians) <= most:
        return np.arange(len(gaussians))
    scales = np.sort(gaussians.log_scales.astype(np.float64), axis=1)
    cover = np.log(np.maximum(gaussians.opacities(), 1e-12)) + scales[:, 1] + scales[:, 2]
    return np.sort(np.argsort(-cover, kind="stable")[:most])


def _log_map(stream: rr.RecordingStream, entity: str, robot: RobotRun, max_gaussians: int) -> None:
    if robot.refined_map is not None:
        final = robot.refined_map.gaussians
        final = final.select(thinned(final, max_gaussians))
        stream.log(f"{entity}/final", splats(final, final.colors), static=True)
    fused = robot.fused_map
    chosen = thinned(fused.gaussians, max_gaussians)
    shown = fused.gaussians.select(chosen)
    stream.log(f"{entity}/fused", splats(shown, shown.colors), static=True)
    if fused.information is not None:
        F = position_information(fused.information.geometry)
        colors = sigma_colors(sigma_along(F, fused.gaussians.normals())[0])
        stream.log(f"{entity}/uncertainty", splats(shown, colors[chosen]), static=True)


def sigma_colors(sigma_m: Array) -> NDArray[np.float32]:
    """Colors [n, 3] on a logarithmic scale over the middle 90 % of the values, gray where infinite.

    Args:
        sigma_m: standard deviations [n].
    """
    known = np.isfinite(sigma_m)
    colors = np.full((len(sigma_m), 3), UNDETERMINED_GRAY, dtype=np.float32)
    if known.any():
        low, high = np.percentile(np.log10(sigma_m[known]), [5, 95])
        colors[known] = color_by(np.log10(sigma_m[known]), low, high, "plasma")
    return colors


def splats(gaussians: Gaussians, colors: NDArray[np.float32]) -> Any:
    """Gaussians as Rerun draws them: linear scales, xyzw quaternions, RGBA with the peak opacity.

    Args:
        gaussians: in the frame of their entity.
        colors: float32 [n, 3], 0..1.
    """
    import rerun as rr

    rgba = np.concatenate([np.clip(colors, 0.0, 1.0), gaussians.opacities()[:, None]], axis=1)
    quats = gaussians.quats_wxyz / np.linalg.norm(gaussians.quats_wxyz, axis=1, keepdims=True)
    return rr.GaussianSplats3D(
        gaussians.means,
        scales=np.exp(np.minimum(gaussians.log_scales, LARGEST_LOG_SCALE)),
        quaternions=quats[:, [1, 2, 3, 0]],
        colors=np.rint(rgba * 255.0).astype(np.uint8),
    )


def _log_keyframes(
    stream: rr.RecordingStream, entity: str, robot: RobotRun, *, source: Recording, index: int
) -> None:
    """The camera with its image and depth at every keyframe, where consensus puts it."""
    import rerun as rr

    poses = poses_by_stamp(robot.trajectory)
    with open_rgbd(source.log(robot.robot)) as log:
        log.move_depth_by(robot.folder / "frontend.mcap")
        pinhole = rr.Pinhole(
            image_from_camera=log.camera.matrix(),
            resolution=[log.camera.width, log.camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.25,
            color=rgba(color_of(index) + "ff"),
        )
        stream.log(entity, pinhole, static=True)
        for keyframe in robot.keyframes:
            T_world_camera = poses.get(keyframe.stamp_ns)
            if T_world_camera is None:
                continue
            frame = log.frame(keyframe.frame_index)
            stream.set_time(TIME, duration=np.timedelta64(frame.stamp_ns, "ns"))
            quat = so3.to_quat_wxyz(T_world_camera[:3, :3])
            stream.log(
                entity,
                rr.Transform3D(
                    translation=T_world_camera[:3, 3], quaternion=rr.Quaternion(xyzw=quat[[1, 2, 3, 0]])
                ),
            )
            shown = checkered(frame.color, frame.mask)
            stream.log(f"{entity}/image", rr.Image(shown).compress(jpeg_quality=85))
            millimeters = np.rint(np.minimum(frame.usable_depth, 65.0) * 1000.0).astype(np.uint16)
            stream.log(f"{entity}/depth", rr.DepthImage(millimeters, meter=1000.0))
    stream.reset_time()


def _log_rounds(stream: rr.RecordingStream, session: Session) -> None:
    """What happened in every round, on the timeline of rounds and, after the end of the logs, on that of time.

    Rerun has no logarithmic axis, so that changes and residuals are logged as their decimal logarithm.
    """
    import rerun as rr

    robots = list(session.run.robots)
    end_ns = max(int(robot.trajectory.stamps_ns[-1]) for robot in session.run.robots.values())
    for group, series in session.series_by_round().items():
        for i, (name, (rounds, values)) in enumerate(series.items()):
            color = rgba(color_of(robots.index(name) if name in robots else i) + "ff")
            if group != "bytes":
                keep = values > 0
                rounds, values = rounds[keep], np.log10(values[keep])
            entity = f"rounds/{group}/{name}"
            stream.log(entity, rr.SeriesLines(names=name, colors=[color]), static=True)
            times = np.asarray(end_ns + (rounds + 1) * session.period_ns, dtype="timedelta64[ns]")
            stream.send_columns(
                entity,
                indexes=[rr.TimeColumn(ROUND, sequence=rounds), rr.TimeColumn(TIME, duration=times)],
                columns=rr.Scalars.columns(scalars=values),
            )


def _log_network(stream: rr.RecordingStream, session: Session) -> None:
    """Who sent to whom."""
    import rerun as rr

    names = list(session.run.robots)
    stream.log(
        "network",
        rr.GraphNodes(names, labels=names, colors=[rgba(color_of(i) + "ff") for i in range(len(names))]),
        rr.GraphEdges([(link.sender, link.receiver) for link in session.links], graph_type="directed"),
        static=True,
    )


def _summary(run: RunFolder) -> str:
    """The headline of metrics.json as Markdown."""
    metrics = run.metrics
    if not metrics:
        return "The run was not evaluated."
    lines = ["| | | |", "|---|---|---|"]
    for section, table in (
        ("team", labels.TEAM),
        ("exchange", labels.EXCHANGE),
        ("consensus", labels.CONSENSUS),
    ):
        for row in labels.rows(metrics[section], table, metrics["reasons"], section):
            meaning = f"absent: {row['reason']}" if row["reason"] else row["meaning"]
            lines.append(f"| {row['label']} | **{row['value']}** | {meaning} |")
    return "\n".join(lines)


def _maps_shown(run: RunFolder) -> list[tuple[str, str, str]]:
    """Robot, kind and title of the maps that have a tab: the final ones of the largest component, then more of one."""
    first, members = run.largest_component[0], [n for n in run.largest_component if n in run.robots]
    final = [(name, "final", "final map") for name in members if run.robots[name].refined_map is not None]
    return [*final, (first, "fused", "fused map"), (first, "uncertainty", "σ along the normal")]


def _blueprint(run: RunFolder) -> rrb.Blueprint:
    """Maps with all paths, uncertainty of one, the images, the rounds, the network and the numbers."""
    import rerun.blueprint as rrb

    first = run.largest_component[0]
    world = _world_of(run, run.robots[first].component)
    scene = [f"/{world}/paths/**", f"/{world}/cameras/**"]
    scene += [f"- /{world}/cameras/{name}/depth" for name in run.robots]
    # a little above and behind the first camera of the world, where a room has no wall in the way
    eye = rrb.EyeControls3D(position=(0.0, -0.3, -0.8), look_target=(0.0, 0.1, 2.0), eye_up=(0.0, -1.0, 0.0))
    images = [
        rrb.Tabs(
            *(
                rrb.Spatial2DView(
                    origin=f"/{_world_of(run, robot.component)}/cameras/{name}",
                    contents=[f"$origin/{what}"],
                    name=f"{name}: {what}",
                )
                for what in ("image", "depth")
            )
        )
        for name, robot in run.robots.items()
    ]
    charts = [
        rrb.TimeSeriesView(origin=f"/rounds/{group}", name=title)
        for group, title in (
            ("change", "Largest change per round, log10 of m or rad"),
            ("bytes", "Bytes per round"),
        )
    ]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Tabs(
                    *(
                        rrb.Spatial3DView(
                            origin=f"/{world}",
                            contents=[*scene, f"/{world}/maps/{name}/{kind}"],
                            name=f"{name}: {title}",
                            eye_controls=eye,
                        )
                        for name, kind, title in _maps_shown(run)
                    )
                ),
                rrb.Vertical(*images),
                column_shares=[3, 1],
            ),
            rrb.Horizontal(
                *charts,
                rrb.GraphView(origin="/network", name="Network"),
                rrb.TextDocumentView(origin="/summary", name="Numbers"),
            ),
            row_shares=[2, 1],
        ),
        rrb.TimePanel(timeline=TIME, state="collapsed"),
        *closed_panels(),
    )


def closed_panels() -> list[Any]:
    import rerun.blueprint as rrb

    return [rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")]
