"""Algorithm 1 of the paper, (8) to (14): poses and matched Gaussians move together; as printed, and corrected.

Every round a robot moves its keyframes, with what last came from its neighbors held still, and sends them. Its cost is
that of its own relative poses, of the loop closures with its neighbors, which both ends have, and of the *pair terms*:
the distances of matched Gaussians in the common frame.

    printed    one Riemannian gradient step with Armijo backtracking (11) on the augmented Lagrangian (10); loop
               closures are constraints with multipliers (14), whose residual is that of the measured relative pose,
               because the printed one vanishes for no measurement but the identity; a pair weighs the sum of the
               information of both (8); then own matched means become the average with the neighbor's last ones, by
               information and dimension (12), and are sent with the poses.
    corrected  one damped Gauss-Newton step on the same terms without multipliers; a pair weighs the parallel sum of
               the information of both, with the scatter of matched Gaussians, and for as many as share a pixel once;
               means stay what each robot saw. Its fixed point is the minimum over all poses and all matched means.

Of a Gaussian only its mean acts on poses; covariances and colors (13) are averaged by fusion, at the final poses.
The lower-named robot of a pair matches once, when the evidence is here.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.admm_edge import PosePacket, rounded
from duagc.pipeline.consensus.local_problem import with_floor
from duagc.pipeline.exchange.matched_pairs import MatchedPairs, moved
from duagc.pipeline.exchange.pose_solver import LinkStart, Matcher, SolverStart
from duagc.pipeline.exchange.wire.algorithm_1_wire import read_means, read_pairs, write_means, write_pairs
from duagc.pipeline.exchange.wire.link_setup_wire import LinkSetup, read_setup, write_setup
from duagc.pipeline.exchange.wire.poses_wire import read_poses, write_poses_in_parts
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.least_squares import retract
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePoses, closures_as_relative_poses

ARMIJO, HALVINGS = 0.75, 40
"""Of the decrease that the slope promises. The two ends of a link step at once: with the customary 1e-4, which accepts
nearly twice the way to the minimum, each overshoots where the other was, and both fly apart."""
PRIMAL = 1e-4  # m, rad: the paper's stopping test
DAMPING = 0.7  # both ends of a link step at once
ROUNDS_BEFORE_MATCHING = 10
"""Until poses are near enough to their final ones to match at."""
STILL_ROUNDS = 8
"""Rounds without a step above the tolerance after which a robot has converged."""
POSES, MEANS = b"\0", b"\1"
_HEAD = struct.Struct("<I")  # round of the sender


@dataclass
class _Peer:
    """What is known of one neighbor.

    Attributes:
        link: as the solver got it.
        poses: [k, 4, 4], its keyframes; None before they came.
        between: loop closures with it, as factors of own keyframes and then of its.
        multipliers: of these.
        pairs: None before they are known.
        newest: round of its last poses.
    """

    link: LinkStart
    poses: Array | None = None
    between: RelativePoses = field(default_factory=RelativePoses.empty)
    multipliers: Array = field(default_factory=lambda: np.zeros((0, 6)))
    pairs: MatchedPairs | None = None
    newest: int = -1


class Algorithm1Solver:
    """One robot's side of Algorithm 1.

    Attributes:
        refused: reasons why kept messages could not be used.
    """

    def __init__(self, start: SolverStart, config: PoseConsensusConfig, penalty: float | None) -> None:
        """Lay out the graph.

        Args:
            start: what the robot knows.
            config: the same at all robots.
            penalty: rho of (10), as a multiple of the loop closures' information, as printed; None for
                the corrected one.
        """
        if start.matcher is None:
            raise ValueError("Algorithm 1 needs Gaussians to match")
        self.config, self.own = config, start.index
        self.printed, self._penalty = penalty is not None, 1.0 if penalty is None else penalty
        self.refused: list[str] = []
        self._matcher: Matcher = start.matcher
        self._x = start.T_world_map @ start.own.T_first_keyframe
        loops = start.own.loops.select(np.asarray(start.own.keep_loops, dtype=bool))
        self._factors = with_floor(RelativePoses.concatenate([start.own.relative_poses, loops]), config)
        self._loops = start.own.keep_loops.astype(np.float64)
        self._peers = {link.index: _Peer(link) for link in start.links}
        self._arrived: list[tuple[int, bytes]] = []
        self._outbox = [(link.index, self._setup(link)) for link in start.links]
        self._length, self._step, self._rounds, self._still = 1.0, np.inf, 0, 0

    def _setup(self, link: LinkStart) -> bytes:
        kept = [c for c, keep in zip(link.closures, link.keep.tolist(), strict=True) if keep]
        return write_setup(LinkSetup(self._x, tuple(kept)))

    # --- one round

    def advance(self) -> None:
        """Use what came; move the poses (11), average the means (12), add to the multipliers (14)."""
        self._take_arrived()
        self._rounds += 1
        self._match()
        if any(peer.poses is None for peer in self._peers.values()):
            return
        try:
            x = self._gradient_step() if self.printed else self._newton_step()
        except DuagError as error:  # numbers that a neighbor sent; the poses stay
            self._step, self._still = np.inf, 0
            self.refused.append(str(error))
            return
        self._step = float(np.abs(least_squares.difference(x, self._x)).max())
        self._x = x
        self._still = self._still + 1 if self._step < self.config.tolerance else 0
        if self.printed:
            for peer in self._peers.values():
                if peer.pairs is not None:
                    peer.pairs.average(self._x)
                peer.multipliers = peer.multipliers + self._penalty * self._residuals(peer)

    def _residuals(self, peer: _Peer) -> Array:
        assert peer.poses is not None
        return least_squares.residuals(peer.between, np.concatenate([self._x, peer.poses]))

    def _cost(self, x: Array) -> float:
        """Own cost, multipliers times residuals, penalty (10), and the pair terms."""
        total = 0.5 * least_squares.cost(self._factors, x)
        for peer in self._peers.values():
            assert peer.poses is not None
            r = least_squares.residuals(peer.between, np.concatenate([x, peer.poses]))
            total += 0.5 * self._penalty * float((r**2).sum()) + float((peer.multipliers * r).sum())
            if peer.pairs is not None:
                off = self._offsets(peer, x)
                total += 0.5 * float(np.einsum("pi,pij,pj->", off, peer.pairs.weight, off))
        return total

    def _offsets(self, peer: _Peer, x: Array) -> Array:
        """From the neighbor's means to own ones in the common frame, [p, 3]."""
        pairs = peer.pairs
        assert pairs is not None
        assert peer.poses is not None
        there = pairs.peer_common if self.printed else moved(peer.poses[pairs.peer_anchor], pairs.peer_mean)
        return pairs.common(x) - there

    def _gradient(self, curvature: Array | None = None) -> Array:
        """By own keyframes [n, 6]; adds what neighbors contribute to the curvature [n, 6, 6] to it, if it is given."""
        n = len(self._x)
        g, _ = least_squares.gradient(self._factors, np.ones(len(self._factors)), self._x)
        for peer in self._peers.values():
            assert peer.poses is not None
            r, Ji, Jj = least_squares.linearized(peer.between, np.concatenate([self._x, peer.poses]))
            pull = peer.multipliers + self._penalty * r
            for slots, J in ((peer.between.i, Ji), (peer.between.j, Jj)):
                mine = slots < n
                J_t = np.swapaxes(J[mine], -1, -2)
                np.add.at(g, slots[mine], (J_t @ pull[mine][..., None])[..., 0])
                if curvature is not None:
                    np.add.at(curvature, slots[mine], self._penalty * J_t @ J[mine])
            if peer.pairs is not None:
                off = self._offsets(peer, self._x)
                R = self._x[peer.pairs.anchor, :3, :3]
                J = np.concatenate(
                    [np.broadcast_to(np.eye(3), R.shape), -R @ so3.hat(peer.pairs.mean)], axis=2
                )
                J_t = np.swapaxes(J, -1, -2)
                weight = peer.pairs.weight
                np.add.at(g, peer.pairs.anchor, (J_t @ (weight @ off[..., None]))[..., 0])
                if curvature is not None:
                    np.add.at(curvature, peer.pairs.anchor, J_t @ weight @ J)
        return g

    def _gradient_step(self) -> Array:
        """(11): along the gradient, by Armijo backtracking."""
        g, before = self._gradient(), self._cost(self._x)
        slope = float((g**2).sum())
        self._length *= 4.0
        for _ in range(HALVINGS):
            moved = retract(self._x, -self._length * g)
            if self._cost(moved) <= before - ARMIJO * self._length * slope:
                return moved
            self._length /= 2.0
        return self._x

    def _newton_step(self) -> Array:
        n = len(self._x)
        blocks = np.zeros((n, 6, 6))
        g = self._gradient(blocks)
        _, jacobians = least_squares.gradient(self._factors, np.ones(len(self._factors)), self._x)
        tiny = 1e-9 * max(float(np.abs(blocks).max()), 1.0)
        H = least_squares.curvature_matrix(self._factors, jacobians, np.full((n, 6), tiny))
        # with one sparse matrix among them, the sum is one, whatever SciPy makes of arrays
        H = (H + sparse.block_diag([*blocks, sparse.csc_matrix((0, 0))], format="csc")).tocsc()
        delta = -DAMPING * least_squares.factorized(H)(g.ravel()).reshape(-1, 6)
        turn_rad = float(np.linalg.norm(delta[:, 3:], axis=1).max())
        return retract(self._x, delta * min(1.0, self.config.step_limit_rad / max(turn_rad, 1e-12)))

    # --- matching

    def _match(self) -> None:
        for index, peer in self._peers.items():
            if peer.poses is None or peer.pairs is not None or self._rounds < ROUNDS_BEFORE_MATCHING:
                continue
            if self.own < index:
                ids = self._matcher.matched_at(index, self._x, peer.poses)
                if ids is not None:
                    self._take_pairs(peer, ids)
                    self._outbox.append((index, write_pairs(ids)))

    def _take_pairs(self, peer: _Peer, ids: NDArray[np.int64]) -> None:
        """Lay out the pair terms of ids [p, 2], the own one first."""
        assert peer.poses is not None
        own = self._matcher.positions(self.own, ids[:, 0])
        other = self._matcher.positions(peer.link.index, ids[:, 1])
        peer.pairs = MatchedPairs.of(own, other, self._x, peer.poses, printed=self.printed)

    # --- packets

    def states(self, neighbor: LinkStart, room_bytes: int) -> list[bytes]:
        """Own keyframes of this round; as printed the matched means as well.

        Args:
            neighbor: receiver of the packets.
            room_bytes: most bytes of each part.
        """
        room_bytes -= 1 + _HEAD.size
        quats_wxyz, translations = rounded(self._x, self.config.wire)
        packet = PosePacket(
            sequence=self._rounds,
            version=0,
            keyframes=np.arange(len(self._x), dtype=np.int32),
            quats_wxyz=quats_wxyz,
            translations=translations,
            penalties=np.zeros(2, np.float32),
            curvature=None,
            converged=self.converged,
        )
        head = _HEAD.pack(self._rounds)
        parts = [POSES + head + part for part in write_poses_in_parts(packet, room_bytes, decides=False)]
        pairs = self._peers[neighbor.index].pairs
        if self.printed and pairs is not None:
            common = pairs.common(self._x)
            parts += [MEANS + head + part for part in write_means(common, room_bytes)]
        return parts

    def take_state(self, neighbor: LinkStart, payload: bytes) -> None:
        """Use poses or means that are not older than the last ones.

        Args:
            neighbor: sender of the packet.
            payload: one of its parts of a round, from `states`.
        Raises:
            MalformedError: it is cut short, or not what it should be.
        """
        peer = self._peers[neighbor.index]
        if len(payload) < 1 + _HEAD.size:
            raise MalformedError("poses: cut short")
        sent_round = _HEAD.unpack_from(payload, 1)[0]
        if peer.poses is None or sent_round < peer.newest:
            return
        rest = payload[1 + _HEAD.size :]
        if payload[:1] == POSES:
            packet = read_poses(rest, np.arange(len(peer.poses), dtype=np.int32), from_decider=False)
            peer.poses[packet.keyframes] = se3.from_quat_translation(
                packet.quats_wxyz.astype(np.float64), packet.translations.astype(np.float64)
            )
            peer.newest = sent_round
        elif self.printed and peer.pairs is not None:
            first, means = read_means(rest, len(peer.pairs.mean))
            peer.pairs.peer_common[first : first + len(means)] = means

    def messages(self) -> list[tuple[int, bytes]]:
        sent = self._outbox
        self._outbox = []
        return sent

    def take_message(self, sender: int, payload: bytes) -> None:
        """Keep a neighbor's reliable message for the next round.

        Args:
            sender: index of the neighbor.
            payload: set-up of the link or matched ids, which `advance` reads.
        """
        self._arrived.append((sender, payload))

    def _take_arrived(self) -> None:
        """Keyframes and loop closures first; matches wait for the evidence."""
        later = []
        for sender, payload in self._arrived:
            peer = self._peers.get(sender)
            try:
                if peer is None:
                    raise MalformedError("Algorithm 1: from a robot that is not joined")
                if peer.poses is None:
                    self._take_setup(peer, read_setup(payload, len(self._x), "Algorithm 1"))
                elif not self._matcher.is_here(sender):
                    later.append((sender, payload))
                elif self.own > sender and peer.pairs is None:
                    self._take_pairs(peer, read_pairs(payload)[:, ::-1])
            except ValueError as error:
                self.refused.append(str(error))
        self._arrived = later

    def _take_setup(self, peer: _Peer, setup: LinkSetup) -> None:
        kept = [c for c, keep in zip(peer.link.closures, peer.link.keep.tolist(), strict=True) if keep]
        closures: list[LoopClosure] = [*kept, *(c.reversed() for c in setup.closures)]
        own = [c.own_keyframe for c in closures]
        slots = len(self._x) + np.array([c.peer_keyframe for c in closures], dtype=np.int64)
        if any(c.peer_keyframe >= len(setup.poses) for c in closures):
            raise MalformedError("Algorithm 1: a loop closure of a keyframe that does not exist")
        peer.between = closures_as_relative_poses(closures, own, slots, self.config.closures)
        peer.multipliers = np.zeros((len(closures), 6))
        peer.poses = setup.poses.copy()

    # --- results

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802 (a transform)
        return self._x.copy()

    @property
    def converged(self) -> bool:
        """All is known, and nothing moves; as printed, all loop closures hold as well."""
        known = all(peer.poses is not None and peer.pairs is not None for peer in self._peers.values())
        return known and self._still >= STILL_ROUNDS and (not self.printed or self._primal() < PRIMAL)

    def _primal(self) -> float:
        """Largest residual of a loop closure, not whitened."""
        largest = 0.0
        for peer in self._peers.values():
            if peer.poses is not None and len(peer.between):
                try:
                    r = np.linalg.solve(peer.between.whitening, self._residuals(peer)[..., None])
                except np.linalg.LinAlgError:  # a neighbor's loop closure that says nothing of some direction
                    r = least_squares.errors(peer.between, np.concatenate([self._x, peer.poses]))
                largest = max(largest, float(np.abs(r).max()))
        return largest

    @property
    def largest_change(self) -> float:
        return self._step

    def weights(self, peer: str) -> Array:
        """There are no robust weights: what the links began with counts.

        Args:
            peer: name of the neighbor.
        """
        link = next(p.link for p in self._peers.values() if p.link.name == peer)
        return link.keep.astype(np.float64)

    @property
    def loop_weights(self) -> Array:
        return self._loops.copy()

    def refuted(self, peer: str) -> bool:
        """Never.

        Args:
            peer: name of the neighbor.
        """
        return False

    def residuals(self) -> dict[str, Any]:
        names = [peer.link.name for peer in self._peers.values()]
        ready = all(peer.poses is not None for peer in self._peers.values())
        return {
            "primal": self._primal(),
            "dual": max(
                [float(np.abs(p.multipliers).max(initial=0.0)) for p in self._peers.values()] or [0.0]
            ),
            "cost": self._cost(self._x) if ready else 0.0,
            "step": self._step,
            "penalties": dict.fromkeys(names, (self._penalty, self._penalty)),
            "versions": dict.fromkeys(names, 0),
            "weights": {
                p.link.name: p.link.keep.astype(float).tolist()
                for p in self._peers.values()
                if p.link.closures
            },
            "factorizations": 0,
        }
