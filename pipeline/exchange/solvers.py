"""Solvers of the poses behind one interface: relaxed edge-ADMM, and elimination along the tree of robots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.config.exchange import ExchangeConfig, InjectionConfig
from duagc.pipeline.consensus.admm_edge import SharedKeyframes
from duagc.pipeline.consensus.elimination import Variable
from duagc.pipeline.consensus.pose_admm import PoseAgent, with_floor
from duagc.pipeline.consensus.tree import TreeGraph, TreeNode, TreePlace
from duagc.pipeline.exchange.injection import sent_positions
from duagc.pipeline.exchange.own_graph import OwnGraph
from duagc.pipeline.exchange.wire import elimination_wire, poses_wire
from duagc.pipeline.exchange.wire.poses_wire import read_poses, write_poses_in_parts
from duagc.pipeline.posegraph.gnc import INLIER_WEIGHT, RobustWeights
from duagc.pipeline.posegraph.relative_poses import LoopClosure, closures_as_relative_poses

ROUNDING_STEPS = 4.0
NO_INJECTION = InjectionConfig()


@dataclass(frozen=True)
class LinkStart:
    """A joined neighbor as the solver gets it.

    Attributes:
        index: of the neighbor in the sorted team.
        name: of the neighbor.
        shared: keyframes that both ends have.
        closures: m loop closures at the end that holds them; else none.
        keep: bool [m], those that the robust weights begin with.
        T_world_keyframe: [n, 4, 4], where the neighbor's keyframes start, at the end that holds the loop closures.
    """

    index: int
    name: str
    shared: SharedKeyframes
    closures: tuple[LoopClosure, ...]
    keep: NDArray[np.bool_]
    T_world_keyframe: Array


class Matcher(Protocol):
    """What a solver may know of Gaussians."""

    def is_here(self, owner: int) -> bool:
        """Whether the evidence of a robot is here."""

    def matched_at(self, other: int, T_own: Array, T_other: Array) -> NDArray[np.int64] | None:
        """Ids [p, 2] of own Gaussians and those of a neighbor that match at these poses; None if they are not here."""

    def positions(self, owner: int, ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array, Array]:
        """Keyframes [p] that Gaussians hang on, their means [p, 3] and the information of these [p, 3, 3], there.

        Raises:
            MalformedError: one of them is not here.
        """


@dataclass(frozen=True)
class SolverStart:
    """What a robot knows when the pose rounds begin.

    Attributes:
        own: its own graph; its keyframes count as seen from the first.
        index: of the robot in the sorted team.
        T_world_map: [4, 4], where its first keyframe was placed.
        tree: its place in the tree along which the maps were placed.
        links: joined neighbors.
        matcher: of Gaussians; None if there are none.
    """

    own: OwnGraph
    index: int
    T_world_map: Array
    tree: TreePlace
    links: Sequence[LinkStart]
    matcher: Matcher | None = None


class PoseSolver(Protocol):
    """One robot's side of the pose consensus.

    Attributes:
        refused: reasons why kept messages could not be used.
    """

    refused: list[str]

    def advance(self) -> None:
        """One round of computation."""

    def states(self, neighbor: LinkStart, room_bytes: int) -> list[bytes]:
        """What goes to a neighbor in this round, never again; each fits into `room_bytes`.

        Args:
            neighbor: the receiver.
            room_bytes: most bytes of each part.
        """

    def take_state(self, neighbor: LinkStart, payload: bytes) -> None:
        """Use what a neighbor sent in a round.

        Raises:
            ValueError: it is not what it should be.
        """

    def messages(self) -> list[tuple[int, bytes]]:
        """Reliable messages that are to be sent now, by receiver."""

    def take_message(self, sender: int, payload: bytes) -> None:
        """Keep a neighbor's reliable message for the next round."""

    @property
    def converged(self) -> bool:
        """This robot changes less than the tolerance, and its weights are final."""

    @property
    def largest_change(self) -> float:
        """In the last round (m, rad)."""

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802
        """Own keyframes [n, 4, 4] in the common frame."""

    def weights(self, peer: str) -> Array:
        """Robust weight of every loop closure held with a neighbor, in the order given."""

    @property
    def loop_weights(self) -> Array:
        """Robust weight of every own loop."""

    def refuted(self, peer: str) -> bool:
        """Whether final weights leave too few of the loop closures held with a neighbor to join the two robots."""

    def residuals(self) -> dict[str, Any]:
        """What a round looked like, for the record; keys as `PoseAgent.residuals`."""


class AdmmSolver:
    """`PoseAgent` with its packets in the states of the rounds."""

    def __init__(
        self,
        start: SolverStart,
        config: PoseConsensusConfig,
        injection: InjectionConfig = NO_INJECTION,
        *,
        seed: int = 0,
    ) -> None:
        """Lay out the graph.

        Args:
            start: what the robot knows.
            config: the same at all robots.
            injection: faults made on purpose.
            seed: of these.
        """
        self.own, self.config, self.injection, self.seed = start.index, config, injection, seed
        self.refused: list[str] = []
        self._arrived: list[tuple[int, bytes]] = []
        self._names = {link.index: link.name for link in start.links}
        own = start.own
        self.agent = PoseAgent(
            own.robot,
            own.T_first_keyframe,
            own.relative_poses,
            config,
            loops=own.loops,
            keep_loops=own.keep_loops,
        )
        self.agent.set_frame(start.T_world_map)
        for link in start.links:
            if link.closures:
                known = dict(enumerate(link.T_world_keyframe))
                self.agent.add_link(link.name, link.closures, keep=link.keep, T_world_keyframe_peer=known)
            else:
                self.agent.add_link(link.name, shared=link.shared)

    def advance(self) -> None:
        for sender, payload in self._arrived:
            name = self._names.get(sender, "")
            try:
                self.agent.take_mask(name, *poses_wire.read_mask(payload, self.agent.shared_with(name)))
            except ValueError as error:
                self.refused.append(str(error))
        self._arrived.clear()
        try:
            self.agent.step()
        except DuagError as error:  # numbers that a neighbor sent; the poses stay
            self.agent.step_change = np.inf
            self.refused.append(str(error))

    def states(self, neighbor: LinkStart, room_bytes: int) -> list[bytes]:
        packet = self.agent.outgoing(neighbor.name)
        sent = sent_positions(
            packet.translations, packet.keyframes, self.injection, seed=self.seed, robot=self.agent.robot
        )
        packet = replace(packet, translations=sent)
        return write_poses_in_parts(packet, room_bytes, self.own < neighbor.index)

    def take_state(self, neighbor: LinkStart, payload: bytes) -> None:
        poses = read_poses(payload, neighbor.shared.keyframes, neighbor.index < self.own)
        self.agent.receive(neighbor.name, poses)

    def messages(self) -> list[tuple[int, bytes]]:
        index = {name: k for k, name in self._names.items()}
        sent = [(index[peer], poses_wire.write_mask(*mask)) for peer, mask in self.agent.masks.items()]
        self.agent.masks.clear()
        return sent

    def take_message(self, sender: int, payload: bytes) -> None:
        self._arrived.append((sender, payload))

    @property
    def converged(self) -> bool:
        return self.agent.converged or (self.agent.robust_done and self._recent_change() < self._rounding_m())

    def _recent_change(self) -> float:
        """Largest change of a pose or an edge variable, by the last arrivals too (m, rad)."""
        links = (link.largest_recent_change() for link in self.agent.links.values())
        return max([self.agent.step_change, *links])

    def _rounding_m(self) -> float:
        """By what poses in float32 keep changing, however well robots agree: some steps of the largest coordinate."""
        if self.config.wire != "float32":
            return 0.0
        largest = np.float32(np.abs(self.agent.T_world_keyframe[:, :3, 3]).max())
        return ROUNDING_STEPS * float(np.spacing(largest))

    @property
    def largest_change(self) -> float:
        return self.agent.largest_change

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802
        return self.agent.T_world_keyframe

    def weights(self, peer: str) -> Array:
        return self.agent.weights(peer)

    @property
    def loop_weights(self) -> Array:
        return self.agent.loop_weights.weights.copy()

    def refuted(self, peer: str) -> bool:
        return self.agent.refuted(peer)

    def residuals(self) -> dict[str, Any]:
        return self.agent.residuals()


class EliminationSolver:
    """A node of the tree along which the maps were placed; everything it sends is a reliable message."""

    def __init__(self, start: SolverStart, config: PoseConsensusConfig, team: int, precision: str) -> None:
        """Lay out the graph.

        Args:
            start: what the robot knows.
            config: the same at all robots.
            team: number of robots.
            precision: of matrices on the wire, float32 or float64.
        """
        self.config, self.team, self.precision = config, team, precision
        self.keyframes = len(start.own.T_map_keyframe)
        self._loops = RobustWeights(start.own.keep_loops.astype(np.float64), config)
        self.refused: list[str] = []
        self._held: dict[str, RobustWeights] = {}
        self._links = [link.name for link in start.links]
        self._arrived: list[tuple[int, bytes]] = []
        self.node = TreeNode(start.tree, self._graph(start), config, config.tolerance)

    def _graph(self, start: SolverStart) -> TreeGraph:
        variables: list[Variable] = [(start.index, k) for k in range(self.keyframes)]
        poses = [start.T_world_map @ start.own.T_first_keyframe]
        masks: dict[Variable, int] = {}
        loops = with_floor(start.own.loops, self.config)
        weighted = [(loops, self._loops)] if len(loops) else []
        for link in start.links:
            keyframes = link.shared.keyframes.tolist()
            if not link.closures:
                for k in keyframes:
                    masks[start.index, k] = masks.get((start.index, k), 1 << start.index) | 1 << link.index
                continue
            peer = [c.peer_keyframe for c in link.closures]
            slots = len(variables) + np.searchsorted(link.shared.keyframes, peer)
            own = [c.own_keyframe for c in link.closures]
            factors = closures_as_relative_poses(link.closures, own, slots, self.config.closures)
            first_mu = self.config.team_schedule().first_mu
            keep = link.keep.astype(np.float64)
            self._held[link.name] = RobustWeights(keep, self.config, first_mu=first_mu)
            weighted.append((factors, self._held[link.name]))
            copies: list[Variable] = [(link.index, k) for k in keyframes]
            variables += copies
            masks |= dict.fromkeys(copies, 0)
            poses.append(link.T_world_keyframe[keyframes])
        trusted = with_floor(start.own.relative_poses, self.config)
        return TreeGraph(variables, np.concatenate(poses), masks, trusted, weighted)

    def advance(self) -> None:
        self._arrived, refused = elimination_wire.take_messages(self.node, self._arrived, self.team)
        self.refused += refused
        try:
            self.node.advance()
        except DuagError as error:  # numbers that a neighbor sent; the poses stay
            self.refused.append(str(error))

    def states(self, neighbor: LinkStart, room_bytes: int) -> list[bytes]:
        return []

    def take_state(self, neighbor: LinkStart, payload: bytes) -> None:
        raise ValueError("state: poses, where elimination sends messages")

    def messages(self) -> list[tuple[int, bytes]]:
        sent = [(to, elimination_wire.write_message(m, self.precision)) for to, m in self.node.outbox]
        self.node.outbox.clear()
        return sent

    def take_message(self, sender: int, payload: bytes) -> None:
        self._arrived.append((sender, payload))

    @property
    def converged(self) -> bool:
        return self.node.finished

    @property
    def largest_change(self) -> float:
        return self.node.largest_step if self.node.exchange else np.inf

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802
        return self.node.poses[: self.keyframes].copy()

    def weights(self, peer: str) -> Array:
        return self._held[peer].weights.copy() if peer in self._held else np.zeros(0)

    @property
    def loop_weights(self) -> Array:
        return self._loops.weights.copy()

    def refuted(self, peer: str) -> bool:
        robust = self._held.get(peer)
        if robust is None or not robust.done:
            return False
        return int(np.count_nonzero(robust.weights >= INLIER_WEIGHT)) < self.config.closures.min_support

    def residuals(self) -> dict[str, Any]:
        return {
            "primal": 0.0,
            "dual": 0.0,
            "cost": self.node.cost,
            "step": self.node.largest_step,
            "penalties": dict.fromkeys(self._links, (0.0, 0.0)),
            "versions": dict.fromkeys(self._links, self.node.exchange),
            "weights": {peer: robust.weights.tolist() for peer, robust in self._held.items()},
            "factorizations": self.node.factorizations,
        }


SolverFactory = Callable[[SolverStart], PoseSolver]


def solver_of(config: ExchangeConfig, team: int, seed: int = 0) -> SolverFactory:
    """How a solver is made by the settings.

    Args:
        config: the same at all robots.
        team: number of robots.
        seed: of faults made on purpose.
    """

    def make(start: SolverStart) -> PoseSolver:
        if config.solver == "admm":
            return AdmmSolver(start, config.consensus, config.injection, seed=seed)
        if config.solver == "elected":
            from duagc.pipeline.exchange.elected import ElectedSolver  # which needs this module

            return ElectedSolver(start, config.consensus, team)
        if config.solver == "block_descent":
            from duagc.pipeline.exchange.block_descent import BlockDescentSolver  # which needs this module

            return BlockDescentSolver(start, config.consensus)
        if config.solver != "elimination":
            from duagc.pipeline.exchange.algorithm_1 import Algorithm1Solver  # which needs this module

            printed = config.solver == "algorithm_1_printed"
            return Algorithm1Solver(start, config.consensus, config.algorithm_1_penalty if printed else None)
        return EliminationSolver(start, config.consensus, team, config.elimination_wire)

    return make
