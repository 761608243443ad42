"""The front-end stage: from one robot's sensor log to its odometry, keyframes and Gaussian map.

Passes over the log: all frames are tracked; the keyframe poses are optimized together, with loop closures; the map is
grown at these poses; the other frames are registered to it where that helps. Frames are anchored to keyframes.
The stage is offline in this sense; times in the log are those of the recording all the same.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import determinism
from duagc.pipeline.base import progress as progress_bar
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.frontend import FrontendConfig, is_held_out
from duagc.pipeline.frontend import bundle, loops
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.keyframe_graph import OptimizedKeyframes, solve_pose_graph
from duagc.pipeline.frontend.output import (
    Maps,
    factor_messages,
    keyframe_messages,
    odometry_message,
    write_log,
)
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.messages import Keyframe, MapUpdate
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import RgbdLog, open_rgbd
from duagc.pipeline.registration import RgbdPyramid
from duagc.pipeline.registration.moving import FreeSpace
from duagc.pipeline.splat.gaussians import Gaussians

if TYPE_CHECKING:
    from duagc.pipeline.frontend.model_registration import ModelTracker

Array = NDArray[np.float64]


def run_frontend(
    log_path: Path,
    out_path: Path,
    config: FrontendConfig,
    *,
    seed: int = 0,
    threads: int = 1,
    progress: bool = False,
) -> dict[str, float]:
    """Track and map one robot's log.

    Args:
        log_path: sensor log of the robot.
        out_path: frontend.mcap to write.
        config: of the stage.
        seed: of the run, for the mapping.
        threads: of the rasterizer; changes no bit of the result.
        progress: whether it is shown on standard error.

    Returns:
        Wall times in seconds of tracking, pose optimization, mapping, final optimization of the map and writing.

    Raises:
        DuagError: the log is broken or empty.
    """
    determinism.configure_opencv()
    clock = _Clock()
    with open_rgbd(log_path) as log:
        if len(log) == 0:
            raise DuagError(f"{log_path}: has no image, expected at least one")
        tracker, frames = _track(log, config, progress)
        if not tracker.keyframes:
            reasons = ", ".join(sorted({frame.reason.value for frame in frames}))
            size = f"{log.camera.width} x {log.camera.height}"
            raise DuagError(
                f"{log_path}: found no frame of {size} pixels to begin a map with ({reasons}), "
                "expected one with depth in enough of them"
            )
        noise_m = depth_noise_m(frames)
        clock.lap("tracking_s")
        solution, pairs = _optimize_poses(log, tracker, config, seed)
        keyframes = keyframe_messages(log.robot, tracker.keyframes, solution)
        factors = factor_messages(log.robot, tracker.keyframes, pairs, solution)
        clock.lap("refinement_s")
        updates, maps, frames = _map(
            log,
            keyframes,
            frames,
            config,
            noise_m=noise_m,
            seed=seed,
            threads=threads,
            progress=progress,
            clock=clock,
        )
        clock.lap("final_refinement_s")
        notes = {
            "color_without_depth": str(len(log.pairing.color_alone)),
            "depth_without_color": str(len(log.pairing.depth_alone)),
            "depth_noise_m": "unknown" if noise_m is None else f"{noise_m:.6f}",
        }
    odometry = [odometry_message(log.robot, frame, solution.T_map_keyframe) for frame in frames]
    write_log(
        out_path,
        log.robot,
        odometry,
        keyframes=keyframes,
        factors=factors,
        updates=updates,
        maps=maps,
        notes=notes,
    )
    clock.lap("writing_s")
    return clock.laps


def _track(log: RgbdLog, config: FrontendConfig, progress: bool) -> tuple[Tracker, list[TrackedFrame]]:
    """Track all frames in order."""
    tracker = Tracker(log.camera, config, log.motion_prior())
    source = log.frames()
    if progress:
        source = progress_bar.track(source, f"tracking {log.robot}", len(log))
    tracked = []
    for frame in source:
        image = frame.color.astype(np.float32) * np.float32(1 / 255)
        found = tracker.track(
            frame.index,
            frame.stamp_ns,
            image,
            frame.depth,
            mask=frame.mask,
            depth_sigma_m=frame.depth_sigma,
        )
        tracked.append(found)
    return tracker, tracked


def _optimize_poses(
    log: RgbdLog, tracker: Tracker, config: FrontendConfig, seed: int
) -> tuple[OptimizedKeyframes, Sequence[RelativePose]]:
    """Keyframe poses by all their images together, and the factors of the pose graph."""
    keyframes, settings = tracker.keyframes, config.keyframes
    start = np.array([keyframe.T_map_keyframe for keyframe in keyframes])
    if len(keyframes) < 2 or not (settings.local_optimization or settings.loops.enabled):
        return solve_pose_graph(start, tracker.pairs, settings.huber_sigmas), tracker.pairs

    def images(index: int, levels: int) -> RgbdPyramid:
        frame = log.frame(keyframes[index].frame_index)
        color = frame.color * np.float32(1 / 255)
        return RgbdPyramid.build(
            color, frame.usable_depth, log.camera, levels, depth_sigma_m=frame.depth_sigma
        )

    registration = config.tracking.registration
    pairs = list(tracker.pairs)
    if settings.loops.enabled:
        tracked = solve_pose_graph(start, pairs, settings.huber_sigmas).T_map_keyframe
        pairs += loops.find_loops(
            tracked,
            keyframes,
            images,
            config=settings.loops,
            registration=registration,
            seed=seed,
            robot=log.robot,
        )
    if not settings.local_optimization:
        return solve_pose_graph(start, pairs, settings.huber_sigmas), pairs
    return bundle.optimize(start, keyframes, images, pairs, config=settings, registration=registration)


def _map(
    log: RgbdLog,
    keyframes: Sequence[Keyframe],
    frames: list[TrackedFrame],
    config: FrontendConfig,
    *,
    noise_m: float | None,
    seed: int,
    threads: int,
    progress: bool,
    clock: _Clock,
) -> tuple[list[MapUpdate], Maps, list[TrackedFrame]]:
    """Grow the map at the keyframes' poses; one update per keyframe, and one for the final optimization.

    The other frames are registered to the grown map, and some of them, never held-out ones, support its optimization.
    """
    if not config.mapping_enabled:
        clock.lap("mapping_s")
        return [], Maps(Gaussians.empty(), None, config.mapping.depth_kind(noise_m)), frames
    from duagc.pipeline.frontend.mapping import Mapper, MappingStats
    from duagc.pipeline.frontend.model_registration import ModelTracker

    def update(keyframe: Keyframe, stats: MappingStats) -> MapUpdate:
        return MapUpdate(
            stamp_ns=keyframe.stamp_ns,
            robot=log.robot,
            keyframe_index=keyframe.keyframe_index,
            inserted=stats.inserted,
            pruned=stats.pruned,
            total=stats.total,
            loss_before=stats.loss_before,
            loss_after=stats.loss_after,
        )

    mapper = Mapper(log.camera, config.mapping, seed, threads=threads, depth_noise_m=noise_m)
    free = FreeSpace(log.camera, config.moving)
    for keyframe in keyframes:
        free.add(log.frame(keyframe.frame_index).usable_depth, keyframe.T_map_camera)
    steps = progress_bar.track(keyframes, f"mapping {log.robot}") if progress else keyframes
    updates = []
    for keyframe in steps:
        frame = log.frame(keyframe.frame_index)
        stats = mapper.add_keyframe(
            keyframe.keyframe_index,
            frame.color,
            frame.depth,
            keyframe.T_map_camera,
            mask=free.usable(frame.usable_depth, keyframe.T_map_camera, frame.mask),
            depth_sigma_m=frame.depth_sigma,
        )
        updates.append(update(keyframe, stats))
    unrefined = mapper.gaussians
    clock.lap("mapping_s")
    model = ModelTracker(
        unrefined,
        mapper.depth,
        log.camera,
        config.model,
        registration=config.tracking.registration,
        threads=threads,
    )
    frames = _register_to_model(log, model, keyframes, frames, progress=progress)
    clock.lap("model_s")
    for supporting in _support(frames, keyframes, config):
        frame = log.frame(supporting.frame_index)
        T_map_camera = keyframes[supporting.keyframe_index].T_map_camera @ supporting.T_keyframe_camera
        mapper.add_view(
            supporting.keyframe_index,
            frame.color,
            frame.depth,
            supporting.T_keyframe_camera,
            mask=free.usable(frame.usable_depth, T_map_camera, frame.mask),
            depth_sigma_m=frame.depth_sigma,
        )
    updates.append(update(keyframes[-1], mapper.finalize()))
    return updates, Maps(mapper.gaussians, unrefined, mapper.depth), frames


def depth_noise_m(frames: Sequence[TrackedFrame]) -> float | None:
    """Noise of the depth images, meters: the median over the frames of the depth residual of their registration.

    Args:
        frames: of the log, as tracked.

    Returns:
        The noise; None if no frame was tracked with depth.
    """
    rms_m = [
        frame.rms_depth_m
        for frame in frames
        if frame.status is Status.OK and frame.reason is Reason.NONE and frame.rms_depth_m > 0
    ]
    return float(np.median(rms_m)) if rms_m else None


def _register_to_model(
    log: RgbdLog,
    model: ModelTracker,
    keyframes: Sequence[Keyframe],
    frames: Sequence[TrackedFrame],
    *,
    progress: bool,
) -> list[TrackedFrame]:
    """The frames with those between keyframes registered to the map, where that helps."""
    taken = {keyframe.frame_index for keyframe in keyframes}
    registered = []
    for frame in progress_bar.track(frames, f"model {log.robot}") if progress else frames:
        usable = frame.status is not Status.LOST and frame.reason is Reason.NONE
        if model.worthwhile and usable and frame.frame_index not in taken:
            T_map_keyframe = keyframes[frame.keyframe_index].T_map_camera
            frame = model.register(frame, log.frame(frame.frame_index), T_map_keyframe)
        registered.append(frame)
    return registered


def _support(
    frames: Sequence[TrackedFrame], keyframes: Sequence[Keyframe], config: FrontendConfig
) -> list[TrackedFrame]:
    """Frames for the final optimization of the map: tracked, no keyframes, not held out; evenly spread over the log."""
    taken = {keyframe.frame_index for keyframe in keyframes}
    candidates = [
        frame
        for frame in frames
        if frame.status is not Status.LOST
        and frame.reason is Reason.NONE  # its depth and its color belong together
        and frame.frame_index not in taken
        and not is_held_out(frame.frame_index)
    ]
    count = min(config.mapping.support_views, len(candidates))
    return [candidates[k] for k in evenly_spaced(len(candidates), count)]


class _Clock:
    """Wall times of the parts of a stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """End a part; `laps` holds its time under this name."""
        now = time.perf_counter()
        self.laps[name] = round(now - self._last, 3)
        self._last = now
