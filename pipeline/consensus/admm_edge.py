"""One end of a link between two robots, and what crosses it: shared keyframes once, a pose packet per round."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import LoopClosureConfig, PoseConsensusConfig
from duagc.pipeline.geometry import so3
from duagc.pipeline.posegraph.gnc import RobustWeights
from duagc.pipeline.posegraph.least_squares import difference, retract
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePoses, closures_as_relative_poses

STEP_M = 2.0**-27
"""Steps of translations on the wire `fixed`: 7.5 nm."""
BLOCK = [0, 0, 0, 1, 1, 1]
"""Translation, rotation -> the six rows of a tangent."""
STEADY = 1e-3
"""Largest change of a link past its initial transient (m, rad)."""
REMEMBERED = 8
"""Arrivals that must have changed little before an end has converged."""


@dataclass(frozen=True)
class SharedKeyframes:
    """Set-up message of a link, from the end that holds the loop closures to the end that owns the keyframes.

    Attributes:
        keyframes: int32 [s], indices of the receiver's keyframes, ascending.
        metric: float32 [s, 6], diagonal of the information (translation, rotation) that the pair's loop closures have
            on each, isotropic per block, so that it is the same in every frame; both ends must use the same numbers.
    """

    keyframes: NDArray[np.int32]
    metric: NDArray[np.float32]


@dataclass(frozen=True)
class PosePacket:
    """One direction of one link in one round. It may be cut by keyframe; every part is useful alone.

    Attributes:
        sequence: counts the sender's packets on this link.
        version: of the penalties.
        keyframes: int32 [s], indices of the non-holder's keyframes.
        quats_wxyz: [s, 4], of 2 x - y in the sender's world frame; float32 or float64.
        translations: [s, 3], of the same, meters; float32, or float64 in multiples of STEP_M.
        penalties: float32 [2] (translation, rotation) of this version.
        curvature: float32 [2] or None, the curvature that the sender measured in this version.
        converged: the sender has converged.
    """

    sequence: int
    version: int
    keyframes: NDArray[np.int32]
    quats_wxyz: NDArray[Any]
    translations: NDArray[Any]
    penalties: NDArray[np.float32]
    curvature: NDArray[np.float32] | None
    converged: bool

    def part(self, index: slice | NDArray[np.int64]) -> PosePacket:
        """The packet with some of its keyframes only.

        Args:
            index: slice, or places [k] among the keyframes of the packet.
        """
        return replace(
            self,
            keyframes=self.keyframes[index],
            quats_wxyz=self.quats_wxyz[index],
            translations=self.translations[index],
        )


@dataclass
class AdmmEdge:
    """One end of a link. Arrays over its s shared keyframes, which belong to the end that holds no loop closures."""

    peer: str
    decides: bool
    keyframes: NDArray[np.int32]
    metric: Array
    slots: NDArray[np.int64]  # [s] index of the shared keyframes among this robot's variables
    closures: tuple[LoopClosure, ...]  # held ones; none at the other end
    factors: RelativePoses  # the same, between this robot's variables
    robust: RobustWeights  # of the same
    penalties: Array  # [2] translation, rotation
    offset: Array = field(init=False)  # [s, 6] d = x - y (translation, rotation)
    version: int = 0
    sent: int = 0
    received: float = 0.0  # packets since the last change of penalties, parts counted by their share
    received_total: float = 0.0
    adapting_from: float = 0.0  # received_total when the robust weights became final after their schedule
    newest: NDArray[np.int64] = field(init=False)  # [s] sequence last used
    newest_header: int = 0
    active: NDArray[np.bool_] = field(init=False)  # [s] named by some loop closure with weight
    active_version: int = 0  # of the mask
    changes: Array = field(init=False)  # [s, REMEMBERED] by the last arrivals (m, rad), the newest last
    reference: tuple[Array, Array] | None = None  # force and poses when the curvature window began
    peer_curvature: Array | None = None
    peer_converged: bool = False

    def __post_init__(self) -> None:
        self.offset = np.zeros((len(self.keyframes), 6))
        self.newest = np.zeros(len(self.keyframes), np.int64)
        self.changes = np.full((len(self.keyframes), REMEMBERED), np.inf)
        self.active = np.ones(len(self.keyframes), dtype=bool)

    @classmethod
    def begin(
        cls,
        peer: str,
        shared: SharedKeyframes,
        closures: tuple[LoopClosure, ...],
        kept: NDArray[np.bool_],
        *,
        decides: bool,
        config: PoseConsensusConfig,
    ) -> AdmmEdge:
        """An end before the first step.

        Args:
            peer: name of the other robot.
            shared: keyframes that both ends have.
            closures: that this end holds; none at the other end.
            kept: bool per loop closure, start of the robust weights.
            decides: whether this end decides on penalties.
            config: the same at all robots.
        """
        return cls(
            peer=peer,
            decides=decides,
            keyframes=np.asarray(shared.keyframes, dtype=np.int32),
            metric=np.asarray(shared.metric, dtype=np.float64),
            slots=np.asarray(shared.keyframes, dtype=np.int64),
            closures=closures,
            factors=RelativePoses.empty(),
            robust=RobustWeights(kept.astype(np.float64), config, first_mu=config.team_schedule().first_mu),
            penalties=np.full(2, np.float64(np.float32(config.penalty_start))),
        )

    def lay_out(self, first: int, config: LoopClosureConfig) -> RelativePoses:
        """Place the copies of the shared keyframes among the variables of the robot that holds the loop closures.

        Args:
            first: index of the first copy.
            config: floors of the covariances.

        Returns:
            The loop closures as factors between these variables.
        """
        self.slots = first + np.arange(len(self.keyframes))
        own = [c.own_keyframe for c in self.closures]
        copy = self.slots[np.searchsorted(self.keyframes, [c.peer_keyframe for c in self.closures])]
        self.factors = closures_as_relative_poses(self.closures, own, copy, config)
        return self.factors

    @property
    def holds(self) -> bool:
        """Whether this end has the loop closures of the pair."""
        return bool(self.closures)

    def penalty(self) -> Array:
        """Diagonal penalty [s, 6]."""
        return self.metric * self.penalties[BLOCK] * self.active[:, None]

    def force(self) -> Array:
        """W (x - y) [s, 6]: the multiplier of this end (dual)."""
        return self.penalty() * self.offset

    def take_header(self, packet: PosePacket) -> None:
        """Take what a packet says besides poses, unless a later one said it already.

        Args:
            packet: of the present version.
        """
        if packet.sequence >= self.newest_header:
            self.newest_header, self.peer_converged = packet.sequence, packet.converged
            if packet.curvature is not None:
                self.peer_curvature = packet.curvature.astype(np.float64)

    def places_of(self, packet: PosePacket) -> NDArray[np.int64] | None:
        """Places of a packet's keyframes among the shared ones; None if it has others.

        Args:
            packet: of the peer.
        """
        at = np.searchsorted(self.keyframes, packet.keyframes)
        shared = self.keyframes[np.minimum(at, len(self.keyframes) - 1)]
        return at if np.array_equal(shared, packet.keyframes) else None

    def relax(self, at: NDArray[np.int64], m: Array, x: Array, relaxation: float) -> None:
        """y <- y + relaxation (m - y), as a change of the offsets.

        Args:
            at: [k], places of the keyframes that arrived.
            m: [k, 4, 4], their poses as they were sent.
            x: [k, 4, 4], as this robot has them.
            relaxation: of the iteration.
        """
        y = retract(x, -self.offset[at])
        delta = relaxation * difference(m, y)
        self.offset[at] -= delta
        change = np.abs(delta).max(axis=1)
        self.changes[at] = np.concatenate([self.changes[at, 1:], change[:, None]], axis=1)

    def largest_change(self) -> float:
        """Largest change of an edge variable by the last arrivals (m, rad); infinite before the first."""
        return float(self.changes[:, -1].max())

    def activate(self, active: NDArray[np.bool_], version: int) -> None:
        """Let only some shared keyframes pull; the others begin anew when they do again.

        Args:
            active: bool [s].
            version: of the mask; an older one than the present one has no effect.
        """
        if version <= self.active_version:
            return
        self.offset[~active] = 0.0
        self.changes[~active] = 0.0
        self.changes[active & ~self.active] = np.inf
        self.active, self.active_version = active, version

    def carrying(self) -> NDArray[np.bool_]:
        """Bool [s]: which copies some loop closure with weight names, at the end that holds the loop closures."""
        carrying = np.zeros(len(self.keyframes), dtype=bool)
        named = np.array([c.peer_keyframe for c in self.closures], dtype=np.int64)
        carrying[np.searchsorted(self.keyframes, named[self.robust.weights > 0])] = True
        return carrying

    def is_steady(self, period: int) -> bool:
        """Whether the link is past its initial transient.

        Args:
            period: packets that must have arrived.
        """
        return self.received_total >= period and self.largest_change() < STEADY

    def largest_recent_change(self) -> float:
        """The same over the last arrivals; infinite before there were so many.

        A neighbor that has received nothing since repeats nearly the same values: the less arrives, the less a single
        small change means.
        """
        return float(self.changes.max())


def rounded(T: Array, wire: str) -> tuple[NDArray[Any], NDArray[Any]]:
    """Poses [s, 4, 4] as they are sent in a packet: quats_wxyz [s, 4] and translations [s, 3], see `PosePacket`.

    Args:
        T: poses.
        wire: as `PoseConsensusConfig.wire`.
    """
    quats_wxyz, translations = so3.to_quat_wxyz(T[:, :3, :3]), T[:, :3, 3]
    if wire == "fixed":
        return quats_wxyz.astype(np.float32), np.asarray(np.rint(translations / STEP_M) * STEP_M)
    return quats_wxyz.astype(wire), translations.astype(wire)


def link_metric(
    closures: Sequence[LoopClosure], keyframes: NDArray[np.int64], config: LoopClosureConfig
) -> NDArray[np.float32]:
    """Information [s, 6] of the loop closures on each copied keyframe, averaged over directions per block.

    Args:
        closures: of one pair of robots.
        keyframes: [s], indices of the copied keyframes, ascending.
        config: floors of the covariances.
    Raises:
        ValueError: a loop closure without information.
    """
    position = np.searchsorted(keyframes, [c.peer_keyframe for c in closures])
    information = closures_as_relative_poses(closures, np.zeros(len(closures)), position, config).information
    blocks = np.diagonal(information, axis1=-2, axis2=-1).reshape(-1, 2, 3).mean(axis=-1)
    total = np.zeros((len(keyframes), 2))
    np.add.at(total, position, blocks)
    if not np.all(total > 0):
        raise ValueError("a closure without information about translation or rotation cannot join two robots")
    return total[:, BLOCK].astype(np.float32)


def start_of_copies(
    closures: Sequence[LoopClosure],
    kept: NDArray[np.bool_],
    keyframes: NDArray[np.int64],
    T_map_keyframe: Array,
    *,
    known: Mapping[int, Array],
) -> Array:
    """Where the copies of a neighbor's keyframes start, [s, 4, 4] in the own map frame.

    Args:
        closures: that this end holds.
        kept: which of them count.
        keyframes: [s], of the neighbor.
        T_map_keyframe: [n, 4, 4], own keyframes.
        known: poses [4, 4] in the own map frame by keyframe of the neighbor; the others start where the first kept
            loop closure that names them puts them.
    """
    out = np.zeros((len(keyframes), 4, 4))
    for s, keyframe in enumerate(keyframes.tolist()):
        if keyframe in known:
            out[s] = known[keyframe]
        else:
            named = [k for k, c in enumerate(closures) if c.peer_keyframe == keyframe]
            best = closures[max(named, key=lambda k: bool(kept[k]))]
            out[s] = T_map_keyframe[best.own_keyframe] @ best.T_own_peer
    return out
