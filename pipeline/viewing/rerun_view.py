"""Runs and recordings in Rerun. The only module that imports it; what it writes is no part of a digest.

A run is logged piece by piece (`write_rrd`). A recording opens in Rerun as it is; `recording_to_rrd` adds what the
viewer does not derive by itself: depth images with their unit, and names of frames that hang together.
"""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import new_file
from duagc.pipeline.evaluation.network import Session
from duagc.pipeline.evaluation.paths import Path3, paths
from duagc.pipeline.evaluation.rendering import poses_by_stamp
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry import so3
from duagc.pipeline.messages import camera_frame
from duagc.pipeline.recording import RECORDING_FILE, Recording, open_rgbd
from duagc.pipeline.report import labels
from duagc.pipeline.report.figures import color_of
from duagc.pipeline.report.renders import position_sigma_m, sigma_colors
from duagc.pipeline.runs.folder import RobotRun, RunFolder
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.schemas import topics

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION = "duagc"
TIME, ROUND = (
    "time",
    "round",
)  # timelines of a run: time of the recording, then of the session; rounds of the session
LOG_TIME = "message_log_time"  # timeline that Rerun gives to a log
VIEWER_MEMORY = "4GiB"
LARGEST_LOG_SCALE = float(np.log(1e3))  # a kilometer: beyond it numbers overflow and the picture is the same


def view(path: Path, save: Path | None = None, screenshot: Path | None = None) -> None:
    """Open a run, a recording or a log in Rerun, or write it to a .rrd file or a picture.

    Args:
        path: folder of a run or of a recording, or an .mcap or .rrd file.
        save: write this .rrd file instead of opening a window. screenshot: write this PNG instead.
    Raises:
        DuagError: the path is none of these, or no picture can be drawn on this machine.
    """
    with tempfile.TemporaryDirectory(prefix="duagc-view-") as folder:
        rrd = _as_rrd(Path(path), Path(folder))
        if save is not None:
            with new_file(save) as part:
                shutil.copyfile(rrd, part)
        if screenshot is not None:
            take_screenshot(rrd, screenshot)
        if save is None and screenshot is None:
            _open_window(rrd)


def _as_rrd(path: Path, folder: Path) -> Path:
    if path.suffix == ".rrd" and path.is_file():
        return path
    out = folder / f"{path.name or 'view'}.rrd"
    if (path / "robots").is_dir():
        made = path / "run.rrd"
        if made.is_file():
            return made
        return write_rrd(path, RunFolder(path).recording, out)
    if (path / RECORDING_FILE).is_file():
        recording = Recording(path)
        return recording_to_rrd([recording.log(robot) for robot in recording.robots], out)
    if path.suffix == ".mcap" and path.is_file():
        return recording_to_rrd([path], out)
    raise DuagError(
        f"{path}: expected a run (robots/), a recording ({RECORDING_FILE}), an .mcap or an .rrd file"
    )


# --- a run -------------------------------------------------------------------------------------------------------


def write_rrd(run_dir: Path, recording: Path, out: Path, max_gaussians: int = 300_000) -> Path:
    """Write a run as one .rrd file with its own layout.

    Args:
        run_dir: folder of the run. recording: folder of its recording. out: the file; appears when it is complete.
        max_gaussians: of each map; a larger map is thinned to those that cover most of the image.
    Returns:
        `out`.
    """
    import rerun as rr

    run, source = RunFolder(run_dir), Recording(recording)
    stream = rr.RecordingStream(APPLICATION, recording_id=f"run-{source.name}")
    with new_file(out) as part:
        stream.save(part, default_blueprint=_blueprint(run))
        _log_run(stream, run, source, max_gaussians)
        stream.flush()
        stream.disconnect()
    return out


def _world_of(run: RunFolder, component: Sequence[str]) -> str:
    """Entity that holds what the robots of one component share; robots of different components share no frame."""
    return (
        "world" if component == run.robots[run.largest_component[0]].component else f"world_of_{component[0]}"
    )


def _log_run(stream: rr.RecordingStream, run: RunFolder, source: Recording, max_gaussians: int) -> None:
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
        _log_keyframes(stream, f"{world}/cameras/{name}", robot, source, i)
    _log_rounds(stream, session)
    _log_network(stream, session)
    stream.log("summary", rr.TextDocument(_summary(run), media_type=rr.MediaType.MARKDOWN), static=True)


def _log_path(stream: rr.RecordingStream, entity: str, way: Path3, index: int) -> None:
    import rerun as rr

    color = color_of(index)
    parts = [("before_consensus", way.before, color + "66"), ("after_consensus", way.after, color + "ff")]
    if not isinstance(way.true, Absent):
        parts.append(("ground_truth", way.true, "#8899a6ff"))
    for name, trajectory, rgba in parts:
        strip = rr.LineStrips3D([trajectory.positions], colors=[_rgba(rgba)], radii=rr.Radius.ui_points(1.5))
        stream.log(f"{entity}/{name}", strip, static=True)


def _rgba(text: str) -> list[int]:
    return [int(text[i : i + 2], 16) for i in (1, 3, 5, 7)]


def thinned(gaussians: Gaussians, most: int) -> NDArray[np.int64]:
    """Indices, ascending, of at most `most` Gaussians: those of the greatest opacity times area; ties by position."""
    if len(gaussians) <= most:
        return np.arange(len(gaussians))
    scales = np.sort(gaussians.log_scales.astype(np.float64), axis=1)
    opacity = 1.0 / (1.0 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    cover = np.log(np.maximum(opacity, 1e-12)) + scales[:, 1] + scales[:, 2]
    return np.sort(np.argsort(-cover, kind="stable")[:most])


def _log_map(stream: rr.RecordingStream, entity: str, robot: RobotRun, max_gaussians: int) -> None:
    fused = robot.fused_map
    chosen = thinned(fused.gaussians, max_gaussians)
    shown = fused.gaussians.select(chosen)
    stream.log(f"{entity}/fused", _splats(shown, shown.colors), static=True)
    if fused.information is not None:
        colors, _, _ = sigma_colors(position_sigma_m(fused.information.geometry))
        stream.log(f"{entity}/uncertainty", _splats(shown, colors[chosen]), static=True)


def _splats(gaussians: Gaussians, colors: NDArray[np.float32]) -> Any:
    """Gaussians as Rerun draws them: linear scales, xyzw quaternions, RGBA with the peak opacity."""
    import rerun as rr

    opacity = 1.0 / (1.0 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    rgba = np.concatenate([np.clip(colors, 0.0, 1.0), opacity[:, None]], axis=1)
    quats = gaussians.quats_wxyz / np.linalg.norm(gaussians.quats_wxyz, axis=1, keepdims=True)
    return rr.GaussianSplats3D(
        gaussians.means,
        scales=np.exp(np.minimum(gaussians.log_scales, LARGEST_LOG_SCALE)),
        quaternions=quats[:, [1, 2, 3, 0]],
        colors=np.rint(rgba * 255.0).astype(np.uint8),
    )


def _log_keyframes(
    stream: rr.RecordingStream, entity: str, robot: RobotRun, source: Recording, index: int
) -> None:
    """The camera with its image and depth at every keyframe, where consensus puts it."""
    import rerun as rr

    poses = poses_by_stamp(robot.trajectory)
    with open_rgbd(source.log(robot.robot)) as log:
        pinhole = rr.Pinhole(
            image_from_camera=log.camera.matrix(),
            resolution=[log.camera.width, log.camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.25,
            color=_rgba(color_of(index) + "ff"),
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
            stream.log(f"{entity}/image", rr.Image(frame.color).compress(jpeg_quality=85))
            millimeters = np.rint(np.minimum(frame.depth, 65.0) * 1000.0).astype(np.uint16)
            stream.log(f"{entity}/depth", rr.DepthImage(millimeters, meter=1000.0))
    stream.reset_time()


def _log_rounds(stream: rr.RecordingStream, session: Session) -> None:
    """What happened in every round, on the timeline of rounds and, after the end of the logs, on that of time.

    Rerun has no logarithmic axis, so that changes and residuals are logged as their decimal logarithm.
    """
    import rerun as rr

    end_ns = max(int(robot.trajectory.stamps_ns[-1]) for robot in session.run.robots.values())
    for group, series in session.series_by_round().items():
        for name, (rounds, values) in series.items():
            if group != "bytes":
                keep = values > 0
                rounds, values = rounds[keep], np.log10(values[keep])
            entity = f"rounds/{group}/{name}"
            stream.log(entity, rr.SeriesLines(names=name), static=True)
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
        rr.GraphNodes(names, labels=names, colors=[_rgba(color_of(i) + "ff") for i in range(len(names))]),
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


def _blueprint(run: RunFolder) -> rrb.Blueprint:
    """One robot's map with all paths, its uncertainty, the images, the rounds, the network and the numbers."""
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
                            contents=[*scene, f"/{world}/maps/{first}/{coloring}"],
                            name=name,
                            eye_controls=eye,
                        )
                        for coloring, name in (("fused", "Fused map"), ("uncertainty", "Uncertainty"))
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
        *_closed_panels(),
    )


def _closed_panels() -> list[Any]:
    import rerun.blueprint as rrb

    return [rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")]


# --- a recording -------------------------------------------------------------------------------------------------


def recording_to_rrd(logs: Sequence[Path], out: Path) -> Path:
    """Write logs as one .rrd file: what Rerun reads from MCAP by itself, and depth as depth images with their unit.

    Rerun takes a depth image of Foxglove's schema for a gray image. Here its bytes become a depth image beside it.
    """
    import rerun as rr
    from rerun.chunk import Chunk, DeriveLens, LazyChunkStream, McapReader

    lenses = [
        DeriveLens("Image:buffer").to_component(rr.DepthImage.descriptor_buffer(), "."),
        DeriveLens("Image:format").to_component(rr.DepthImage.descriptor_format(), "."),
    ]
    streams, robots = [], []
    for path in logs:
        with open_rgbd(path) as log:
            robots.append(log.robot)
            topic, units_per_meter = topics.DEPTH.of(log.robot), 1.0 / log.depth_scale
        depth, rest = McapReader(path).stream().split(content=topic)
        meter = Chunk.from_columns(topic, indexes=[], columns=rr.DepthImage.columns(meter=[units_per_meter]))
        streams += [
            depth.lenses(lenses, output_mode="forward_unmatched"),
            rest,
            LazyChunkStream.from_iter([meter]),
        ]
    recording = rr.RecordingStream(APPLICATION, recording_id=f"recording-{out.stem}")
    with new_file(out) as part:
        recording.save(part, default_blueprint=_recording_blueprint(robots))
        recording.send_chunks(LazyChunkStream.merge(*streams))
        recording.flush()
        recording.disconnect()
    return out


def _recording_blueprint(robots: Sequence[str]) -> rrb.Blueprint:
    """Color, depth and points of every robot; the views name the frames of the log, which no entity path tells."""
    import rerun as rr
    import rerun.blueprint as rrb

    rows = []
    for robot in robots:
        frame = camera_frame(robot)
        color, depth = topics.COLOR.of(robot), topics.DEPTH.of(robot)
        image_plane = rrb.SpatialInformation(target_frame=f"{frame}_image_plane")
        rows.append(
            rrb.Horizontal(
                rrb.Spatial2DView(
                    origin=color, contents=[color], name=f"{robot}: color", spatial_information=image_plane
                ),
                rrb.Spatial2DView(
                    origin=depth, contents=[depth], name=f"{robot}: depth", spatial_information=image_plane
                ),
                rrb.Spatial3DView(
                    origin=f"/{robot}",
                    contents=[color, depth, topics.CALIBRATION.of(robot)],
                    name=f"{robot}: points",
                    spatial_information=rrb.SpatialInformation(
                        target_frame=frame, axes=rr.ViewCoordinates.RDF, show_axes=True
                    ),
                ),
            )
        )
    return rrb.Blueprint(
        rrb.Vertical(*rows), rrb.TimePanel(timeline=LOG_TIME, state="collapsed"), *_closed_panels()
    )


# --- windows and pictures ----------------------------------------------------------------------------------------


def _open_window(rrd: Path) -> None:
    """Open a file in a Rerun window and wait until it is closed; the viewer listens on this machine only.

    Raises:
        DuagError: there is no viewer, or it could not open a window.
    """
    command = [
        _executable(),
        "--bind",
        "127.0.0.1",
        "--port",
        str(_free_port()),
        "--memory-limit",
        VIEWER_MEMORY,
    ]
    done = subprocess.run([*command, str(rrd)], check=False, stderr=subprocess.PIPE, text=True)
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        raise DuagError(
            f"{rrd.name}: the viewer ended with {done.returncode} ({lines[-1] if lines else 'no word'}); "
            "on a machine without a display use --save or --screenshot"
        )


def take_screenshot(rrd: Path, png: Path, timeout_s: float = 60.0) -> None:
    """Draw a file without a window and save the picture; a software renderer (Mesa lavapipe) is enough.

    Raises:
        DuagError: there is no graphics driver, or the viewer has not shown the data in time.
    """
    from rerun.experimental import ViewerClient

    executable = _executable()
    try:
        with ViewerClient.spawn(
            headless=True, port=_free_port(), memory_limit=VIEWER_MEMORY, executable_path=executable
        ) as viewer:
            viewer.open(str(rrd))
            data = _settled_picture(viewer, timeout_s)
    except Exception as error:  # the client raises RuntimeError and its own kinds, with the viewer's words
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise DuagError(
            f"{png}: the viewer drew no picture ({first}); it needs a graphics driver, "
            "for example the package mesa-vulkan-drivers"
        ) from error
    with new_file(png) as part:
        part.write_bytes(data)


def _settled_picture(viewer: Any, timeout_s: float) -> bytes:
    """The picture once it does not change any more: what is on disk is drawn piece by piece."""
    end, last = time.monotonic() + timeout_s, b""
    while time.monotonic() < end:
        data = viewer.take_screenshot()
        if data == last:
            return data
        last = data
        time.sleep(1.5)
    return last


def _executable() -> str:
    """The viewer that was installed with this Python, else the one in PATH. Raises DuagError if there is none."""
    beside = Path(sys.executable).with_name("rerun")
    found = str(beside) if beside.is_file() else shutil.which("rerun")
    if found is None:
        raise DuagError(
            "rerun: no viewer beside this Python or in PATH, expected that of the package rerun-sdk"
        )
    return found


def _free_port() -> int:
    """A port of this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
