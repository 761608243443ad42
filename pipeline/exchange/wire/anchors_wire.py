"""Bytes of the poses of one robot's keyframes, to which its evidence is anchored. Strict as `reader`."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.exchange.wire.camera_wire import camera_bytes, read_camera
from duagc.pipeline.exchange.wire.reader import MAX_KEYFRAMES, Reader, pose_bytes
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.network.packets import MalformedError


@dataclass(frozen=True)
class PlacedKeyframes:
    """Where the keyframes of one robot are.

    Attributes:
        owner: index of the robot.
        T_common_keyframe: [n, 4, 4], its keyframes in the common frame of the consensus.
    """

    owner: int
    T_common_keyframe: Array


@dataclass(frozen=True)
class Anchors(PlacedKeyframes):
    """Poses of one robot, agreed or as they are now, and what it sees from there.

    Attributes:
        T_map_first: [4, 4], its first keyframe in its own map.
        camera: that took its keyframes.
    """

    T_map_first: Array
    camera: PinholeCamera


_HEAD = struct.Struct("<HI")


def write_anchors(anchors: Anchors) -> bytes:
    """Bytes of ANCHORS.

    Args:
        anchors: poses of one robot, n keyframes at least one.

    Returns:
        Owner, number of keyframes, camera, first keyframe in the map, and the upper rows of all poses in
        float64.
    """
    return b"".join(
        [
            _HEAD.pack(anchors.owner, len(anchors.T_common_keyframe)),
            camera_bytes(anchors.camera),
            pose_bytes(anchors.T_map_first),
            pose_bytes(anchors.T_common_keyframe),
        ]
    )


def read_anchors(data: bytes, team: int) -> Anchors:
    """From ANCHORS.

    Args:
        data: of the message.
        team: number of robots.

    Raises:
        MalformedError: it is not what it should be, or of a robot outside the team.
    """
    reader = Reader(data, "anchors")
    owner, n = reader.fields(_HEAD)
    if owner >= team or not 1 <= n <= MAX_KEYFRAMES:
        raise MalformedError("anchors: names a robot outside the team, or no keyframe")
    camera = read_camera(reader)
    first, T = reader.poses(1)[0], reader.poses(n)
    reader.done()
    return Anchors(owner, T, first, camera)
