"""The pictures of a report: maps rendered next to the images of some views; predicted and found errors of depth."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import determinism
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.workers import worker_pool
from duagc.pipeline.evaluation.groundtruth import exact_depths, recorded_depth_is_exact
from duagc.pipeline.evaluation.pixel_deviation import StatedMap, rendered_depth, stated_in_world
from duagc.pipeline.evaluation.pixel_errors import true_depth
from duagc.pipeline.evaluation.rendering import in_colors_of, in_world, mates, poses_by_stamp
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.views import ComparedImage, ScoredFrame, in_exposure, score_view, surface_depth
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.depth_noise import DepthNoise
from duagc.pipeline.geometry.exposure import Exposure
from duagc.pipeline.geometry.masks import checkered
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.messages import GaussianMap
from duagc.pipeline.recording import Recording, open_rgbd
from duagc.pipeline.report import figures, labels, pictures
from duagc.pipeline.runs.folder import RobotRun, RunFolder
from duagc.pipeline.runs.peer_colors import read_peer_colors
from duagc.pipeline.runs.stages import REPORT

if TYPE_CHECKING:
    from duagc.pipeline.kernels import Rasterizer, Render
    from duagc.pipeline.recording import RgbdFrame, RgbdLog

PICTURE_WIDTH_PX = 400
VIEWS_PER_ROBOT = 2
COLOR_ERROR_END = 0.3
DEPTH_ERROR_END_M = 0.05
NO_EXACT = Absent("not needed for a picture")


Views = list[dict[str, Any]]


def rendered_views(run: RunFolder, source: Recording, workers: int = 1) -> tuple[Views, Views]:
    """Renders next to images for a few held-out views per robot and one of a peer, and predicted deviations of depth.

    Args:
        run: the run.
        source: its recording.
        workers: robots drawn at the same time, in processes of their own if more than one; changes no bit.
    """
    numbered = list(enumerate(run.robots))
    if min(workers, len(numbered)) == 1:
        drawn = [_views_of(run, source, name, number) for number, name in numbered]
    else:
        with worker_pool(min(workers, len(numbered))) as pool:
            begun = [
                pool.submit(_views_in_worker, run.path, source.path, name, number)
                for number, name in numbered
            ]
            drawn = [result.result() for result in begun]
    return [view for shown, _ in drawn for view in shown], [
        view for _, predicted in drawn for view in predicted
    ]


def _views_in_worker(run: Path, recording: Path, name: str, number: int) -> tuple[Views, Views]:
    determinism.configure_opencv()
    with REPORT.running(run):
        return _views_of(RunFolder(run), Recording(recording), name, number)


def _views_of(run: RunFolder, source: Recording, name: str, number: int) -> tuple[Views, Views]:
    """Of one robot."""
    from duagc.pipeline.kernels import Rasterizer

    rasterizer = Rasterizer(threads=1)
    shown, deviations, robot = Views(), Views(), run.robots[name]
    head = {"robot": name, "color": figures.color_of(number), "where": ""}
    with open_rgbd(source.log(name)) as log:
        log.move_depth_by(robot.folder / "frontend.mcap")
        frames = [log.frame(index) for index in _chosen_frames(robot, len(log))]
        shown += [head | view for view in _own_views(robot, log, frames, rasterizer)]
        if frames:
            kind, final = _final(robot)
            predicted = _deviation_view(
                stated_in_world(robot, final),
                robot.trajectory,
                log,
                _compared(frames, source, name),
                kind=kind,
                noise=DepthNoise.stated(run.config.information),
                rasterizer=rasterizer,
            )
            deviations.append(head | predicted)
    for peer in mates(run, robot)[:1]:
        with open_rgbd(source.log(peer.robot)) as log:
            log.move_depth_by(peer.folder / "frontend.mcap")
            views = _peer_views(robot, peer, log, rasterizer)
            shown += [head | {"where": f" of {peer.robot}"} | view for view in views]
    return shown, deviations


def _compared(frames: Sequence[RgbdFrame], source: Recording, robot: str) -> list[ScoredFrame]:
    """Frames with their exact depth, where there is some; the others' renders are compared with recorded depth."""
    if recorded_depth_is_exact(source, robot):
        return [ScoredFrame(frame, frame.depth) for frame in frames]
    exact = exact_depths(source, robot, {frame.stamp_ns for frame in frames})
    known = {} if isinstance(exact, Absent) else exact
    return [ScoredFrame(frame, known.get(frame.stamp_ns, NO_EXACT)) for frame in frames]


def _own_views(
    robot: RobotRun, log: RgbdLog, frames: Iterable[RgbdFrame], rasterizer: Rasterizer
) -> Iterator[dict[str, Any]]:
    """The robot's maps, each at its own pose of the robot's frames."""
    before, after = poses_by_stamp(robot.odometry), poses_by_stamp(robot.trajectory)
    kind, final = _final(robot)
    for frame in frames:
        maps = {"own": (robot.own_map, before[frame.stamp_ns]), kind: (final, after[frame.stamp_ns])}
        yield _view(maps, log, frame, rasterizer, exposure=robot.exposures.at(frame.index))


def _peer_views(
    robot: RobotRun, peer: RobotRun, log: RgbdLog, rasterizer: Rasterizer
) -> Iterator[dict[str, Any]]:
    """The robot's maps at a frame of a peer, in the colors of the peer's camera."""
    alike = read_peer_colors(robot.folder / "fused.mcap", robot.robot).get(peer.robot)
    poses = poses_by_stamp(peer.trajectory)
    kind, final = _final(robot)
    own = in_world(robot, "own", robot.own_map.gaussians)
    moved = replace(robot.own_map, gaussians=in_colors_of(alike, own))
    last = replace(final, gaussians=in_colors_of(alike, final.gaussians))
    for index in _chosen_frames(peer, len(log))[:1]:
        frame = log.frame(index)
        T = poses[frame.stamp_ns]
        exposure = peer.exposures.at(index)
        yield _view({"own": (moved, T), kind: (last, T)}, log, frame, rasterizer, exposure=exposure)


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
    return sorted({able[k] for k in evenly_spaced(len(able), VIEWS_PER_ROBOT)}) if able else []


def _view(
    maps: Mapping[str, tuple[GaussianMap, Array]],
    log: RgbdLog,
    frame: RgbdFrame,
    rasterizer: Rasterizer,
    *,
    exposure: Exposure | None,
) -> dict[str, Any]:
    """Image and renders of maps at poses, in the exposure of the image; their depths, their errors."""

    def draw(shown: GaussianMap, T: Array) -> Render:
        T_camera_map = se3.inverse(T)
        render = rasterizer.forward(shown.gaussians, log.camera, T_camera_map, depth_kind=shown.depth)
        return in_exposure(render, exposure)

    renders = {kind: draw(shown, T) for kind, (shown, T) in maps.items()}
    measured = frame.usable_depth > 0
    low, high = _range_m(frame.depth[measured])
    depths = {kind: surface_depth(render) for kind, render in renders.items()}

    def depth_picture(depth_m: NDArray[np.float32]) -> NDArray[np.uint8]:
        return pictures.colored(depth_m, low, high, valid=depth_m > 0)

    def depth_error_picture(depth_m: NDArray[np.float32]) -> NDArray[np.uint8]:
        return pictures.colored(
            np.abs(depth_m - frame.depth),
            0.0,
            DEPTH_ERROR_END_M,
            valid=measured & (depth_m > 0),
            palette="magma",
        )

    def color_error_picture(render: Render) -> NDArray[np.uint8]:
        error = np.abs(np.clip(render.color, 0, 1) - frame.color / np.float32(255)).mean(axis=2)
        usable = np.ones(error.shape, dtype=bool) if frame.mask is None else frame.mask
        return pictures.colored(error, 0.0, COLOR_ERROR_END, valid=usable, palette="magma")

    kinds = tuple(renders)
    columns = [
        (_image_caption(frame), checkered(frame.color, frame.mask)),
        *((f"{kind} map", pictures.to_uint8(renders[kind].color)) for kind in kinds),
        ("recorded depth", depth_picture(frame.usable_depth)),
        *((f"depth, {kind} map", depth_picture(depths[kind])) for kind in kinds),
        (f"color error, {kinds[-1]} map", color_error_picture(renders[kinds[-1]])),
        *((f"depth error, {kind} map", depth_error_picture(depths[kind])) for kind in kinds),
    ]
    return {
        "frame_index": frame.index,
        "numbers": " · ".join(f"{kind}: {_view_numbers(render, frame)}" for kind, render in renders.items()),
        "pictures": [{"caption": caption, "uri": _uri(picture)} for caption, picture in columns],
        "scales": [
            _scale("viridis", f"{low:.2f} m", f"{high:.2f} m", "depth"),
            _scale("magma", "0", f"{1e3 * DEPTH_ERROR_END_M:.0f} mm and more", "depth error"),
            _scale("magma", "0", f"{COLOR_ERROR_END:g} of white and more", "color error"),
        ],
    }


def _image_caption(frame: RgbdFrame) -> str:
    """What the picture of a frame is called, with the share of its pixels that are masked."""
    if frame.mask is None:
        return "image"
    return f"image ({np.mean(~frame.mask):.1%} masked)"


def _view_numbers(render: Render, frame: RgbdFrame) -> str:
    score = score_view(render, ComparedImage(frame.color, frame.mask), frame.depth, NO_EXACT)
    depth = labels.NONE if isinstance(score.depth_l1_m, Absent) else labels.meters_text(score.depth_l1_m)
    psnr = labels.NONE if isinstance(score.psnr_db, Absent) else f"{score.psnr_db:.1f} dB"
    return f"{psnr}, depth {depth}"


def _range_m(depths_m: NDArray[np.float32]) -> tuple[float, float]:
    """Near and far end of a depth scale: the middle 98 % of the values."""
    if not len(depths_m):
        return 0.0, 1.0
    low, high = np.percentile(depths_m, [1, 99])
    return float(low), float(max(high, low + 1e-3))


def _deviation_view(
    stated: StatedMap,
    path: Trajectory,
    log: RgbdLog,
    frames: Iterable[ScoredFrame],
    *,
    kind: str,
    noise: DepthNoise,
    rasterizer: Rasterizer,
) -> dict[str, Any]:
    """Predicted and found differences of rendered and true depth at frames, on one scale."""
    poses, shown, ends = poses_by_stamp(path), [], [0.0]
    for view in frames:
        frame = view.frame
        true_m, sensor_m = true_depth(view, noise)
        rendered = rendered_depth(rasterizer, stated, log.camera, se3.inverse(poses[frame.stamp_ns]))
        both = (true_m > 0) & (rendered.sigma_m > 0)
        predicted_m = np.hypot(rendered.sigma_m, sensor_m)
        ends.append(float(np.percentile(predicted_m[both], 95)) if both.any() else 0.0)
        shown.append((frame, both, predicted_m, np.abs(rendered.depth_m - true_m)))
    end_m, columns = max(ends), list[tuple[str, NDArray[np.uint8]]]()
    for frame, both, *values_m in shown:
        predicted, found = (pictures.colored(v, 0.0, end_m, valid=both, palette="magma") for v in values_m)
        columns.append((f"image, frame {frame.index}", checkered(frame.color, frame.mask)))
        columns.append((f"predicted deviation, {kind} map", predicted))
        columns.append((f"absolute error, {kind} map", found))
    scale = _scale(
        "magma", "0", f"{labels.meters_text(end_m)} and more", "predicted deviation and absolute error"
    )
    return {
        "pictures": [{"caption": caption, "uri": _uri(picture)} for caption, picture in columns],
        "scales": [scale],
    }


def _uri(picture: NDArray[np.uint8]) -> str:
    return pictures.jpeg_uri(picture, min(PICTURE_WIDTH_PX, picture.shape[1]))


def _scale(palette: str, low: str, high: str, what: str) -> dict[str, str]:
    return {"uri": pictures.scale_uri(palette), "low": low, "high": high, "what": what}
