"""Bytes of what Algorithm 1 exchanges besides poses: keyframes and loop closures, matches, means. Strict as the others.

Loop closures go from the end that holds them to the other, once; matches from the lower-named robot, once; means of
matched Gaussians in every round, in parts that are useful alone.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.exchange.wire.state_wire import (
    MAX_COORDINATE,
    MAX_KEYFRAMES,
    Reader,
    array_bytes,
    pose_bytes,
)
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph.relative_poses import LoopClosure

MAX_INFORMATION = 1e15
_COUNTS = struct.Struct("<II")
_CLOSURE = struct.Struct("<IIB")
_COUNT = struct.Struct("<I")
_PART = struct.Struct("<IH")
_MEAN_BYTES = 12


@dataclass(frozen=True)
class Setup:
    """What a robot sends a neighbor at the start.

    Attributes:
        poses: [n, 4, 4], its keyframes in the common frame.
        closures: loop closures that it holds with the neighbor.
    """

    poses: Array
    closures: tuple[LoopClosure, ...]


def write_setup(setup: Setup) -> bytes:
    """Bytes of the first message.

    Args:
        setup: what it says.
    """
    parts = [_COUNTS.pack(len(setup.poses), len(setup.closures)), pose_bytes(setup.poses)]
    for c in setup.closures:
        parts.append(_CLOSURE.pack(c.own_keyframe, c.peer_keyframe, c.measured_from_peer))
        parts += [pose_bytes(c.T_own_peer), array_bytes(c.information, "float64")]
    return b"".join(parts)


def read_setup(data: bytes, keyframes: int) -> Setup:
    """From `write_setup`.

    Args:
        data: the bytes.
        keyframes: of the robot that reads, which loop closures name.

    Raises:
        MalformedError: it is not what it should be.
    """
    reader = Reader(data, "Algorithm 1")
    n, m = reader.fields(_COUNTS)
    if not 1 <= n <= MAX_KEYFRAMES:
        raise MalformedError("Algorithm 1: no keyframe, or too many")
    poses, closures = reader.poses(n), []
    for _ in range(m):
        own, peer, from_peer = reader.fields(_CLOSURE)
        T, information = reader.poses(1)[0], reader.array("float64", (6, 6))
        if own >= n or peer >= keyframes or from_peer > 1:
            raise MalformedError("Algorithm 1: a loop closure of a keyframe that does not exist")
        if np.abs(information).max() > MAX_INFORMATION or np.linalg.eigvalsh(information)[0] < 0.0:
            raise MalformedError("Algorithm 1: impossible information of a loop closure")
        closures.append(LoopClosure(own, peer, T, information, bool(from_peer)))
    reader.done()
    return Setup(poses, tuple(closures))


def write_pairs(ids: NDArray[np.int64]) -> bytes:
    """Bytes of matched Gaussians.

    Args:
        ids: [n, 2], of the sender first.
    """
    return _COUNT.pack(len(ids)) + array_bytes(ids, "int64")


def read_pairs(data: bytes) -> NDArray[np.int64]:
    """From `write_pairs`.

    Args:
        data: the bytes.

    Raises:
        MalformedError: it is not what it should be.
    """
    reader = Reader(data, "pairs")
    (n,) = reader.fields(_COUNT)
    ids: NDArray[np.int64] = reader.array("int64", (n, 2))
    reader.done()
    return ids


def write_means(means: Array, room_bytes: int) -> list[bytes]:
    """Means [n, 3] (m) in float32, in parts that fit into `room_bytes`.

    Args:
        means: in the common frame, in the order of the matches.
        room_bytes: of a part.
    """
    step = (room_bytes - _PART.size) // _MEAN_BYTES
    cuts = range(0, len(means), step)
    return [
        _PART.pack(k, len(means[k : k + step])) + array_bytes(means[k : k + step], "float32") for k in cuts
    ]


def read_means(data: bytes, count: int) -> tuple[int, Array]:
    """Place of the first, and means [n, 3], from a part.

    Args:
        data: the bytes.
        count: of all matches.

    Raises:
        MalformedError: it is not what it should be.
    """
    reader = Reader(data, "means")
    first, n = reader.fields(_PART)
    if first + n > count:
        raise MalformedError("means: of more Gaussians than were matched")
    means = reader.array("float32", (n, 3)).astype(np.float64)
    reader.done()
    if np.abs(means).max(initial=0.0) > MAX_COORDINATE:
        raise MalformedError("means: an impossible place")
    return first, means
