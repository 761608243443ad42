"""Bytes of the messages by which robots find their frames. Little-endian; read as strictly as those of the exchange."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from pipeline.consensus.elimination import Block, Variable
from pipeline.exchange.packets import MalformedError
from pipeline.exchange.wire import MAX_TEAM, Reader, array_bytes
from pipeline.geometry import se3, so3

Array = NDArray[np.float64]


class Code(IntEnum):
    """First byte of a message of kind POSE_GRAPH."""

    ROSTER = 1  # flooded: one robot's neighbours
    KEYFRAMES = 2  # to a neighbour: own keyframes that the pair's closures name, in the own map
    VERDICT = 3  # lower to higher name: which closures the iteration starts with
    FRAME = 4  # flooded: relative frame of two robots and how many closures agree on it
    FRONT = 5  # elimination, up the tree: variables that the subtree shares with others
    BLOCK = 6  # elimination, up the tree: what is left of the subtree's cost after elimination
    STEP = 7  # elimination, down the tree: how the shared variables move


@dataclass(frozen=True)
class Roster:
    """One robot and a bit mask of its neighbours."""

    robot: int
    neighbours: int


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
    return _ROSTER.pack(Code.ROSTER, roster.robot, roster.neighbours)


def read_roster(data: bytes, team: int) -> Roster:
    """From ROSTER."""
    reader = Reader(data, "roster")
    _, robot, neighbours = reader.fields(_ROSTER)
    reader.done()
    if robot >= team or neighbours >> team or neighbours >> robot & 1:
        raise MalformedError("roster: names a robot outside the team, or its own as neighbour")
    return Roster(robot, neighbours)


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


# --- elimination


_FRONT = struct.Struct("<BI")
_BLOCK = struct.Struct("<BIIddB")
_STEP = struct.Struct("<BIBdI")
_REWEIGHTED, _UNSURE, _DOUBLE, _NEW = 1, 2, 4, 8
_ACCEPTED, _FINISHED, _FRESH = 1, 2, 4
_UPPER = np.triu_indices(6)


@dataclass(frozen=True)
class Step:
    """The root's answer to the blocks of one exchange.

    accepted: the last step lowered the cost; else everybody goes back to where it was before. finished: this is the
    last message. fresh: everybody linearises anew. damping: for the next blocks. delta: [s, 6], steps of the variables
    shared with the parent.
    """

    exchange: int
    accepted: bool
    finished: bool
    fresh: bool
    damping: float
    delta: Array


def write_front(everybody: Mapping[Variable, int]) -> bytes:
    """Bytes of FRONT, 14 per variable: owner, keyframe, mask of all robots that have it (0: owner not below)."""
    names = sorted(everybody)
    return b"".join(
        [
            _FRONT.pack(Code.FRONT, len(names)),
            array_bytes([owner for owner, _ in names], "uint16"),
            array_bytes([keyframe for _, keyframe in names], "uint32"),
            array_bytes(np.array([everybody[v] for v in names], dtype=np.uint64), "uint64"),
        ]
    )


def read_front(data: bytes, team: int) -> dict[Variable, int]:
    """From FRONT."""
    reader = Reader(data, "front")
    _, n = reader.fields(_FRONT)
    owners = reader.array("uint16", (n,)).tolist()
    keyframes = reader.array("uint32", (n,)).tolist()
    masks = reader.array("uint64", (n,)).tolist()
    reader.done()
    names = list(zip(owners, keyframes, strict=True))
    if max(owners, default=0) >= team or any(mask >> team for mask in masks):
        raise MalformedError("front: names a robot outside the team")
    if names != sorted(set(names)):
        raise MalformedError("front: variables must ascend")
    return dict(zip(names, masks, strict=True))


def write_block(exchange: int, block: Block, precision: str) -> bytes:
    """Bytes of BLOCK. Of H the upper triangle, and of its 6x6 parts beside the diagonal those that are not zero.

    precision: float32 or float64, of H; the gradient, which decides where the iteration ends, is always float64.
    """
    n = len(block.g) // 6
    flags = _REWEIGHTED * block.reweighted + _UNSURE * block.unsure + _DOUBLE * (precision == "float64")
    flags += _NEW * (block.H is not None)
    head = _BLOCK.pack(Code.BLOCK, exchange, n, block.cost, block.largest_step, flags)
    if block.H is None:
        return head + array_bytes(block.g, "float64")
    parts = block.H.reshape(n, 6, n, 6).transpose(0, 2, 1, 3)
    beside = parts[np.triu_indices(n, 1)].reshape(-1, 36)
    filled = beside.any(axis=1)
    diagonal = parts[np.arange(n), np.arange(n)][:, _UPPER[0], _UPPER[1]]
    return b"".join(
        [
            head,
            array_bytes(block.g, "float64"),
            array_bytes(diagonal, precision),
            np.packbits(filled, bitorder="little").tobytes(),
            array_bytes(beside[filled], precision),
        ]
    )


def read_block(data: bytes, variables: int) -> tuple[int, Block]:
    """Number of the exchange and the block, over so many variables."""
    reader = Reader(data, "block")
    _, exchange, n, cost, largest_step, flags = reader.fields(_BLOCK)
    if n != variables or not (cost >= 0 and largest_step >= 0) or flags >= 2 * _NEW:
        raise MalformedError(f"block: over {n} variables, expected {variables}; or impossible numbers")
    g = reader.array("float64", (6 * n,))
    H = _read_matrix(reader, n, "float64" if flags & _DOUBLE else "float32") if flags & _NEW else None
    reader.done()
    return exchange, Block(H, g, cost, largest_step, bool(flags & _REWEIGHTED), bool(flags & _UNSURE))


def _read_matrix(reader: Reader, n: int, precision: str) -> Array:
    """A symmetric matrix [6 n, 6 n] of 6x6 parts."""
    diagonal = reader.array(precision, (n, 21))
    off = n * (n - 1) // 2
    filled = np.unpackbits(reader.array("uint8", (-(-off // 8),)), count=off, bitorder="little").astype(bool)
    beside = reader.array(precision, (int(filled.sum()), 6, 6))
    parts = np.zeros((n, n, 6, 6))
    rows, columns = (index[filled] for index in np.triu_indices(n, 1))
    parts[rows, columns], parts[columns, rows] = beside, beside.transpose(0, 2, 1)
    own = np.arange(n)[:, None]
    parts[own, own, _UPPER[0], _UPPER[1]] = parts[own, own, _UPPER[1], _UPPER[0]] = diagonal
    return np.ascontiguousarray(parts.transpose(0, 2, 1, 3)).reshape(6 * n, 6 * n)


def write_step(step: Step) -> bytes:
    """Bytes of STEP: 48 per shared variable."""
    flags = _ACCEPTED * step.accepted + _FINISHED * step.finished + _FRESH * step.fresh
    head = _STEP.pack(Code.STEP, step.exchange, flags, step.damping, len(step.delta))
    return head + array_bytes(step.delta, "float64")


def read_step(data: bytes, variables: int) -> Step:
    """From STEP over so many variables; without steps if it was not accepted."""
    reader = Reader(data, "step")
    _, exchange, flags, damping, n = reader.fields(_STEP)
    delta = reader.array("float64", (n, 6))
    reader.done()
    accepted = bool(flags & _ACCEPTED)
    if flags >= 2 * _FRESH or n != accepted * variables or not damping >= 0:
        raise MalformedError(f"step: over {n} variables, expected {variables}; or impossible numbers")
    return Step(exchange, accepted, bool(flags & _FINISHED), bool(flags & _FRESH), damping, delta)


assert MAX_TEAM <= 64  # masks of robots are 64 bits
