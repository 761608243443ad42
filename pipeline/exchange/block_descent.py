"""Block-coordinate descent on the poses of the team (RBCD), to compare with: robots take turns, one block at a time.

Both ends of a link know its loop closures; the end that found them sends them once, with where its keyframes start. A
robot moves its own keyframes to the minimum of all cost that they are part of, with the last keyframes of its neighbors
held still, and sends those that loop closures name. Neighbors never move at once: of every pair the robot with the
lower index goes first, and a robot waits until all neighbors with a lower index are one step ahead and the others level
(edge reversal). So poses that are lost are sent again, and losses cost time and no accuracy: the steps are the same.

Loop closures begin with those that the pairwise test kept; the end that found them weighs all of them by graduated
non-convexity, from its own keyframes and the last ones of the neighbor, and sends the weights where they change.
Source: Tian, Khosoussi, Rosen, How, "Distributed Certifiably Correct Pose-Graph Optimization", 2021, without the
relaxation to higher rank and without acceleration: robots start near the minimum, where their maps were placed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.admm_edge import STEADY, PosePacket, rounded
from duagc.pipeline.consensus.local_problem import with_floor
from duagc.pipeline.consensus.own_block import minimized
from duagc.pipeline.exchange.pose_solver import LinkStart, SolverStart
from duagc.pipeline.exchange.wire.block_descent_wire import ClosureWeights, read_message, write_message
from duagc.pipeline.exchange.wire.link_setup_wire import LinkSetup
from duagc.pipeline.exchange.wire.poses_wire import read_poses, write_poses_in_parts
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.gnc import INLIER_WEIGHT, RobustWeights
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePoses, closures_as_relative_poses

STILL_STEPS = 2
"""Own steps below the tolerance, each after new poses of all neighbors, after which a robot has converged."""
ANSWER_ROUNDS = 2
"""An answer takes so many rounds at the least; poses are not sent again before."""


@dataclass
class _Peer:
    """What is known of one neighbor.

    Attributes:
        link: as the solver got it.
        own: [s], own keyframes that loop closures name.
        theirs: [k], keyframes of the neighbor that they name.
        poses: [k, 4, 4], these; None before they are known.
        newest: [k], step of the neighbor that each is of.
        factors: loop closures between all own keyframes and, after them, these.
        weights: of these.
        robust: the same at the end that found them; None at the other.
        version: of the weights.
        final: the weights do not change any more.
        change: how far its keyframes moved last (m, rad).
    """

    link: LinkStart
    own: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    theirs: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    poses: Array | None = None
    newest: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    factors: RelativePoses = field(default_factory=RelativePoses.empty)
    weights: Array = field(default_factory=lambda: np.zeros(0))
    robust: RobustWeights | None = None
    version: int = -1
    final: bool = False
    change: float = np.inf

    @property
    def ready(self) -> bool:
        return self.poses is not None and self.version >= 0

    @property
    def steps(self) -> int:
        """Of the neighbor, all of whose poses are here."""
        return int(self.newest.min(initial=2**62))

    def lay_out(self, closures: tuple[LoopClosure, ...], keyframes: int, config: PoseConsensusConfig) -> None:
        """Take the loop closures, from the side of a robot with so many keyframes."""
        self.own = np.unique([c.own_keyframe for c in closures]).astype(np.int32)
        self.theirs = np.unique([c.peer_keyframe for c in closures]).astype(np.int32)
        own = [c.own_keyframe for c in closures]
        slots = keyframes + np.searchsorted(self.theirs, [c.peer_keyframe for c in closures])
        self.factors = closures_as_relative_poses(closures, own, slots, config.closures)
        self.newest = np.zeros(len(self.theirs), np.int64)


class BlockDescentSolver:
    """One robot's side of block-coordinate descent.

    Attributes:
        refused: reasons why kept messages could not be used.
    """

    def __init__(self, start: SolverStart, config: PoseConsensusConfig) -> None:
        """Lay out the graph.

        Args:
            start: what the robot knows.
            config: the same at all robots.
        """
        self.config, self.own = config, start.index
        self.refused: list[str] = []
        self._x = start.T_world_map @ start.own.T_first_keyframe
        self._trusted = with_floor(start.own.relative_poses, config)
        self._loops = with_floor(start.own.loops, config)
        self._loop_weights = RobustWeights(start.own.keep_loops.astype(np.float64), config)
        self._peers = {link.index: _Peer(link) for link in start.links}
        self._arrived: list[tuple[int, bytes]] = []
        self._outbox: list[tuple[int, bytes]] = []
        self._steps = self._still = self._since = 0
        self._change = np.inf
        for index, peer in self._peers.items():
            if peer.link.closures:
                self._hold(index, peer)

    def _hold(self, index: int, peer: _Peer) -> None:
        """Of loop closures that this robot found: lay them out and send them."""
        link = peer.link
        peer.lay_out(link.closures, len(self._x), self.config)
        peer.poses = link.T_world_keyframe[peer.theirs].copy()
        first_mu = self.config.team_schedule().first_mu
        peer.robust = RobustWeights(link.keep.astype(np.float64), self.config, first_mu=first_mu)
        self._outbox.append((index, write_message(LinkSetup(self._x, link.closures))))
        self._send_weights(index, peer)

    def _send_weights(self, index: int, peer: _Peer) -> None:
        assert peer.robust is not None
        peer.weights, peer.final, peer.version = peer.robust.weights, peer.robust.done, peer.version + 1
        message = ClosureWeights(peer.version, peer.final, peer.weights)
        self._outbox.append((index, write_message(message)))

    # --- one round

    def advance(self) -> None:
        """Use what came; weigh and step if it is this robot's turn."""
        self._take_arrived()
        self._since += 1
        if not self._may_step():
            return
        self._weigh()
        factors, weights, held = self._block()
        try:
            x = minimized(factors, weights, self._x, held, config=self.config)
        except DuagError as error:  # numbers that a neighbor sent; the poses stay
            self._change, self._still = np.inf, 0
            self.refused.append(str(error))
            return
        self._change = float(np.abs(least_squares.difference(x, self._x)).max())
        self._x, self._since = x, 0
        self._steps += 1
        self._still = self._still + 1 if self._change < self.config.tolerance else 0

    def _may_step(self) -> bool:
        """Whether all neighbors are where they are before the next own step."""
        return all(
            peer.ready and peer.steps >= self._steps + (index < self.own)
            for index, peer in self._peers.items()
        )

    def _block(self) -> tuple[RelativePoses, Array, Array]:
        """All factors of own keyframes, their weights, and the neighbors' keyframes that follow the own ones."""
        parts, weights = (
            [self._trusted, self._loops],
            [np.ones(len(self._trusted)), self._loop_weights.weights],
        )
        held, count = [np.zeros((0, 4, 4))], len(self._x)
        for peer in self._peers.values():
            if peer.poses is not None and peer.ready:
                names = np.concatenate([np.arange(len(self._x)), count + np.arange(len(peer.poses))])
                parts.append(peer.factors.renamed(names))
                weights.append(peer.weights)
                held.append(peer.poses)
                count += len(peer.poses)
        return RelativePoses.concatenate(parts), np.concatenate(weights), np.concatenate(held)

    def _weigh(self) -> None:
        """The next weights of own loops and of the loop closures that this robot found, where they are due."""
        changes = [self._change, *(peer.change for peer in self._peers.values())]
        steady = self._steps >= self.config.penalty_period and max(changes) < STEADY

        squared = partial(least_squares.squared_residuals, self._loops, self._x)
        if self._loop_weights.advance(float(self._steps), steady, squared):
            self._still = 0
        for index, peer in self._peers.items():
            if peer.robust is None or peer.poses is None:
                continue
            poses = np.concatenate([self._x, peer.poses])
            squared = partial(least_squares.squared_residuals, peer.factors, poses)
            if peer.robust.advance(float(self._steps), steady, squared):
                self._still = 0
                self._send_weights(index, peer)

    # --- packets

    def states(self, neighbor: LinkStart, room_bytes: int) -> list[bytes]:
        """Own keyframes that loop closures name, unless the neighbor is known to have them or may just answer.

        Args:
            neighbor: receiver of the packets.
            room_bytes: most bytes of each part.
        """
        peer = self._peers[neighbor.index]
        has_them = peer.steps >= self._steps + (neighbor.index < self.own)
        if not self._steps or has_them or 0 < self._since < ANSWER_ROUNDS:
            return []
        quats_wxyz, translations = rounded(self._x[peer.own], self.config.wire)
        packet = PosePacket(
            sequence=self._steps,
            version=0,
            keyframes=peer.own,
            quats_wxyz=quats_wxyz,
            translations=translations,
            penalties=np.zeros(2, np.float32),
            curvature=None,
            converged=self.converged,
        )
        return write_poses_in_parts(packet, room_bytes, decides=False)

    def take_state(self, neighbor: LinkStart, payload: bytes) -> None:
        """Use keyframes of a later step of the neighbor.

        Args:
            neighbor: sender of the packet.
            payload: some of its keyframes in the common frame, from `states`.

        Raises:
            MalformedError: it is not what it should be, or of a step that this robot's last one does not
                allow yet.
        """
        peer = self._peers[neighbor.index]
        if peer.poses is None:
            return
        packet = read_poses(payload, peer.theirs, from_decider=False)
        if packet.sequence > self._steps + 1:
            raise MalformedError("block descent: poses of a step that cannot have been")
        at = np.searchsorted(peer.theirs, packet.keyframes)
        at, newer = at[packet.sequence > peer.newest[at]], packet.sequence > peer.newest[at]
        if not newer.any():
            return
        quats_wxyz, translations = packet.quats_wxyz[newer], packet.translations[newer]
        T = se3.from_quat_translation(quats_wxyz.astype(np.float64), translations.astype(np.float64))
        peer.change = float(np.abs(least_squares.difference(T, peer.poses[at])).max())
        peer.poses[at], peer.newest[at] = T, packet.sequence

    def messages(self) -> list[tuple[int, bytes]]:
        sent, self._outbox = self._outbox, []
        return sent

    def take_message(self, sender: int, payload: bytes) -> None:
        """Keep a neighbor's reliable message for the next round.

        Args:
            sender: index of the neighbor.
            payload: loop closures or their weights, which `advance` reads.
        """
        self._arrived.append((sender, payload))

    def _take_arrived(self) -> None:
        for sender, payload in self._arrived:
            try:
                peer = self._peers.get(sender)
                if peer is None or peer.link.closures:
                    raise MalformedError(
                        "block descent: not from a robot that found loop closures with this one"
                    )
                self._take(peer, read_message(payload, len(self._x)))
            except ValueError as error:
                self.refused.append(str(error))
        self._arrived.clear()

    def _take(self, peer: _Peer, message: LinkSetup | ClosureWeights) -> None:
        if isinstance(message, LinkSetup):
            if peer.poses is not None:
                raise MalformedError("block descent: loop closures came twice")
            if peer.version >= 0 and len(message.closures) != len(peer.weights):
                raise MalformedError("block descent: loop closures without their weights")
            peer.lay_out(tuple(c.reversed() for c in message.closures), len(self._x), self.config)
            peer.poses = message.poses[peer.theirs]
        elif message.version > peer.version:
            if peer.poses is not None and len(message.weights) != len(peer.factors):
                raise MalformedError("weights: not of the loop closures of this link")
            peer.version, peer.final, peer.weights = message.version, message.final, message.weights
            self._still = 0

    # --- results

    @property
    def converged(self) -> bool:
        """All weights are final, and the last own steps were below the tolerance."""
        final = self._loop_weights.done and all(peer.final for peer in self._peers.values())
        return final and self._still >= STILL_STEPS

    @property
    def largest_change(self) -> float:
        return self._change

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802 (a transform)
        return self._x.copy()

    def weights(self, peer: str) -> Array:
        """At the end that found the loop closures; none at the other.

        Args:
            peer: name of the neighbor.

        Returns:
            [m], 0 to 1, in the order in which the loop closures were given.
        """
        found = next(p for p in self._peers.values() if p.link.name == peer)
        return found.weights.copy() if found.robust is not None else np.zeros(0)

    @property
    def loop_weights(self) -> Array:
        return self._loop_weights.weights.copy()

    def refuted(self, peer: str) -> bool:
        """Whether final weights leave too few of the loop closures that this end holds with a neighbor.

        Args:
            peer: name of the neighbor.
        """
        robust = next(p.robust for p in self._peers.values() if p.link.name == peer)
        if robust is None or not robust.done:
            return False
        return int(np.count_nonzero(robust.weights >= INLIER_WEIGHT)) < self.config.closures.min_support

    def residuals(self) -> dict[str, Any]:
        peers = {peer.link.name: peer for peer in self._peers.values()}
        factors, weights, held = self._block()
        return {
            "primal": max([peer.change for peer in peers.values() if np.isfinite(peer.change)], default=0.0),
            "dual": 0.0,
            "cost": least_squares.cost(factors, np.concatenate([self._x, held]), weights),
            "step": self._change,
            "penalties": dict.fromkeys(peers, (0.0, 0.0)),
            "versions": {name: peer.version + 1 for name, peer in peers.items()},
            "weights": {name: p.weights.tolist() for name, p in peers.items() if p.robust is not None},
            "factorizations": self._steps,
        }
