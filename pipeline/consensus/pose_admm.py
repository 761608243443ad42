"""Pose consensus of one robot: relaxed edge-ADMM (Douglas-Rachford form) with per-pair adaptive penalties.

Every loop closure between two robots is held by one of them, which keeps a *copy* of the other's keyframe in addition
to its own poses. For every copied keyframe there is one edge variable y at each end of the link. Per round a robot

    1. takes one Gauss-Newton step on  f(x) + 1/2 sum over links |x - y|_W^2,   W = penalty * metric,
    2. sends                           m = 2 x - y,
    3. on arrival sets                 y <- y + relaxation (m - y);

a packet that does not arrive changes nothing. At a fixed point x agrees at both ends and the forces W (x - y) of
the two ends cancel, so that x minimizes the sum of all robots' costs: the centralized optimum, whatever the
penalties and the losses on the way were. Source: `docs/explanation/pose-consensus.md`; paper eqs. (8), (10),
(11), (14), corrected.

On the product group the edge variable is kept as its *offset* d = x - y, a vector of the tangent at x: a step delta
adds delta to d, m is x (+) d, y is x (+) (-d), and an arrival subtracts relaxation (m (-) y) from d. Unlike the
logarithm of a pose y, an offset does not wrap at pi, and offsets are large where forces are (d = force / W).

Penalties are agreed between the two ends of a link: `admm_penalties`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus import admm_penalties, admm_weights
from duagc.pipeline.consensus.admm_edge import (
    AdmmEdge,
    PosePacket,
    SharedKeyframes,
    link_metric,
    rounded,
    start_of_copies,
)
from duagc.pipeline.consensus.local_problem import LocalProblem, with_floor
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.gnc import RobustWeights
from duagc.pipeline.posegraph.least_squares import retract
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePoses


class PoseAgent:
    """One robot's side of the pose consensus: own keyframes, copies of the neighbors', and the state of its links.

    Robots have names that sort; the lower name of a pair decides on penalties. The gauge is free during the iteration;
    results may be expressed in any frame afterward (`docs/explanation/pose-consensus.md`, gauge).
    """

    def __init__(
        self,
        robot: str,
        T_map_keyframe: ArrayLike,
        odometry: RelativePoses,
        config: PoseConsensusConfig,
        *,
        loops: RelativePoses | None = None,
        keep_loops: ArrayLike | None = None,
    ) -> None:
        """Take a robot's own graph.

        Args:
            robot: its name.
            T_map_keyframe: [n, 4, 4], keyframes in its own map; also the start of the iteration.
            odometry: factors between own keyframes (by index) that are trusted.
            config: the same at all robots.
            loops: factors between own keyframes that get robust weights as loop closures do; default none.
            keep_loops: bool per loop, start of the robust weights (default: all).
        """
        self.robot, self.config = robot, config
        self.T_map_keyframe = np.array(T_map_keyframe, dtype=np.float64)
        self.odometry = with_floor(odometry, config)
        self.loops = RelativePoses.empty() if loops is None else with_floor(loops, config)
        kept = np.ones(len(self.loops)) if keep_loops is None else np.array(keep_loops, dtype=np.float64)
        self.loop_weights = RobustWeights(kept, config)
        self.T_world_map = np.eye(4)
        self.links: dict[str, AdmmEdge] = {}
        self.step_change = np.inf
        self._copies_start: dict[str, Array] = {}
        self._started = False
        self.masks: dict[str, tuple[int, NDArray[np.bool_]]] = {}  # by neighbor, to be sent
        self._adapts = False  # the weights have had their schedule
        self._x = self.T_map_keyframe.copy()
        self._problem = LocalProblem(RelativePoses.concatenate([self.odometry, self.loops]), config)
        self._collect_weights()
        self._dual_change = 0.0

    # ---- set-up ----

    def set_frame(self, T_world_map: ArrayLike) -> None:
        """Start from this pose of the own map in the common frame; call before the first step.

        Args:
            T_world_map: [4, 4].
        """
        if self._started:
            raise ValueError(f"{self.robot}: the frame cannot change after the first step")
        self.T_world_map = np.array(T_world_map, dtype=np.float64)

    def add_link(
        self,
        peer: str,
        closures_held: Sequence[LoopClosure] = (),
        shared: SharedKeyframes | None = None,
        *,
        keep: ArrayLike | None = None,
        T_world_keyframe_peer: Mapping[int, ArrayLike] | None = None,
    ) -> SharedKeyframes:
        """Join a neighbor, either with the closures that this end holds or with the keyframes that it shares.

        Args:
            peer: the neighbor's name.
            closures_held: all loop closures of the pair, if this end holds them.
            shared: what the neighbor's `add_link` returned, if it holds them.
            keep: bool per loop closure, start of the robust weights (default: all).
            T_world_keyframe_peer: start of the copies by peer keyframe index, in this robot's estimate of the
                world frame; default: from the first kept loop closure that names it.
        Returns:
            What the neighbor needs for its own `add_link` (with `shared`: the same again).
        """
        if self._started:
            raise ValueError(f"{self.robot}: a link to {peer} cannot be added after the first step")
        if peer in self.links or peer == self.robot:
            raise ValueError(f"{self.robot}: there is a link to {peer} already")
        if bool(closures_held) == (shared is not None):
            raise ValueError(
                f"{self.robot}: a link to {peer} needs held closures or shared keyframes, one of the two"
            )
        closures = tuple(closures_held)
        kept = np.ones(len(closures), dtype=bool) if keep is None else np.asarray(keep, dtype=bool)
        if shared is None:
            keyframes = np.unique([c.peer_keyframe for c in closures])
            shared = SharedKeyframes(
                keyframes.astype(np.int32), link_metric(closures, keyframes, self.config.closures)
            )
            T_map_world = se3.inverse(self.T_world_map)
            known = {k: T_map_world @ np.asarray(T) for k, T in (T_world_keyframe_peer or {}).items()}
            self._copies_start[peer] = start_of_copies(
                closures, kept, keyframes, self.T_map_keyframe, known=known
            )
        self.links[peer] = AdmmEdge.begin(
            peer, shared, closures, kept, decides=self.robot < peer, config=self.config
        )
        self.links = {name: self.links[name] for name in sorted(self.links)}
        return shared

    def _start(self) -> None:
        """Lay out the variables: own keyframes, then copies by neighbor; factors over all of them."""
        self._started = True
        poses, parts, count = [self.T_map_keyframe], list[RelativePoses](), len(self.T_map_keyframe)
        for link in self.links.values():
            if link.holds:
                poses.append(self._copies_start[link.peer])
                parts.append(link.lay_out(count, self.config.closures))
                count += len(link.keyframes)
        self._x = self.T_world_map @ np.concatenate(poses)
        self._problem.extend(parts)
        self._collect_weights()

    def _collect_weights(self) -> None:
        held = [link.robust.weights for link in self.links.values() if link.holds]
        self._problem.weigh(np.concatenate([np.ones(len(self.odometry)), self.loop_weights.weights, *held]))

    # ---- one round ----

    def step(self) -> float:
        """One Gauss-Newton step; returns its largest component (m, rad). Without links nothing moves."""
        if not self.links:
            self.step_change = 0.0
            return 0.0
        if not self._started:
            self._start()
        self._weigh_loops()
        for link in self.links.values():
            self._weigh(link)
            self._decide(link)
        links = list(self.links.values())
        before = [link.force() for link in links]
        delta = self._problem.newton_step(self._x, links, before)
        self._x = retract(self._x, delta)
        for link in links:
            link.offset = link.offset + delta[link.slots]
        self.step_change = float(np.abs(delta).max())
        self._dual_change = max(
            float(np.abs((link.force() - force) / np.sqrt(link.metric)).max())
            for link, force in zip(links, before, strict=True)
        )
        return self.step_change

    def outgoing(self, peer: str) -> PosePacket:
        """What to send to a neighbor after a step.

        Args:
            peer: name of the neighbor.
        """
        if not self._started:
            self._start()
        link = self.links[peer]
        link.sent += 1
        quats_wxyz, translations = rounded(retract(self._x[link.slots], link.offset), self.config.wire)
        curvature = None if link.decides else self._curvature(link)
        return PosePacket(
            sequence=link.sent,
            version=link.version,
            keyframes=link.keyframes,
            quats_wxyz=quats_wxyz,
            translations=translations,
            penalties=link.penalties.astype(np.float32),
            curvature=None if curvature is None else curvature.astype(np.float32),
            converged=self.converged,
        )

    def receive(self, peer: str, packet: PosePacket) -> bool:
        """Use a neighbor's packet; False if it was of another version or had nothing newer.

        Args:
            peer: name of the neighbor.
            packet: from its `outgoing`, whole or in part.
        """
        if not self._started:
            self._start()
        link = self.links[peer]
        if not link.decides and packet.version > link.version:
            self._change_penalties(link, packet.penalties.astype(np.float64), packet.version)
        if packet.version != link.version:
            return False
        link.take_header(packet)
        at = link.places_of(packet)
        if at is None:
            raise ValueError(f"{self.robot}: {peer} sent keyframes that the link does not share")
        newer = packet.sequence > link.newest[at]
        if not newer.any():
            return False
        at = at[newer]
        m = se3.from_quat_translation(
            packet.quats_wxyz[newer].astype(np.float64), packet.translations[newer].astype(np.float64)
        )
        if not link.active.all():  # nothing pulls at the others: a copy is where its owner has it
            active = link.active[at]
            if link.holds:
                self._x[link.slots[at[~active]]] = m[~active]
            link.newest[at[~active]] = packet.sequence
            at, m = at[active], m[active]
        link.relax(at, m, self._x[link.slots[at]], self.config.relaxation)
        link.newest[at] = packet.sequence
        share = int(newer.sum()) / len(link.keyframes)
        link.received += share
        link.received_total += share
        return True

    # ---- penalties ----

    def _curvature(self, link: AdmmEdge) -> Array | None:
        """Curvature [2] since the last change of penalties; None before enough was received or if nothing moved."""
        if not (self.config.adaptive and self._scheduled):
            return None
        return admm_penalties.curvature(link, self._x[link.slots], self.config)

    def _decide(self, link: AdmmEdge) -> None:
        """At the end of the lower name: new penalties once both ends have measured a curvature in this version."""
        own = self._curvature(link) if link.decides else None
        if own is not None and link.peer_curvature is not None:
            penalties = admm_penalties.next_penalties(link, own, link.peer_curvature, self.config)
            self._change_penalties(link, penalties, link.version + 1)

    def _change_penalties(self, link: AdmmEdge, penalties: Array, version: int) -> None:
        admm_penalties.change(link, penalties, version, self._x[link.slots])
        self._problem.refactorize()

    # ---- robust weights of held loop closures ----

    def _weigh(self, link: AdmmEdge) -> None:
        """Robust weights of a link's loop closures, paced by what arrives on it."""
        if admm_weights.advance_held(link, self._x, self.config):
            self._reweighted()
            if link.robust.scheduled:
                link.reference, link.received = None, 0.0

    def _weigh_loops(self) -> None:
        """Robust weights of own loops, paced by the link on which least arrives."""
        links = list(self.links.values())
        if admm_weights.advance_loops(self.loop_weights, self.loops, links, self._x, config=self.config):
            self._reweighted()

    def _reweighted(self) -> None:
        """Some weights changed; when the last are final, penalties begin to adapt as if the links were new."""
        self._collect_weights()
        groups = [self.loop_weights, *(link.robust for link in self.links.values())]
        if self.config.team_schedule().drop_idle:
            self.masks |= admm_weights.drop_idle(list(self.links.values()))
        if self._scheduled and not self._adapts and any(group.graduated for group in groups):
            self._adapts = True
            for link in self.links.values():
                link.adapting_from = link.received_total

    def shared_with(self, peer: str) -> int:
        """How many keyframes a link shares; zero if there is none.

        Args:
            peer: name of the neighbor.
        """
        return len(self.links[peer].keyframes) if peer in self.links else 0

    def take_mask(self, peer: str, version: int, active: NDArray[np.bool_]) -> None:
        """The neighbor that holds the loop closures says which shared keyframes they still name.

        Args:
            peer: its name.
            version: of the mask.
            active: bool [s].
        Raises:
            ValueError: it is not what a holder of loop closures says.
        """
        link = self.links[peer]
        if link.holds or len(active) != len(link.keyframes):
            raise ValueError("mask: not from a holder of loop closures, or not of its keyframes")
        link.activate(active, version)
        self._problem.refactorize()

    @property
    def _scheduled(self) -> bool:
        """Whether the schedules of all weights are over."""
        return self.loop_weights.scheduled and all(link.robust.scheduled for link in self.links.values())

    # ---- results ----

    @property
    def robust_done(self) -> bool:
        """Whether the weights of all held loop closures and own loops are final."""
        return self.loop_weights.done and all(link.robust.done for link in self.links.values())

    @property
    def largest_change(self) -> float:
        """Largest change of a pose or an edge variable in the last round (m, rad)."""
        return max([self.step_change, *(link.largest_change() for link in self.links.values())])

    @property
    def converged(self) -> bool:
        """Whether this end changes less than the tolerance, by the last arrivals too, and its weights are final."""
        recent = [link.largest_recent_change() for link in self.links.values()]
        return self.robust_done and max([self.step_change, *recent]) < self.config.tolerance

    @property
    def agreed(self) -> bool:
        """Whether this end and, by their last packets, all neighbors have converged."""
        return self.converged and all(link.peer_converged for link in self.links.values())

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802
        """Own keyframes [n, 4, 4] in the common frame; those of the own map, bit for bit, if without links."""
        if not self.links:
            return self.T_map_keyframe.copy()
        if not self._started:
            self._start()
        return self._x[: len(self.T_map_keyframe)].copy()

    def weights(self, peer: str) -> Array:
        """Weight [m] of every loop closure held with a neighbor, in the order given.

        Args:
            peer: name of the neighbor.
        """
        return self.links[peer].robust.weights.copy()

    def refuted(self, peer: str) -> bool:
        """Whether the loop closures held with a neighbor no longer connect it: final weights, too few of them inliers.

        It takes `closures.min_support` to connect two robots, and as many to keep them connected.

        Args:
            peer: name of the neighbor.
        """
        return admm_weights.refuted(self.links[peer], self.config.closures)

    def residuals(self) -> dict[str, Any]:
        """Residuals and state of a round, for the record.

        primal: largest |2 x_peer - y_peer - y| over links, the disagreement (m, rad). dual: largest change of a force
        in the last step, over the root of the metric (no unit). cost: own factors, weighted. step: largest component
        of the last step (m, rad). penalties: (translation, rotation) per neighbor. versions, weights: per neighbor.
        """
        changes = [link.largest_change() for link in self.links.values()]
        return {
            "primal": max(changes, default=0.0) / self.config.relaxation,
            "dual": self._dual_change,
            "cost": self._problem.cost(self._x) if self._started else 0.0,
            "step": self.step_change,
            "penalties": {peer: tuple(link.penalties.tolist()) for peer, link in self.links.items()},
            "versions": {peer: link.version for peer, link in self.links.items()},
            "weights": {
                peer: link.robust.weights.tolist() for peer, link in self.links.items() if link.holds
            },
            "factorizations": self._problem.factorizations,
        }
