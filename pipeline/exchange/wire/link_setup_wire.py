"""Bytes of the first message of a link: keyframes and the loop closures that the sender holds. Strict as the others."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from duagc.pipeline.base.arrays import Array, array_bytes
from duagc.pipeline.exchange.wire.reader import MAX_KEYFRAMES, Reader, check_information, pose_bytes
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph.relative_poses import LoopClosure

_COUNTS = struct.Struct("<II")
_CLOSURE = struct.Struct("<IIB")


@dataclass(frozen=True)
class LinkSetup:
    """What a robot sends a neighbor at the start.

    Attributes:
        poses: [n, 4, 4], its keyframes in the common frame.
        closures: loop closures that it holds with the neighbor.
    """

    poses: Array
    closures: tuple[LoopClosure, ...]


def write_setup(setup: LinkSetup) -> bytes:
    """Bytes of the first message.

    Args:
        setup: what it says.
    """
    parts = [_COUNTS.pack(len(setup.poses), len(setup.closures)), pose_bytes(setup.poses)]
    for c in setup.closures:
        parts.append(_CLOSURE.pack(c.own_keyframe, c.peer_keyframe, c.measured_from_peer))
        parts += [pose_bytes(c.T_own_peer), array_bytes(c.information, "float64")]
    return b"".join(parts)


def read_setup(data: bytes, keyframes: int, solver: str) -> LinkSetup:
    """From `write_setup`.

    Args:
        data: the bytes.
        keyframes: of the robot that reads, which loop closures name.
        solver: whose message it is; errors name it.

    Raises:
        MalformedError: it is not what it should be.
    """
    reader = Reader(data, solver)
    n, m = reader.fields(_COUNTS)
    if not 1 <= n <= MAX_KEYFRAMES:
        raise MalformedError(f"{solver}: no keyframe, or too many")
    poses, closures = reader.poses(n), []
    for _ in range(m):
        own, peer, from_peer = reader.fields(_CLOSURE)
        T, information = reader.poses(1)[0], reader.array("float64", (6, 6))
        if own >= n or peer >= keyframes or from_peer > 1:
            raise MalformedError(f"{solver}: a loop closure of a keyframe that does not exist")
        check_information(information[None], solver)
        closures.append(LoopClosure(own, peer, T, information, bool(from_peer)))
    reader.done()
    return LinkSetup(poses, tuple(closures))
