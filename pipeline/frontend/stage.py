"""The front-end stage: from one robot's sensor log to its odometry, keyframes and Gaussian map.

Passes over the log: all frames are tracked; the keyframe poses are optimized together, loops included; the map is grown
at the poses found; the other frames are registered to it where that pays. Frames hang on keyframes.
The stage is offline in this sense; times in the log are those of the recording all the same.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import progress as progress_bar
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.frontend import FrontendConfig, is_held_out
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.frontend import bundle, loops
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.keyframe_graph import Refined, refine
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.messages import GaussianMap, Keyframe, KeyframeFactor, MapUpdate, Odometry, map_frame
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import LogWriter, RgbdLog, open_rgbd
from duagc.pipeline.registration import RgbdPyramid
from duagc.pipeline.registration.moving import FreeSpace
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.schemas import topics

LATENCY_NS = 30_000_000
"""Outputs are received this long after the frame that they are about: a constant, never the wall clock."""

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
        log_path: sensor log of the robot. out_path: frontend.mcap to write.
        seed: of the run, for the mapping. threads: of the rasterizer; changes no bit of the result.
        progress: show it on standard error.
    Returns:
        Wall times in seconds of tracking, refinement of the poses, mapping, final refinement of the map and writing.
    Raises:
        DuagError: the log is broken or empty.
    """
    _settle_opencv()
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
        refined, pairs = _refine(log, tracker, config, seed)
        keyframes = _keyframe_messages(log.robot, tracker.keyframes, refined)
        factors = _factor_messages(log.robot, tracker.keyframes, pairs, refined)
        clock.lap("refinement_s")
        updates, maps, frames = _map(log, keyframes, frames, noise_m, config, seed, threads, progress, clock)
        clock.lap("final_refinement_s")
        notes = {
            "color_without_depth": str(len(log.pairing.color_alone)),
            "depth_without_color": str(len(log.pairing.depth_alone)),
            "depth_noise_m": "unknown" if noise_m is None else f"{noise_m:.6f}",
        }
    odometry = [_odometry(log.robot, frame, refined.T_map_keyframe) for frame in frames]
    _write(out_path, log.robot, odometry, keyframes, factors, updates, maps, notes)
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


def _refine(
    log: RgbdLog, tracker: Tracker, config: FrontendConfig, seed: int
) -> tuple[Refined, Sequence[RelativePose]]:
    """Keyframe poses from all that their images say together, and the factors that say the same."""
    keyframes, settings = tracker.keyframes, config.keyframes
    start = np.array([keyframe.T_map_keyframe for keyframe in keyframes])
    if len(keyframes) < 2 or not (settings.local_optimization or settings.loops.enabled):
        return refine(start, tracker.pairs, settings.huber_sigmas), tracker.pairs

    def images(index: int, levels: int) -> RgbdPyramid:
        frame = log.frame(keyframes[index].frame_index)
        color = frame.color * np.float32(1 / 255)
        return RgbdPyramid.build(color, frame.usable_depth, log.camera, levels, frame.depth_sigma)

    registration = config.tracking.registration
    pairs = list(tracker.pairs)
    if settings.loops.enabled:
        tracked = refine(start, pairs, settings.huber_sigmas).T_map_keyframe
        pairs += loops.find_loops(tracked, keyframes, images, settings.loops, registration, seed, log.robot)
    if not settings.local_optimization:
        return refine(start, pairs, settings.huber_sigmas), pairs
    return bundle.optimize(start, keyframes, images, pairs, settings, registration)


def _keyframe_messages(robot: str, keyframes: Sequence[TrackedKeyframe], refined: Refined) -> list[Keyframe]:
    """Keyframes at their refined poses, with the information of the refined relative motion."""
    messages = []
    T_map_keyframes = refined.T_map_keyframe
    for keyframe, T in zip(keyframes, T_map_keyframes, strict=True):
        index, previous = keyframe.keyframe_index, keyframe.previous_index
        T_previous_keyframe, information = np.eye(4), np.zeros((6, 6))
        if previous >= 0:
            T_previous_keyframe = np.linalg.solve(T_map_keyframes[previous], T)
            information = refined.relative_information(previous, index)
        gain, offset = keyframe.exposure
        messages.append(
            Keyframe(
                stamp_ns=keyframe.stamp_ns,
                robot=robot,
                keyframe_index=index,
                frame_index=keyframe.frame_index,
                T_map_camera=T,
                previous_index=previous,
                T_previous_keyframe=T_previous_keyframe,
                information=information,
                exposure=(float(np.log(gain)), offset),
            )
        )
    return messages


def _factor_messages(
    robot: str, keyframes: Sequence[TrackedKeyframe], pairs: Sequence[RelativePose], refined: Refined
) -> list[KeyframeFactor]:
    """Every registration that the refinement used, in the order of the later keyframes."""
    return [
        KeyframeFactor(
            stamp_ns=keyframes[pair.j].stamp_ns,
            robot=robot,
            first_index=pair.i,
            second_index=pair.j,
            T_first_second=pair.T_i_j,
            information=pair.information / refined.contradiction,
            weight=float(weight),
        )
        for pair, weight in zip(pairs, refined.weights, strict=True)
    ]


def _map(
    log: RgbdLog,
    keyframes: Sequence[Keyframe],
    frames: list[TrackedFrame],
    noise_m: float | None,
    config: FrontendConfig,
    seed: int,
    threads: int,
    progress: bool,
    clock: _Clock,
) -> tuple[list[MapUpdate], _Maps, list[TrackedFrame]]:
    """Grow the map at the keyframes' poses; one update per keyframe, and one for the final refinement.

    The other frames are registered to the grown map, and some of them, never held-out ones, support its refinement.
    """
    if not config.mapping_enabled:
        clock.lap("mapping_s")
        return [], _Maps(Gaussians.empty(), None, config.mapping.depth_kind(noise_m)), frames
    from duagc.pipeline.frontend.mapping import Mapper, MappingStats

    def update(keyframe: Keyframe, stats: MappingStats) -> MapUpdate:
        return MapUpdate(
            keyframe.stamp_ns,
            log.robot,
            keyframe.keyframe_index,
            stats.inserted,
            stats.pruned,
            stats.total,
            stats.loss_before,
            stats.loss_after,
        )

    mapper = Mapper(log.camera, config.mapping, seed, threads, noise_m)
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
    frames = _refine_to_model(log, unrefined, mapper.depth, keyframes, frames, config, threads, progress)
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
    updates.append(update(keyframes[-1], mapper.finish()))
    return updates, _Maps(mapper.gaussians, unrefined, mapper.depth), frames


def depth_noise_m(frames: Sequence[TrackedFrame]) -> float | None:
    """Noise of the depth images, meters: the median over the frames of what is left between two registered ones."""
    rms_m = [
        frame.rms_depth_m
        for frame in frames
        if frame.status is Status.OK and frame.reason is Reason.NONE and frame.rms_depth_m > 0
    ]
    return float(np.median(rms_m)) if rms_m else None


def _refine_to_model(
    log: RgbdLog,
    gaussians: Gaussians,
    depth: DepthKind,
    keyframes: Sequence[Keyframe],
    frames: Sequence[TrackedFrame],
    config: FrontendConfig,
    threads: int,
    progress: bool,
) -> list[TrackedFrame]:
    """The frames with those between keyframes registered to the map, where that pays."""
    from duagc.pipeline.frontend.model_registration import ModelTracker

    model = ModelTracker(gaussians, depth, log.camera, config.model, config.tracking.registration, threads)
    taken = {keyframe.frame_index for keyframe in keyframes}
    refined = []
    for frame in progress_bar.track(frames, f"model {log.robot}") if progress else frames:
        usable = frame.status is not Status.LOST and frame.reason is Reason.NONE
        if model.pays and usable and frame.frame_index not in taken:
            T_map_keyframe = keyframes[frame.keyframe_index].T_map_camera
            frame = model.refine(frame, log.frame(frame.frame_index), T_map_keyframe)
        refined.append(frame)
    return refined


@dataclass(frozen=True)
class _Maps:
    """The robot's map after and before its final refinement, and the depth that its Gaussians are drawn with."""

    final: Gaussians
    unrefined: Gaussians | None
    depth: DepthKind


def _support(
    frames: Sequence[TrackedFrame], keyframes: Sequence[Keyframe], config: FrontendConfig
) -> list[TrackedFrame]:
    """Frames for the final refinement of the map: tracked, no keyframes, not held out; evenly spread over the log."""
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


def _odometry(robot: str, frame: TrackedFrame, T_map_keyframes: Array) -> Odometry:
    return Odometry(
        stamp_ns=frame.stamp_ns,
        robot=robot,
        frame_index=frame.frame_index,
        held_out=is_held_out(frame.frame_index),
        keyframe_index=frame.keyframe_index,
        T_map_camera=T_map_keyframes[frame.keyframe_index] @ frame.T_keyframe_camera,
        T_keyframe_camera=frame.T_keyframe_camera,
        information=frame.information,
        status=frame.status.value,
        overlap=frame.overlap,
        rms_depth_m=frame.rms_depth_m,
        rms_color=frame.rms_gray,
        reason=frame.reason.value,
    )


def _write(
    out_path: Path,
    robot: str,
    odometry: Sequence[Odometry],
    keyframes: Sequence[Keyframe],
    factors: Sequence[KeyframeFactor],
    updates: Sequence[MapUpdate],
    maps: _Maps,
    notes: Mapping[str, str],
) -> None:
    """One message per frame, then what its keyframe did, in the order of time; the maps at the end."""
    keyframe_of = {keyframe.frame_index: keyframe for keyframe in keyframes}
    factors_of: dict[int, list[KeyframeFactor]] = {}
    for factor in factors:
        factors_of.setdefault(factor.second_index, []).append(factor)
    updates_of: dict[int, list[MapUpdate]] = {}
    for update in updates:
        updates_of.setdefault(update.keyframe_index, []).append(update)
    tracked = sum(message.status != Status.LOST.value for message in odometry)
    with LogWriter(
        out_path, robot=robot, metadata={"frames": str(len(odometry)), "tracked": str(tracked), **notes}
    ) as log:
        for message in odometry:
            time_ns = message.stamp_ns + LATENCY_NS
            log.write(topics.ODOMETRY.of(robot), message, time_ns, message.stamp_ns)
            keyframe = keyframe_of.get(message.frame_index)
            if keyframe is not None:
                log.write(topics.KEYFRAME.of(robot), keyframe, time_ns, message.stamp_ns)
                for factor in factors_of.get(keyframe.keyframe_index, []):
                    log.write(topics.KEYFRAME_FACTOR.of(robot), factor, time_ns, message.stamp_ns)
                for update in updates_of.get(keyframe.keyframe_index, []):
                    log.write(topics.MAP_UPDATE.of(robot), update, time_ns, message.stamp_ns)
        last = odometry[-1].stamp_ns
        for topic, gaussians in ((topics.UNREFINED_MAP, maps.unrefined), (topics.MAP, maps.final)):
            if gaussians is not None:
                whole = GaussianMap(last, robot, map_frame(robot), gaussians, depth=maps.depth)
                log.write(topic.of(robot), whole, last + LATENCY_NS, last)


def _settle_opencv() -> None:
    from duagc.pipeline.base import determinism

    determinism.configure_opencv()


class _Clock:
    """Wall times of the parts of a stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = round(now - self._last, 3)
        self._last = now
