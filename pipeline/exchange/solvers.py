"""The two solvers of the poses behind one interface: relaxed edge-ADMM, and elimination along the tree of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.admm_edge import SharedKeyframes
from duagc.pipeline.consensus.elimination import Variable
from duagc.pipeline.consensus.pose_admm import PoseAgent, with_floor
from duagc.pipeline.consensus.tree import TreeGraph, TreeNode, TreePlace
from duagc.pipeline.exchange.wire import elimination_wire
from duagc.pipeline.exchange.wire.poses_wire import read_poses, write_poses_in_parts
from duagc.pipeline.posegraph.factors import Factors
from duagc.pipeline.posegraph.loop_closures import Closure, closure_factors
from duagc.pipeline.posegraph.robust import COUNTS, RobustWeights

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LinkStart:
    """A joined neighbor as the solver gets it.

    shared: keyframes that both ends have. closures, keep, T_world_keyframe: at the end that holds the closures; which
    of them the weights begin with, and where the neighbor's keyframes start, [n, 4, 4].
    """

    index: int
    name: str
    shared: SharedKeyframes
    closures: tuple[Closure, ...]
    keep: NDArray[np.bool_]
    T_world_keyframe: Array


@dataclass(frozen=True)
class SolverStart:
    """What a robot knows when the pose rounds begin: registrations between own keyframes, places, neighbors."""

    robot: str
    index: int
    T_map_keyframe: Array
    registrations: Factors
    T_world_map: Array
    tree: TreePlace
    links: Sequence[LinkStart]


class PoseSolver(Protocol):
    """One robot's side of the pose consensus. refused: reasons why kept messages could not be used."""

    refused: list[str]

    def advance(self) -> None:
        """One round of computation."""

    def states(self, neighbor: LinkStart, room_bytes: int) -> list[bytes]:
        """What goes to a neighbor in this round, never again; each fits into `room_bytes`."""

    def take_state(self, neighbor: LinkStart, payload: bytes) -> None:
        """Use what a neighbor sent in a round. Raises ValueError."""

    def messages(self) -> list[tuple[int, bytes]]:
        """Reliable messages that are to be sent now, by receiver."""

    def take_message(self, sender: int, payload: bytes) -> None:
        """Keep a neighbor's reliable message for the next round."""

    @property
    def settled(self) -> bool:
        """This robot holds still, and its weights are final."""

    @property
    def largest_change(self) -> float:
        """In the last round (m, rad)."""

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802
        """Own keyframes [n, 4, 4] in the common frame."""

    def weights(self, peer: str) -> Array:
        """Robust weight of every closure held with a neighbor, in the order given."""

    def refuted(self, peer: str) -> bool:
        """Whether the closures held with a neighbor join nobody any more: final weights, too few of which count."""

    def residuals(self) -> dict[str, Any]:
        """What a round looked like, for the record; keys as `PoseAgent.residuals`."""


class AdmmSolver:
    """`PoseAgent` with its packets in the states of the rounds."""

    def __init__(self, start: SolverStart, config: PoseConsensusConfig) -> None:
        self.own = start.index
        self.refused: list[str] = []
        self.agent = PoseAgent(start.robot, start.T_map_keyframe, start.registrations, config)
        self.agent.set_frame(start.T_world_map)
        for link in start.links:
            if link.closures:
                known = dict(enumerate(link.T_world_keyframe))
                self.agent.add_link(link.name, link.closures, keep=link.keep, T_world_keyframe_peer=known)
            else:
                self.agent.add_link(link.name, shared=link.shared)

    def advance(self) -> None:
        self.agent.step()

    def states(self, neighbor: LinkStart, room_bytes: int) -> list[bytes]:
        packet = self.agent.outgoing(neighbor.name)
        return write_poses_in_parts(packet, room_bytes, self.own < neighbor.index)

    def take_state(self, neighbor: LinkStart, payload: bytes) -> None:
        poses = read_poses(payload, neighbor.shared.keyframes, neighbor.index < self.own)
        self.agent.receive(neighbor.name, poses)

    def messages(self) -> list[tuple[int, bytes]]:
        return []

    def take_message(self, sender: int, payload: bytes) -> None:
        """Edge-ADMM knows no reliable messages; there is nothing to keep."""

    @property
    def settled(self) -> bool:
        return self.agent.settled

    @property
    def largest_change(self) -> float:
        return self.agent.largest_change

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802
        return self.agent.T_world_keyframe

    def weights(self, peer: str) -> Array:
        return self.agent.weights(peer)

    def refuted(self, peer: str) -> bool:
        return self.agent.refuted(peer)

    def residuals(self) -> dict[str, Any]:
        return self.agent.residuals()


class EliminationSolver:
    """A node of the tree along which the maps were placed; everything it says is a reliable message."""

    def __init__(self, start: SolverStart, config: PoseConsensusConfig, team: int, precision: str) -> None:
        """team: its size. precision: of matrices on the wire."""
        self.config, self.team, self.precision = config, team, precision
        self.keyframes = len(start.T_map_keyframe)
        self.refused: list[str] = []
        self._held: dict[str, RobustWeights] = {}
        self._links = [link.name for link in start.links]
        self._arrived: list[tuple[int, bytes]] = []
        self.node = TreeNode(start.tree, self._graph(start), config, config.tolerance)

    def _graph(self, start: SolverStart) -> TreeGraph:
        variables: list[Variable] = [(start.index, k) for k in range(self.keyframes)]
        poses = [start.T_world_map @ start.T_map_keyframe]
        masks: dict[Variable, int] = {}
        doubted = []
        for link in start.links:
            keyframes = link.shared.keyframes.tolist()
            if not link.closures:
                for k in keyframes:
                    masks[start.index, k] = masks.get((start.index, k), 1 << start.index) | 1 << link.index
                continue
            peer = [c.peer_keyframe for c in link.closures]
            slots = len(variables) + np.searchsorted(link.shared.keyframes, peer)
            own = [c.own_keyframe for c in link.closures]
            factors = closure_factors(link.closures, own, slots, self.config.closures)
            self._held[link.name] = RobustWeights(link.keep.astype(np.float64), self.config)
            doubted.append((factors, self._held[link.name]))
            copies: list[Variable] = [(link.index, k) for k in keyframes]
            variables += copies
            masks |= dict.fromkeys(copies, 0)
            poses.append(link.T_world_keyframe[keyframes])
        trusted = with_floor(start.registrations, self.config)
        return TreeGraph(variables, np.concatenate(poses), masks, trusted, doubted)

    def advance(self) -> None:
        self._arrived, refused = elimination_wire.take_messages(self.node, self._arrived, self.team)
        self.refused += refused
        self.node.advance()

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
    def settled(self) -> bool:
        return self.node.finished

    @property
    def largest_change(self) -> float:
        return self.node.largest_step if self.node.exchange else np.inf

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802
        return self.node.poses[: self.keyframes].copy()

    def weights(self, peer: str) -> Array:
        return self._held[peer].weights.copy() if peer in self._held else np.zeros(0)

    def refuted(self, peer: str) -> bool:
        robust = self._held.get(peer)
        if robust is None or not robust.done:
            return False
        return int(np.count_nonzero(robust.weights >= COUNTS)) < self.config.closures.min_support

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
