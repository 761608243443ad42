"""Bytes of messages, and their strict reading: state, relative frames, space, matches. Little-endian.

Readers trust nothing: every count is checked against the bytes that are there, every index against its limit, every
number that enters the mathematics must be finite. What does not fit raises MalformedError with the reason. The other
modules here are as strict.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array, array_bytes
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph.cycle_consistency import Proposal

MAX_KEYFRAMES = 100_000
MAX_COORDINATE = 1e6  # m, or units of theta; beyond it positions lose their meaning
MAX_INFORMATION = 1e15  # of a coordinate, 1/m^2: 30 nm
ROTATION_TOLERANCE = 1e-6  # of R R' = 1 in a pose that a neighbor sent


class Reader:
    """Walks through the bytes of a message and never past their end."""

    def __init__(self, data: bytes, what: str) -> None:
        self.data, self.what, self.position = data, what, 0

    def fields(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Fixed fields."""
        return layout.unpack(self._take(layout.size))

    def array(self, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """An array in C order; floats must be finite.

        Args:
            dtype: of the numbers, as numpy names it.
            shape: of the array.
        Raises:
            MalformedError: there are too few bytes, or a float is not finite.
        """
        kind = np.dtype(dtype).newbyteorder("<")
        count = 1
        for n in shape:
            count *= n
        values = np.frombuffer(self._take(count * kind.itemsize), kind).reshape(shape).astype(dtype)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise MalformedError(f"{self.what}: not a finite number")
        return values

    def poses(self, n: int) -> Array:
        """Motions [n, 4, 4] from their upper rows, float64.

        Args:
            n: how many there must be.
        """
        rows = self.array("float64", (n, 3, 4))  # first: n is checked against the bytes that are there
        T = np.tile(np.eye(4), (n, 1, 1))
        T[:, :3] = rows
        R = T[:, :3, :3]
        if np.abs(R).max(initial=0.0) > 2.0 or np.abs(T[:, :3, 3]).max(initial=0.0) > MAX_COORDINATE:
            raise MalformedError(f"{self.what}: a pose is not a rigid motion, or beyond {MAX_COORDINATE:g} m")
        off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(initial=0.0)
        if off > ROTATION_TOLERANCE or np.linalg.det(R).min(initial=1.0) < 0:
            raise MalformedError(f"{self.what}: a pose is not a rigid motion")
        return T

    def motions(self, n: int, precision: str) -> Array:
        """Motions [n, 4, 4] from quaternions and translations, all quaternions first.

        Args:
            n: how many there must be.
            precision: of the numbers, float32 or float64.
        """
        quats_wxyz = self.array(precision, (n, 4)).astype(np.float64)
        translations = self.array(precision, (n, 3)).astype(np.float64)
        off = np.abs((quats_wxyz**2).sum(axis=1) - 1).max(initial=0.0)
        if off > 1e-3 or np.abs(translations).max(initial=0.0) > MAX_COORDINATE:
            raise MalformedError(f"{self.what}: not a rigid motion, or beyond {MAX_COORDINATE:g} m")
        return se3.from_quat_translation(quats_wxyz, translations)

    def done(self) -> None:
        """Check that nothing is left."""
        if self.position != len(self.data):
            raise MalformedError(f"{self.what}: {len(self.data) - self.position} bytes too many")

    def _take(self, size: int) -> bytes:
        if self.position + size > len(self.data):
            raise MalformedError(f"{self.what}: {len(self.data)} bytes, more were announced")
        part = self.data[self.position : self.position + size]
        self.position += size
        return part


def pose_bytes(T: Array) -> bytes:
    """Upper rows of motions [..., 4, 4], float64."""
    return array_bytes(np.asarray(T)[..., :3, :], "float64")


def motion_bytes(T: Array, precision: str) -> bytes:
    """Motions [n, 4, 4] as quaternions and translations, all quaternions first.

    Args:
        T: [n, 4, 4], meters.
        precision: of the numbers, float32 or float64.
    """
    return array_bytes(so3.to_quat_wxyz(T[:, :3, :3]), precision) + array_bytes(T[:, :3, 3], precision)


# --- state: once per link and round


@dataclass(frozen=True)
class State:
    """The state of an agent, which it sends to its neighbors in every round.

    Attributes:
        links: pairs of robots whose relative frame it knows, a bit mask over the pairs of the team (`pair_bit`).
        revoked_links: those of them that it knows to be revoked, likewise; the rest of the state is about the team
            without them.
        alignment_hops: all agents within fewer hops have decided on all their links and know the same frames; 0: this
            one has not.
        converged_hops: all agents within fewer hops have converged; 0: this one has not.
        agreed: its poses are final.
        done: it needs nothing more.
        sources: uint8 [team], where it gets the evidence of each owner from: a neighbor's index, COMPLETE or NOBODY.
    """

    links: int
    revoked_links: int
    alignment_hops: int
    converged_hops: int
    agreed: bool
    done: bool
    sources: NDArray[np.uint8]


COMPLETE, NOBODY = 254, 255
MAX_TEAM = 64
_STATE = struct.Struct("<BBBB")
_SHORT_STATE = struct.Struct("<BBB")
_AGREED, _DONE, _SHORT, _REVOKED = 1, 2, 4, 8  # flags


def pair_bit(a: int, b: int) -> int:
    """The bit of a pair of robots, by index, in a mask over all pairs.

    Args:
        a: index of one robot in the sorted team.
        b: index of the other one.
    """
    lower, higher = min(a, b), max(a, b)
    return 1 << (higher * (higher - 1) // 2 + lower)


def _pairs_bytes(pairs: int, team: int) -> bytes:
    return pairs.to_bytes(_pairs_size(team), "little")


def _pairs_size(team: int) -> int:
    return -(-(team * (team - 1) // 2) // 8)


def _read_pairs(reader: Reader, team: int) -> int:
    """A mask over the pairs of the team."""
    pairs = int.from_bytes(reader.array("uint8", (_pairs_size(team),)).tobytes(), "little")
    if pairs >> (team * (team - 1) // 2):
        raise MalformedError(f"{reader.what}: names a pair outside the team")
    return pairs


def write_state(state: State, *, short: bool = False) -> bytes:
    """Bytes of a state; the poses of the round may follow.

    Args:
        state: of this round.
        short: leave out the sources, and revoked links if there are none: for a team that shares no evidence.
    """
    flags, team = _AGREED * int(state.agreed) | _DONE * int(state.done), len(state.sources)
    if short:
        flags |= _SHORT | _REVOKED * bool(state.revoked_links)
        revoked = _pairs_bytes(state.revoked_links, team) if state.revoked_links else b""
        head = _SHORT_STATE.pack(state.alignment_hops, state.converged_hops, flags)
        return head + _pairs_bytes(state.links, team) + revoked
    head = _STATE.pack(state.alignment_hops, state.converged_hops, flags, team)
    masks = _pairs_bytes(state.links, team) + _pairs_bytes(state.revoked_links, team)
    return head + array_bytes(state.sources, "uint8") + masks


def read_state(data: bytes, team: int) -> tuple[State, bytes]:
    """A state and the bytes that follow it.

    Args:
        data: of the message.
        team: number of robots.
    """
    reader = Reader(data, "state")
    if len(data) > 2 and data[2] & _SHORT:
        alignment_hops, converged_hops, flags = reader.fields(_SHORT_STATE)
        if flags > _AGREED | _DONE | _SHORT | _REVOKED:
            raise MalformedError("state: unknown flags")
        links = _read_pairs(reader, team)
        revoked = _read_pairs(reader, team) if flags & _REVOKED else 0
        sources = np.full(team, NOBODY, np.uint8)
    else:
        alignment_hops, converged_hops, flags, n = reader.fields(_STATE)
        if n != team:
            raise MalformedError(f"state: about a team of {n}, expected {team}")
        if flags > _AGREED | _DONE:
            raise MalformedError("state: unknown flags")
        sources = reader.array("uint8", (n,))
        links, revoked = _read_pairs(reader, team), _read_pairs(reader, team)
    state = State(
        links=links,
        revoked_links=revoked,
        alignment_hops=alignment_hops,
        converged_hops=converged_hops,
        agreed=bool(flags & _AGREED),
        done=bool(flags & _DONE),
        sources=sources,
    )
    return state, data[reader.position :]


def write_labeled(revoked: int, team: int, payload: bytes) -> bytes:
    """Bytes of TREE: a message of the solver, for the team without these links."""
    return _pairs_bytes(revoked, team) + payload


def read_labeled(data: bytes, team: int) -> tuple[int, bytes]:
    """From TREE: the revoked links, and the message.

    Args:
        data: of the message.
        team: number of robots.
    """
    reader = Reader(data, "elimination")
    return _read_pairs(reader, team), data[reader.position :]


# --- relative frames


_FRAME = struct.Struct("<HHB")
_PROPOSAL = struct.Struct("<Iddd")
_SHORT_PROPOSAL = struct.Struct("<Ifff")
_SHORT_PROPOSALS = 128  # added to their number: all in float32
MAX_PROPOSALS = 8


@dataclass(frozen=True)
class RelativeFrames:
    """The relative frame of two robots by their loop closures.

    Attributes:
        lower: lower index of the two.
        higher: higher index.
        proposals: best supported first.
    """

    lower: int
    higher: int
    proposals: tuple[Proposal, ...]


def write_relative_frames(frames: RelativeFrames, *, short: bool = False) -> bytes:
    """Bytes of RELATIVE_FRAME: 129 for one proposal, 49 if it is short.

    Args:
        frames: of one pair.
        short: round to float32, for a team that shares no evidence.
    """
    count = len(frames.proposals) + _SHORT_PROPOSALS * short
    parts = [_FRAME.pack(frames.lower, frames.higher, count)]
    for p in frames.proposals:
        if short:
            parts += [
                _SHORT_PROPOSAL.pack(p.support, *p.variance, p.agreement),
                motion_bytes(p.T_a_b[None], "float32"),
            ]
            continue
        parts += [_PROPOSAL.pack(p.support, *p.variance, p.agreement), pose_bytes(p.T_a_b)]
    return b"".join(parts)


def read_relative_frames(data: bytes, team: int) -> RelativeFrames:
    """From RELATIVE_FRAME.

    Args:
        data: of the message.
        team: number of robots.
    """
    reader = Reader(data, "relative frame")
    lower, higher, count = reader.fields(_FRAME)
    n, short = count % _SHORT_PROPOSALS, count >= _SHORT_PROPOSALS
    if not lower < higher < team or not 1 <= n <= MAX_PROPOSALS:
        raise MalformedError(
            "relative frame: the two robots must be in the team, lower first, and have a frame"
        )
    proposals = []
    for _ in range(n):
        support, *variance, agreement = reader.fields(_SHORT_PROPOSAL if short else _PROPOSAL)
        if not (all(0 < v < MAX_COORDINATE**2 for v in variance) and 0 <= agreement <= 1):
            raise MalformedError("relative frame: impossible variance or agreement")
        T = reader.motions(1, "float32")[0] if short else reader.poses(1)[0]
        proposals.append(Proposal(support, T, (variance[0], variance[1]), agreement))
    reader.done()
    return RelativeFrames(lower, higher, tuple(proposals))


# --- space seen, matched Gaussians


_OWNER = struct.Struct("<HI")


def write_voxels(owner: int, keys: NDArray[np.int64]) -> bytes:
    """Bytes of VOXELS: ascending keys of the voxels that `owner` saw, differences in LEB128.

    Args:
        owner: index of the robot.
        keys: [n], from `evidence_records.seen_voxels`.
    """
    out = bytearray(_OWNER.pack(owner, len(keys)))
    for step in np.diff(keys, prepend=np.int64(0)).tolist():
        while step > 127:
            out.append(step & 127 | 128)
            step >>= 7
        out.append(step)
    return bytes(out)


def read_voxels(data: bytes, team: int) -> tuple[int, NDArray[np.int64]]:
    """From VOXELS: owner and ascending keys.

    Args:
        data: of the message.
        team: number of robots.
    """
    reader = Reader(data, "voxels")
    owner, n = reader.fields(_OWNER)
    values = np.frombuffer(data, np.uint8, offset=_OWNER.size).astype(np.int64)
    last = np.flatnonzero(values < 128)
    if owner >= team or len(last) != n or (len(values) and values[-1] >= 128):
        raise MalformedError("voxels: the list does not have the announced length")
    first = np.concatenate([[0], last[:-1] + 1]) if n else last
    place = np.arange(len(values)) - np.repeat(first, last - first + 1)
    if place.max(initial=0) > 8:
        raise MalformedError("voxels: a number is too large")
    steps = np.add.reduceat((values & 127) << (7 * place), first) if n else np.zeros(0, np.int64)
    if n > 1 and steps[1:].min() < 1:
        raise MalformedError("voxels: keys must ascend")
    if float(steps.astype(np.float64).sum()) >= 2.0**63:
        raise MalformedError("voxels: a number is too large")
    return owner, np.cumsum(steps)


_PAIRS = struct.Struct("<HHHI")


@dataclass(frozen=True)
class PairList:
    """Matched Gaussians of two robots.

    Attributes:
        lower: lower index of the two.
        higher: higher index.
        version: of the list; a later one replaces an earlier one.
        ids: int64 [n, 2], lower index first.
    """

    lower: int
    higher: int
    version: int
    ids: NDArray[np.int64]


def write_pairs(pairs: PairList) -> bytes:
    """Bytes of PAIRS."""
    head = _PAIRS.pack(pairs.lower, pairs.higher, pairs.version, len(pairs.ids))
    return head + array_bytes(pairs.ids, "int64")


def read_pairs(data: bytes, team: int) -> PairList:
    """From PAIRS."""
    reader = Reader(data, "pairs")
    lower, higher, version, n = reader.fields(_PAIRS)
    if not lower < higher < team:
        raise MalformedError("pairs: the two robots must be in the team, lower first")
    ids = reader.array("int64", (n, 2))
    reader.done()
    if len(np.unique(ids[:, 0])) != n or len(np.unique(ids[:, 1])) != n:
        raise MalformedError("pairs: a Gaussian is matched twice")
    return PairList(lower, higher, version, ids)
