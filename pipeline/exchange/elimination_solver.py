"""Elimination along the tree of robots as a solver of the poses."""

from __future__ import annotations

from typing import Any

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.elimination import Variable
from duagc.pipeline.consensus.local_problem import with_floor
from duagc.pipeline.consensus.tree import TreeGraph, TreeNode
from duagc.pipeline.exchange.pose_solver import LinkStart, SolverStart
from duagc.pipeline.exchange.wire import elimination_wire
from duagc.pipeline.posegraph.gnc import INLIER_WEIGHT, RobustWeights
from duagc.pipeline.posegraph.relative_poses import closures_as_relative_poses


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
        """Take the messages that arrived, then what they allow of the elimination."""
        self._arrived, refused = elimination_wire.take_messages(self.node, self._arrived, self.team)
        self.refused += refused
        try:
            self.node.advance()
        except DuagError as error:  # numbers that a neighbor sent; the poses stay
            self.refused.append(str(error))

    def states(self, neighbor: LinkStart, room_bytes: int) -> list[bytes]:
        """None: everything is a reliable message.

        Args:
            neighbor: not used.
            room_bytes: not used.
        """
        return []

    def take_state(self, neighbor: LinkStart, payload: bytes) -> None:
        """Refuse it: no neighbor sends poses in its states.

        Args:
            neighbor: not used.
            payload: not read.
        """
        raise ValueError("state: poses, where elimination sends messages")

    def messages(self) -> list[tuple[int, bytes]]:
        """Messages of the node, by receiver."""
        sent = [(to, elimination_wire.write_message(m, self.precision)) for to, m in self.node.outbox]
        self.node.outbox.clear()
        return sent

    def take_message(self, sender: int, payload: bytes) -> None:
        """Keep a neighbor's message for the next round.

        Args:
            sender: index of the neighbor.
            payload: of the message; `advance` reads it.
        """
        self._arrived.append((sender, payload))

    @property
    def converged(self) -> bool:
        """Whether the node has finished."""
        return self.node.finished

    @property
    def largest_change(self) -> float:
        """Largest component of the last step (m, rad); infinite before the first."""
        return self.node.largest_step if self.node.exchange else np.inf

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802
        """Own keyframes [n, 4, 4] in the common frame."""
        return self.node.poses[: self.keyframes].copy()

    def weights(self, peer: str) -> Array:
        """Robust weight of every loop closure held with a neighbor, in the order given; none where none are held.

        Args:
            peer: name of the neighbor.
        """
        return self._held[peer].weights.copy() if peer in self._held else np.zeros(0)

    @property
    def loop_weights(self) -> Array:
        """Robust weight of every own loop."""
        return self._loops.weights.copy()

    def refuted(self, peer: str) -> bool:
        """Whether final weights leave too few of the loop closures that this end holds with a neighbor.

        Args:
            peer: name of the neighbor.
        """
        robust = self._held.get(peer)
        if robust is None or not robust.done:
            return False
        return int(np.count_nonzero(robust.weights >= INLIER_WEIGHT)) < self.config.closures.min_support

    def residuals(self) -> dict[str, Any]:
        """What the round looked like, with the keys of `PoseAgent.residuals`."""
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
