"""Bytes of the messages by which robots find their frames. Little-endian; read as strictly as those of the exchange."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.exchange.wire.state_wire import Reader, array_bytes
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.network.packets import MalformedError

Array = NDArray[np.float64]


class Code(IntEnum):
    """First byte of a message of kind POSE_GRAPH."""

    ROSTER = 1  # flooded: one robot's neighbors
    KEYFRAMES = 2  # to a neighbor: own keyframes that the pair's closures name, in the own map
    VERDICT = 3  # lower to higher name: which closures the iteration starts with
    FRAME = 4  # flooded: relative frame of two robots and how many closures agree on it


@dataclass(frozen=True)
class Roster:
    """One robot and a bit mask of its neighbors."""

    robot: int
    neighbors: int


@dataclass(frozen=True)
class NamedKeyframes:
    """keyframes int32 [s], ascending; T_map_keyframe [s, 4, 4] in the sender's map; drift [s, 2] (m^2, rad^2)."""

    keyframes: NDArray[np.int32]
    T_map_keyframe: Array
    drift: Array


@dataclass(frozen=True)
class PairFrame:
    """Map frame of the higher-named robot in that of the lower one, and the closures that agree on it."""

    lower: int
    higher: int
    support: int
    T_lower_higher: Array


_ROSTER = struct.Struct("<BHQ")
_COUNT = struct.Struct("<BI")
_FRAME = struct.Struct("<BHHI")


def write_roster(roster: Roster) -> bytes:
    """Bytes of ROSTER."""
    return _ROSTER.pack(Code.ROSTER, roster.robot, roster.neighbors)


def read_roster(data: bytes, team: int) -> Roster:
    """From ROSTER."""
    reader = Reader(data, "roster")
    _, robot, neighbors = reader.fields(_ROSTER)
    reader.done()
    if robot >= team or neighbors >> team or neighbors >> robot & 1:
        raise MalformedError("roster: names a robot outside the team, or its own as neighbor")
    return Roster(robot, neighbors)


def write_keyframes(named: NamedKeyframes, precision: str) -> bytes:
    """Bytes of KEYFRAMES: 40 per keyframe with poses in float32, 68 in float64."""
    T = named.T_map_keyframe
    return b"".join(
        [
            _COUNT.pack(Code.KEYFRAMES, len(named.keyframes)),
            array_bytes(named.keyframes, "int32"),
            _motion_bytes(T, precision),
            array_bytes(named.drift, "float32"),
        ]
    )


def read_keyframes(data: bytes, expected: NDArray[np.int32], precision: str) -> NamedKeyframes:
    """From KEYFRAMES about exactly the keyframes that the closures name."""
    reader = Reader(data, "keyframes")
    _, n = reader.fields(_COUNT)
    if n != len(expected):
        raise MalformedError(f"keyframes: {n}, the closures name {len(expected)}")
    keyframes = reader.array("int32", (n,))
    T = _read_motions(reader, n, precision)
    drift = reader.array("float32", (n, 2)).astype(np.float64)
    reader.done()
    if not np.array_equal(keyframes, expected) or drift.min(initial=0.0) < 0:
        raise MalformedError("keyframes: not those that the closures name, or a negative variance")
    return NamedKeyframes(keyframes, T, drift)


def write_verdict(keep: NDArray[np.bool_]) -> bytes:
    """Bytes of VERDICT: one bit per closure of the pair, in the order that both ends have."""
    return _COUNT.pack(Code.VERDICT, len(keep)) + np.packbits(keep, bitorder="little").tobytes()


def read_verdict(data: bytes, closures: int) -> NDArray[np.bool_]:
    """From VERDICT."""
    reader = Reader(data, "verdict")
    _, n = reader.fields(_COUNT)
    if n != closures:
        raise MalformedError(f"verdict: on {n} closures, the pair has {closures}")
    bits = reader.array("uint8", (-(-n // 8),))
    reader.done()
    return np.unpackbits(bits, count=n, bitorder="little").astype(bool)


def write_frame(frame: PairFrame) -> bytes:
    """Bytes of FRAME."""
    head = _FRAME.pack(Code.FRAME, frame.lower, frame.higher, frame.support)
    return head + _motion_bytes(frame.T_lower_higher[None], "float32")


def read_frame(data: bytes, team: int) -> PairFrame:
    """From FRAME."""
    reader = Reader(data, "frame")
    _, lower, higher, support = reader.fields(_FRAME)
    T = _read_motions(reader, 1, "float32")[0]
    reader.done()
    if not lower < higher < team:
        raise MalformedError("frame: the two robots must be in the team, lower first")
    return PairFrame(lower, higher, support, T)


def _motion_bytes(T: Array, precision: str) -> bytes:
    """Motions [n, 4, 4] as quaternions and translations."""
    return array_bytes(so3.to_quat_wxyz(T[:, :3, :3]), precision) + array_bytes(T[:, :3, 3], precision)


def _read_motions(reader: Reader, n: int, precision: str) -> Array:
    quats, t = reader.array(precision, (n, 4)).astype(np.float64), reader.array(precision, (n, 3))
    if n and np.abs((quats**2).sum(axis=1) - 1).max() > 1e-3:
        raise MalformedError(f"{reader.what}: not rigid motions")
    return se3.from_quat_translation(quats, t.astype(np.float64))
