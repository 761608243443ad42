"""Bytes of messages: state, relative frames, space, matches. Strict as `reader`."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import array_bytes
from duagc.pipeline.exchange.wire.reader import MAX_COORDINATE, Reader, motion_bytes, pose_bytes
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph.cycle_consistency import Proposal

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
    """Bytes of TREE: a message of the solver, for the team without these links.

    Args:
        revoked: mask over the pairs of the team, as in `State`.
        team: number of robots.
        payload: message of the solver.
    """
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
    """Bytes of PAIRS.

    Args:
        pairs: of one pair of robots.
    """
    head = _PAIRS.pack(pairs.lower, pairs.higher, pairs.version, len(pairs.ids))
    return head + array_bytes(pairs.ids, "int64")


def read_pairs(data: bytes, team: int) -> PairList:
    """From PAIRS.

    Args:
        data: of the message.
        team: number of robots.
    """
    reader = Reader(data, "pairs")
    lower, higher, version, n = reader.fields(_PAIRS)
    if not lower < higher < team:
        raise MalformedError("pairs: the two robots must be in the team, lower first")
    ids = reader.array("int64", (n, 2))
    reader.done()
    if len(np.unique(ids[:, 0])) != n or len(np.unique(ids[:, 1])) != n:
        raise MalformedError("pairs: a Gaussian is matched twice")
    return PairList(lower, higher, version, ids)
