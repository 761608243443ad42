"""Consensus on matched Gaussians by rounds: relaxed ADMM with edge variables, and the paper's averaging (12).

In the flat chart theta [13] the objective is a sum of squares, F = sum_i 1/2 |theta - theta_i|^2_{W_i} per track, whose
minimum is theta* = (sum W_i)^+ sum W_i theta_i: method section 4. Mode `evidence` sends (theta_i, W_i) once and lets
all robots take that sum (`fusion.fuse`). Here robots keep their evidence to themselves and talk in rounds:

    admm    x = (W + sum_j rho_j)^-1 (W theta + sum_j rho_j y_j),   sends m = 2 x - y_j,   y_j <- y_j + a (m_j - y_j)
    paper   x <- (w + sum_j w_j)^-1 (w x + sum_j w_j x_j),   sends x and w: (12), with weights per coordinate

admm has the minimum as its fixed point, whatever is lost on the way; (12) ends somewhere else as soon as there are
more than two robots. rho_j = max(W_i, W_j, f) per coordinate, f a share of the median of what is known: both ends
compute it from the same rounded diagonals, and neighbors that know nothing still pass on what others know.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.base import Config
from duagc.pipeline.consensus.weights import Weights

Index = NDArray[np.int64]
COORDINATES = 13


class GaussianConsensusConfig(Config):
    """Rounds on matched Gaussians."""

    mode: Literal["admm", "paper"] = "admm"
    """Relaxed ADMM with edge variables, or the weighted averages of the paper's (12)."""
    relaxation: float = Field(default=0.9, gt=0.0, lt=1.0)
    """Share of the way that an edge variable goes to what arrived."""
    penalty_floor: float = Field(default=0.5, gt=0.0)
    """Least penalty, as a share of the median of the non-zero information of a coordinate on a link."""
    wire: Literal["float32", "float64"] = "float32"
    """Precision of values in a packet; weights are always float32."""


@dataclass(frozen=True)
class Shares:
    """Who works on which tracks: what all robots of a team compute alike from the tracks and the links.

    rows: by robot, tracks that it holds a value of, ascending; those of which it has evidence, and those that it only
    passes on between members that have no link. shared: by pair of linked robots, lower name first, tracks that both
    hold, ascending.
    """

    rows: Mapping[str, Index]
    shared: Mapping[tuple[str, str], Index]

    @staticmethod
    def of(members: Mapping[str, Index], linked: Mapping[str, Sequence[str]]) -> Shares:
        """Shares of a team.

        Args:
            members: by robot, the tracks that it has evidence of, ascending.
            linked: by robot, its neighbors.
        """
        tracks = 1 + max((int(m[-1]) for m in members.values() if len(m)), default=-1)
        names = sorted(linked)
        has = np.zeros((tracks, len(names)), dtype=bool)
        for k, name in enumerate(names):
            has[members.get(name, np.zeros(0, np.int64)), k] = True
        groups, which = np.unique(has, axis=0, return_inverse=True)
        wide = np.array([_connected(group, names, linked) for group in groups], dtype=bool)
        holds = wide.reshape(len(groups), len(names))[which.ravel()] if tracks else has
        rows = {name: np.flatnonzero(holds[:, k]) for k, name in enumerate(names)}
        shared = {
            (one, other): np.flatnonzero(holds[:, names.index(one)] & holds[:, names.index(other)])
            for one in names
            for other in linked[one]
            if one < other
        }
        return Shares(rows, shared)


def _connected(group: NDArray[np.bool_], names: list[str], linked: Mapping[str, Sequence[str]]) -> list[bool]:
    """Members [n] of a track and the robots on the shortest ways between them (ties by name)."""
    inside = [name for name, member in zip(names, group, strict=True) if member]
    if not inside:
        return [False] * len(names)
    joined = {inside[0]}
    while missing := [name for name in inside if name not in joined]:
        before: dict[str, str | None] = dict.fromkeys(sorted(joined))
        queue = list(before)
        while queue and not any(name in before for name in missing):
            next_queue = []
            for name in queue:
                for neighbor in sorted(linked[name]):
                    if neighbor not in before:
                        before[neighbor] = name
                        next_queue.append(neighbor)
            queue = next_queue
        reached = [name for name in missing if name in before]
        if not reached:
            break  # the rest of the team cannot be reached: every part agrees for itself
        at: str | None = reached[0]
        while at is not None and at not in joined:
            joined.add(at)
            at = before[at]
    return [name in joined or member for name, member in zip(names, group, strict=True)]


@dataclass(frozen=True)
class GaussianPacket:
    """What one robot sends to a neighbor in one round, of the tracks that they share, in their order.

    sequence: counts up; a value is not replaced by an older one. first: place of the first row among the shared
    tracks. weights: float32 [m, 13], None once the neighbor has them. has_weights: the sender has all of the
    receiver's. values: [m, 13] in the wire's precision, None before that.
    """

    sequence: int
    first: int
    weights: NDArray[np.float32] | None
    has_weights: bool
    values: NDArray[np.floating] | None

    def parts(self, room_bytes: int) -> Iterator[GaussianPacket]:
        """The same in parts of limited size, each useful alone.

        Args:
            room_bytes: most bytes of the arrays of a part; a part has at least one row.
        """
        arrays = [a for a in (self.weights, self.values) if a is not None]
        rows = len(arrays[0]) if arrays else 0
        step = max(1, room_bytes // max(1, sum(a.itemsize * COORDINATES for a in arrays)))
        for start in range(0, max(rows, 1), step):
            part = slice(start, start + step)
            yield GaussianPacket(
                self.sequence,
                self.first + start,
                None if self.weights is None else self.weights[part],
                self.has_weights,
                None if self.values is None else self.values[part],
            )

    @property
    def size_bytes(self) -> int:
        """Bytes of the arrays; what carries them comes on top."""
        return sum(a.nbytes for a in (self.weights, self.values) if a is not None)


@dataclass
class _Link:
    """One end of a link: own rows that are shared, penalty and edge variable, or the neighbor's last value."""

    rows: Index
    own_weights: NDArray[np.float32]
    peer_weights: Array  # NaN until heard
    heard: Index  # sequence of the last value, by row
    peer_has_weights: bool = False
    penalty: Array | None = None  # known when all of the peer's weights are
    edge: Array | None = None  # admm: y; paper: the neighbor's x as last heard, its own start before


class GaussianAgent:
    """One robot's rounds on the tracks that it holds. Packets of a round are made before any of them is received."""

    def __init__(
        self, theta: Array, weights: Weights, links: Mapping[str, Index], config: GaussianConsensusConfig
    ) -> None:
        """Start with own evidence.

        Args:
            theta: [n, 13], common frame; of tracks that are only passed on, anything.
            weights: of these values; zero for tracks that are only passed on.
            links: by neighbor, own rows of the tracks that both hold, in an order that both have.
            config: of the rounds.
        """
        self.config = config
        self._own = weights
        self._information = weights.times(np.asarray(theta, np.float64))
        self._diagonal = weights.diagonal()
        self._links = {
            peer: _Link(
                np.asarray(rows, np.int64),
                self._diagonal[rows].astype(np.float32),
                np.full((len(rows), COORDINATES), np.nan),
                np.full(len(rows), -1, dtype=np.int64),
            )
            for peer, rows in sorted(links.items())
        }
        self._inverse: Weights | None = None
        self._sequence = 0
        self.change_sigma = np.inf
        """Largest change of a value in the last step, in standard deviations of what this robot knew of it."""
        self.x = np.array(theta, dtype=np.float64)
        """The values now, [n, 13]."""

    def outgoing(self, peer: str) -> GaussianPacket:
        """What to send to a neighbor in this round.

        Args:
            peer: name of the neighbor.
        """
        link = self._links[peer]
        self._sequence += 1
        values: NDArray[np.floating] | None = None
        if link.edge is not None:
            x = self.x[link.rows]
            values = (2 * x - link.edge if self.config.mode == "admm" else x).astype(self.config.wire)
        weights = None if link.peer_has_weights else link.own_weights
        return GaussianPacket(self._sequence, 0, weights, link.edge is not None, values)

    def receive(self, peer: str, packet: GaussianPacket) -> None:
        """Take a packet of a neighbor, or a part of one; where a later value came before, it is not used.

        Args:
            peer: name of the neighbor.
            packet: rows of the tracks that both share, in their order.
        """
        link = self._links[peer]
        link.peer_has_weights |= packet.has_weights
        if packet.weights is not None and link.edge is None:
            link.peer_weights[packet.first : packet.first + len(packet.weights)] = packet.weights
            if not np.isnan(link.peer_weights).any():
                self._begin(link)
        if packet.values is None or link.edge is None:
            return
        part = slice(packet.first, packet.first + len(packet.values))
        news = (link.heard[part] < packet.sequence)[:, None]
        link.heard[part] = np.maximum(link.heard[part], packet.sequence)
        share = self.config.relaxation if self.config.mode == "admm" else 1.0
        link.edge[part] += np.where(news, share * (packet.values.astype(np.float64) - link.edge[part]), 0.0)

    def _begin(self, link: _Link) -> None:
        """The neighbor's weights are here: the link takes part from now on."""
        largest = np.maximum(link.own_weights.astype(np.float64), link.peer_weights)
        floor = np.array([_median(column[column > 0]) for column in largest.T])
        link.penalty = np.maximum(largest, self.config.penalty_floor * floor)
        link.edge = self.x[link.rows].copy()
        self._inverse = None

    def step(self) -> None:
        """New values from own evidence and what arrived; nothing moves without a neighbor."""
        before = self.x
        self.x = self._admm() if self.config.mode == "admm" else self._average()
        moved = np.abs(self.x - before) * np.sqrt(self._diagonal)
        self.change_sigma = float(moved.max(initial=0.0))

    def _admm(self) -> Array:
        right = self._information.copy()
        active = [link for link in self._links.values() if link.penalty is not None]
        if not active:
            return self.x
        if self._inverse is None:
            total = np.zeros_like(self.x)
            for link in active:
                assert link.penalty is not None
                total[link.rows] += link.penalty
            self._inverse = self._own.plus(total).inverse()
        for link in active:
            assert link.penalty is not None
            assert link.edge is not None
            right[link.rows] += link.penalty * link.edge
        return self._inverse.times(right)

    def _average(self) -> Array:
        """(12) with weights per coordinate, from the values of the round before."""
        total, pull = self._diagonal.copy(), self._diagonal * self.x
        for link in self._links.values():
            if link.edge is not None:
                weights = np.where(link.heard[:, None] >= 0, link.peer_weights, 0.0)
                total[link.rows] += weights
                pull[link.rows] += weights * link.edge
        return np.where(total > 0, pull / np.where(total > 0, total, 1.0), self.x)


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else 1.0


def optimum(theta: Sequence[Array], weights: Sequence[Weights], rows: Sequence[Index], tracks: int) -> Array:
    """theta* [tracks, 13] = (sum W)^+ sum W theta over all robots: what one computer with all evidence would say.

    Args:
        theta: by robot, values [n, 13].
        weights: by robot, of these values.
        rows: by robot, the tracks [n] that they belong to.
        tracks: how many there are.
    """
    total, pull = total_weights(weights, rows, tracks), np.zeros((tracks, COORDINATES))
    for x, w, at in zip(theta, weights, rows, strict=True):
        pull[at] += w.times(x)
    return total.inverse().times(pull)


def total_weights(weights: Sequence[Weights], rows: Sequence[Index], tracks: int) -> Weights:
    """Sum of all robots' weights per track.

    Args:
        weights: of the rows of each robot.
        rows: track of every row of each robot; a robot has a track once.
        tracks: how many.
    """
    total = Weights.of_diagonal(np.zeros((tracks, COORDINATES)))
    for w, at in zip(weights, rows, strict=True):
        total.position[at] += w.position
        total.shape[at] += w.shape
        total.color[at] += w.color
        total.opacity[at] += w.opacity
    return total
