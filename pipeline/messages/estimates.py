"""Messages of what a robot estimates: poses, keyframes, maps and their information."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from duagc import schemas
from duagc.pipeline.base.arrays import array_bytes
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.messages.maps import GaussianInformation, GaussianMap, MapUpdate
from duagc.pipeline.messages.parts import (
    WORLD_FRAME,
    Array,
    map_frame,
    numbers,
    pack_information,
    pack_pose,
    pack_stamp,
    unpack_array,
    unpack_pose,
    unpack_stamp,
)
from duagc.pipeline.messages.peers import PeerColors, PeerMapReport, RejectedMatches

_STATUS = {"ok": 1, "lost": 2, "relocalized": 3}


_STATUS_NAME = {number: name for name, number in _STATUS.items()}


@dataclass(frozen=True, eq=False)
class Odometry:
    """Pose of one frame, as the front end had it when the frame had been tracked.

    stamp_ns: time of the frame. frame_index: position in the log, from 0. held_out: tracked but never mapped.
    keyframe_index: keyframe it was tracked against. T_map_camera, T_keyframe_camera: [4, 4].
    information: [6, 6] of T_keyframe_camera, right tangent (translation m, rotation rad); zero when lost.
    status: "ok", "lost" or "relocalized". overlap: share of the reference seen, 0..1.
    rms_depth_m, rms_color: residuals, meters and image units. reason: why it is lost, or tracked by one
    image alone, else "".
    """

    schema: ClassVar[str] = "duagc.v1.Odometry"

    stamp_ns: int
    robot: str
    frame_index: int
    held_out: bool
    keyframe_index: int
    T_map_camera: Array
    T_keyframe_camera: Array
    information: Array
    status: str
    overlap: float
    rms_depth_m: float
    rms_color: float
    reason: str = ""

    def pack(self) -> Any:
        """duagc.v1.Odometry."""
        message = schemas.new(
            "Odometry",
            frame_id=map_frame(self.robot),
            robot=self.robot,
            frame_index=int(self.frame_index),
            held_out=bool(self.held_out),
            keyframe_index=int(self.keyframe_index),
            pose_map_camera=pack_pose(self.T_map_camera),
            pose_keyframe_camera=pack_pose(self.T_keyframe_camera),
            information=pack_information(self.information),
            status=_STATUS[self.status],
            overlap=float(self.overlap),
            rms_depth_m=float(self.rms_depth_m),
            rms_color=float(self.rms_color),
            reason=self.reason,
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> Odometry:
        """From duagc.v1.Odometry.

        Args:
            m: the protobuf message.
        """
        if m.status not in _STATUS_NAME:
            raise DuagError(f"Odometry.status is {m.status}, expected one of {sorted(_STATUS_NAME)}")
        return Odometry(
            stamp_ns=unpack_stamp(m),
            robot=m.robot,
            frame_index=m.frame_index,
            held_out=m.held_out,
            keyframe_index=m.keyframe_index,
            T_map_camera=unpack_pose(m.pose_map_camera, "Odometry.pose_map_camera"),
            T_keyframe_camera=unpack_pose(m.pose_keyframe_camera, "Odometry.pose_keyframe_camera"),
            information=numbers(m.information, (6, 6), "Odometry.information"),
            status=_STATUS_NAME[m.status],
            overlap=m.overlap,
            rms_depth_m=m.rms_depth_m,
            rms_color=m.rms_color,
            reason=m.reason,
        )


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame that carries part of the map.

    stamp_ns: time of the frame. keyframe_index: from 0. frame_index: position in the log. T_map_camera: [4, 4].
    previous_index: keyframe it was tracked against, -1 for the first. T_previous_keyframe: [4, 4], identity for the
    first. information: [6, 6] of T_previous_keyframe, right tangent (translation m, rotation rad), zero for the
    first. exposure: (a, b) of the frame relative to the map, as the tracker defines it.
    """

    schema: ClassVar[str] = "duagc.v1.Keyframe"

    stamp_ns: int
    robot: str
    keyframe_index: int
    frame_index: int
    T_map_camera: Array
    previous_index: int
    T_previous_keyframe: Array
    information: Array
    exposure: tuple[float, float]

    def pack(self) -> Any:
        """duagc.v1.Keyframe."""
        message = schemas.new(
            "Keyframe",
            frame_id=map_frame(self.robot),
            robot=self.robot,
            keyframe_index=int(self.keyframe_index),
            frame_index=int(self.frame_index),
            pose_map_camera=pack_pose(self.T_map_camera),
            previous_index=int(self.previous_index),
            pose_previous_keyframe=pack_pose(self.T_previous_keyframe),
            information=pack_information(self.information),
            exposure_a=float(self.exposure[0]),
            exposure_b=float(self.exposure[1]),
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> Keyframe:
        """From duagc.v1.Keyframe.

        Args:
            m: the protobuf message.
        """
        return Keyframe(
            stamp_ns=unpack_stamp(m),
            robot=m.robot,
            keyframe_index=m.keyframe_index,
            frame_index=m.frame_index,
            T_map_camera=unpack_pose(m.pose_map_camera, "Keyframe.pose_map_camera"),
            previous_index=m.previous_index,
            T_previous_keyframe=unpack_pose(m.pose_previous_keyframe, "Keyframe.pose_previous_keyframe"),
            information=numbers(m.information, (6, 6), "Keyframe.information"),
            exposure=(m.exposure_a, m.exposure_b),
        )


@dataclass(frozen=True, eq=False)
class Submap:
    """A submap of a robot that was lost and began anew.

    stamp_ns: time of its first keyframe. robot: the component that it belongs to. submap: number from 1, in the order
    in which the robot's submaps began. first_frame, last_frame: with a pose in it. frames: how many have one.
    keyframes: how many. loop_closures: that tie it to other submaps of its component.
    """

    schema: ClassVar[str] = "duagc.v1.Submap"

    stamp_ns: int
    robot: str
    submap: int
    first_frame: int
    last_frame: int
    frames: int
    keyframes: int
    loop_closures: int

    def pack(self) -> Any:
        """duagc.v1.Submap."""
        message = schemas.new(
            "Submap",
            frame_id=map_frame(self.robot),
            robot=self.robot,
            submap=int(self.submap),
            first_frame=int(self.first_frame),
            last_frame=int(self.last_frame),
            frames=int(self.frames),
            keyframes=int(self.keyframes),
            loop_closures=int(self.loop_closures),
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> Submap:
        """From duagc.v1.Submap.

        Args:
            m: the protobuf message.
        """
        counts = (m.submap, m.first_frame, m.last_frame, m.frames, m.keyframes, m.loop_closures)
        return Submap(unpack_stamp(m), m.robot, *counts)


@dataclass(frozen=True, eq=False)
class KeyframeFactor:
    """A registration between two keyframes, with the weight that the refinement of their poses gave it.

    stamp_ns: time of the later keyframe. first_index, second_index: keyframes i < j. T_first_second: [4, 4] as
    registered. information: [6, 6] of it, right tangent (translation m, rotation rad), without the weight, lowered
    if the registrations contradict each other. weight: robust weight, 0..1.
    """

    schema: ClassVar[str] = "duagc.v1.KeyframeFactor"

    stamp_ns: int
    robot: str
    first_index: int
    second_index: int
    T_first_second: Array
    information: Array
    weight: float

    def pack(self) -> Any:
        """duagc.v1.KeyframeFactor."""
        message = schemas.new(
            "KeyframeFactor",
            frame_id=map_frame(self.robot),
            robot=self.robot,
            first_index=int(self.first_index),
            second_index=int(self.second_index),
            pose_first_second=pack_pose(self.T_first_second),
            information=pack_information(self.information),
            weight=float(self.weight),
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> KeyframeFactor:
        """From duagc.v1.KeyframeFactor.

        Args:
            m: the protobuf message.
        """
        return KeyframeFactor(
            stamp_ns=unpack_stamp(m),
            robot=m.robot,
            first_index=m.first_index,
            second_index=m.second_index,
            T_first_second=unpack_pose(m.pose_first_second, "KeyframeFactor.pose_first_second"),
            information=numbers(m.information, (6, 6), "KeyframeFactor.information"),
            weight=m.weight,
        )


@dataclass(frozen=True, eq=False)
class FrameExposure:
    """The exposure of a frame: what the map shows in color c is gain * c + offset in the image.

    Attributes:
        stamp_ns: time of the frame.
        robot: whose frame.
        frame_index: position in the log.
        gain: [3], by channel.
        offset: [3], colors 0..1.
    """

    schema: ClassVar[str] = "duagc.v1.FrameExposure"

    stamp_ns: int
    robot: str
    frame_index: int
    gain: Array
    offset: Array

    def pack(self) -> Any:
        """duagc.v1.FrameExposure."""
        message = schemas.new(
            "FrameExposure",
            robot=self.robot,
            frame_index=int(self.frame_index),
            gain=self.gain,
            offset=self.offset,
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> FrameExposure:
        """From duagc.v1.FrameExposure.

        Args:
            m: the protobuf message.

        Raises:
            DuagError: a gain that is not positive.
        """
        gain = numbers(m.gain, (3,), "FrameExposure.gain")
        if not np.all(gain > 0):
            raise DuagError(f"FrameExposure.gain is {gain.tolist()}, expected positive numbers")
        return FrameExposure(
            unpack_stamp(m), m.robot, m.frame_index, gain, numbers(m.offset, (3,), "FrameExposure.offset")
        )


@dataclass(frozen=True, eq=False)
class CorrectedKeyframes:
    """All keyframe poses of one robot after consensus, by its own estimate.

    component: names of the robots that share this world, sorted. keyframe_indices: int32 [k], ascending.
    T_world_keyframe: [k, 4, 4].
    """

    schema: ClassVar[str] = "duagc.v1.CorrectedKeyframes"

    stamp_ns: int
    robot: str
    component: list[str]
    keyframe_indices: NDArray[np.int32]
    T_world_keyframe: Array

    def pack(self) -> Any:
        """duagc.v1.CorrectedKeyframes."""
        poses = np.asarray(self.T_world_keyframe, dtype=np.float64)
        if poses.shape != (len(self.keyframe_indices), 4, 4):
            raise ValueError(
                f"T_world_keyframe is {poses.shape}, expected {(len(self.keyframe_indices), 4, 4)}"
            )
        message = schemas.new(
            "CorrectedKeyframes",
            frame_id=WORLD_FRAME,
            robot=self.robot,
            component=list(self.component),
            count=len(poses),
            keyframe_indices_int32=array_bytes(self.keyframe_indices, "int32"),
            poses_world_keyframe_float64=array_bytes(poses[:, :3], "float64"),
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> CorrectedKeyframes:
        """From duagc.v1.CorrectedKeyframes.

        Args:
            m: the protobuf message.
        """
        field = "CorrectedKeyframes.poses_world_keyframe_float64"
        rows = unpack_array(m.poses_world_keyframe_float64, "float64", (m.count, 3, 4), field)
        poses = np.tile(np.eye(4), (m.count, 1, 1))
        poses[:, :3] = rows
        indices = unpack_array(
            m.keyframe_indices_int32, "int32", (m.count,), "CorrectedKeyframes.keyframe_indices_int32"
        )
        return CorrectedKeyframes(unpack_stamp(m), m.robot, list(m.component), indices, poses)


_UNPACK: dict[str, Callable[[Any], Any]] = {
    c.schema: c.unpack
    for c in (
        Odometry,
        Keyframe,
        KeyframeFactor,
        Submap,
        FrameExposure,
        MapUpdate,
        GaussianMap,
        GaussianInformation,
        CorrectedKeyframes,
        PeerColors,
        PeerMapReport,
        RejectedMatches,
    )
}


def unpack(message: Any) -> Any:
    """The dataclass of a protobuf message that has one here; any other message as it is.

    Args:
        message: of any schema.
    """
    function = _UNPACK.get(message.DESCRIPTOR.full_name)
    return message if function is None else function(message)
