"""The log of the front end: its messages, and the order in which they are written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.frontend.components import Component
from duagc.pipeline.frontend.keyframe_graph import OptimizedKeyframes
from duagc.pipeline.frontend.submaps import TrackedLog
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe
from duagc.pipeline.geometry.exposure import ExposureTrack
from duagc.pipeline.messages import (
    FrameExposure,
    GaussianMap,
    Keyframe,
    KeyframeFactor,
    MapUpdate,
    Odometry,
    Submap,
    map_frame,
)
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import LogWriter
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.schemas import topics

LATENCY_NS = 30_000_000
"""Outputs are received this long after the frame that they are about: a constant, never the wall clock."""


@dataclass(frozen=True)
class Maps:
    """The robot's maps.

    Attributes:
        final: after the final optimization.
        unrefined: before it; None without mapping.
        depth: of a Gaussian at a pixel, as the maps are drawn.
    """

    final: Gaussians
    unrefined: Gaussians | None
    depth: DepthKind


@dataclass(frozen=True)
class BuiltMap:
    """What mapping leaves.

    Attributes:
        updates: one per keyframe, and one for the final optimization.
        maps: before and after the final optimization.
        frames: of the log, those between keyframes registered to the map where that helped.
        T_map_keyframe: [k, 4, 4], poses of the keyframes, refined with the map.
        shutter_s: how long the shutter is open, as the map was made; 0: images were taken for sharp.
    """

    updates: list[MapUpdate]
    maps: Maps
    frames: list[TrackedFrame]
    T_map_keyframe: Array
    shutter_s: float = 0.0


def keyframe_messages(
    robot: str, keyframes: Sequence[TrackedKeyframe], solution: OptimizedKeyframes
) -> list[Keyframe]:
    """Keyframes at their optimized poses, with the information of the relative motion.

    Args:
        robot: its name.
        keyframes: as tracked.
        solution: of the pose graph.
    """
    messages = []
    T_map_keyframes = solution.T_map_keyframe
    for keyframe, T in zip(keyframes, T_map_keyframes, strict=True):
        index, previous = keyframe.keyframe_index, keyframe.previous_index
        T_previous_keyframe, information = np.eye(4), np.zeros((6, 6))
        if previous >= 0:
            T_previous_keyframe = np.linalg.solve(T_map_keyframes[previous], T)
            information = solution.relative_information(previous, index)
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


def factor_messages(
    robot: str,
    keyframes: Sequence[TrackedKeyframe],
    pairs: Sequence[RelativePose],
    solution: OptimizedKeyframes,
) -> list[KeyframeFactor]:
    """Every factor of the pose graph, in the order of the later keyframes.

    Args:
        robot: its name.
        keyframes: as tracked.
        pairs: the factors.
        solution: of the pose graph.
    """
    return [
        KeyframeFactor(
            stamp_ns=keyframes[pair.j].stamp_ns,
            robot=robot,
            first_index=pair.i,
            second_index=pair.j,
            T_first_second=pair.T_i_j,
            information=pair.information / solution.variance_factor,
            weight=float(weight),
        )
        for pair, weight in zip(pairs, solution.weights, strict=True)
    ]


def exposure_messages(
    name: str, exposures: ExposureTrack, odometry: Sequence[Odometry]
) -> list[FrameExposure]:
    """The exposures of all frames that have one, in the order of time.

    Args:
        name: of the component.
        exposures: of the log.
        odometry: of every frame.
    """
    stamps_ns = {message.frame_index: message.stamp_ns for message in odometry}
    indices = exposures.frame_index.tolist()
    return [
        FrameExposure(stamps_ns[index], name, index, gain, offset)
        for index, gain, offset in zip(indices, exposures.gain, exposures.offset, strict=True)
    ]


def odometry_message(robot: str, frame: TrackedFrame, T_map_keyframes: Array) -> Odometry:
    """The pose of a frame.

    Args:
        robot: its name.
        frame: as tracked.
        T_map_keyframes: [k, 4, 4], of all keyframes.
    """
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


def submap_messages(robot: str, component: Component, log: TrackedLog) -> list[Submap]:
    """The submaps of a component; none if the robot has a single one.

    Args:
        robot: name of the component.
        component: of the robot.
        log: as it was tracked.
    """
    if len(log.submaps) < 2:
        return []
    messages = []
    for submap in (s for s in log.submaps if s.number in component.numbers):
        frames = [
            frame.frame_index
            for frame, number in zip(log.frames, log.submap_of, strict=True)
            if number == submap.number and frame.status is not Status.LOST
        ]
        messages.append(
            Submap(
                stamp_ns=submap.keyframes[0].stamp_ns,
                robot=robot,
                submap=submap.number,
                first_frame=frames[0],
                last_frame=frames[-1],
                frames=len(frames),
                keyframes=sum(number == submap.number for number, _ in component.index_of),
                loop_closures=component.closures[submap.number],
            )
        )
    return messages


def write_log(
    out_path: Path,
    robot: str,
    odometry: Sequence[Odometry],
    *,
    keyframes: Sequence[Keyframe],
    factors: Sequence[KeyframeFactor],
    exposures: Sequence[FrameExposure],
    updates: Sequence[MapUpdate],
    submaps: Sequence[Submap],
    maps: Maps,
    notes: Mapping[str, str],
) -> None:
    """Write one message per frame, then those of its keyframe, in the order of time; the maps at the end.

    Args:
        out_path: of the log.
        robot: its name.
        odometry: of every frame.
        keyframes: messages of the keyframes.
        factors: of the pose graph.
        exposures: of the frames that have one.
        updates: of the map.
        submaps: of the component.
        maps: the robot's maps.
        notes: metadata of the log.
    """
    exposure_of = {exposure.frame_index: exposure for exposure in exposures}
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
            if message.frame_index in exposure_of:
                exposure = exposure_of[message.frame_index]
                log.write(topics.EXPOSURE.of(robot), exposure, time_ns, message.stamp_ns)
            keyframe = keyframe_of.get(message.frame_index)
            if keyframe is not None:
                log.write(topics.KEYFRAME.of(robot), keyframe, time_ns, message.stamp_ns)
                for factor in factors_of.get(keyframe.keyframe_index, []):
                    log.write(topics.KEYFRAME_FACTOR.of(robot), factor, time_ns, message.stamp_ns)
                for update in updates_of.get(keyframe.keyframe_index, []):
                    log.write(topics.MAP_UPDATE.of(robot), update, time_ns, message.stamp_ns)
        last = odometry[-1].stamp_ns
        for submap in submaps:
            log.write(topics.SUBMAP.of(robot), submap, last + LATENCY_NS, submap.stamp_ns)
        for topic, gaussians in ((topics.UNREFINED_MAP, maps.unrefined), (topics.MAP, maps.final)):
            if gaussians is not None:
                whole = GaussianMap(last, robot, map_frame(robot), gaussians, depth=maps.depth)
                log.write(topic.of(robot), whole, last + LATENCY_NS, last)
