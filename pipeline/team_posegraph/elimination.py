"""Exact elimination on the wire: blocks go up the best supported tree of robots, steps come down."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.posegraph import PoseGraphConfig
from duagc.pipeline.consensus.elimination import Variable
from duagc.pipeline.consensus.tree import TreeGraph, TreeNode, TreePlace
from duagc.pipeline.exchange.wire import elimination_wire
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph.files import RobotGraph
from duagc.pipeline.posegraph.loop_closures import closure_factors, holder, spanning_tree
from duagc.pipeline.posegraph.robust import RobustWeights
from duagc.pipeline.team_posegraph.agent import GraphAgent, Neighbor

Array = NDArray[np.float64]


class EliminationAgent(GraphAgent):
    """A node of the tree. Keyframes of neighbors are told exactly: copies must start where their owners are."""

    precision = "float64"

    def __init__(self, graph: RobotGraph, team: Sequence[str], config: PoseGraphConfig) -> None:
        super().__init__(graph, team, config)
        self._node: TreeNode | None = None
        self._arrived: list[tuple[int, bytes]] = []  # used in `advance`: some come before the start

    def start(self) -> None:
        self.first_round = self.round
        names = [self.team[m] for m in self.T_world_map]
        support = {(self.team[a], self.team[b]): float(f.support) for (a, b), f in self._frames.items()}
        parent = {
            self.team.index(robot): None if nearer is None else self.team.index(nearer)
            for robot, nearer in spanning_tree(support, names).items()
        }
        self._node = TreeNode(
            TreePlace.of(self.own, parent),
            self._graph(),
            self.config.consensus,
            self.config.elimination_tolerance,
        )

    def _graph(self) -> TreeGraph:
        """Own keyframes, then copies by neighbor, and factors over them: as in edge-ADMM."""
        c = self.config.consensus
        variables: list[Variable] = [(self.own, k) for k in range(self.graph.keyframes)]
        poses = [self.T_world_map[self.own] @ self.T_map_keyframe]
        masks = dict.fromkeys(variables, 1 << self.own)
        self._loop_weights = RobustWeights(self.keep_loops.astype(np.float64), c)
        doubted = [(self.graph.loops, self._loop_weights)]
        self._held: dict[str, RobustWeights] = {}
        for n in self.neighbors.values():
            if holder(self.graph.name, n.name, n.closures) != self.graph.name:
                for k in n.own_keyframes.tolist():
                    masks[self.own, k] |= 1 << n.index
                continue
            assert n.told is not None
            assert n.keep is not None
            slots = len(variables) + np.searchsorted(n.told.keyframes, [k.peer_keyframe for k in n.closures])
            held = closure_factors(n.closures, [k.own_keyframe for k in n.closures], slots, c.closures)
            self._held[n.name] = RobustWeights(n.keep.astype(np.float64), c)
            doubted.append((held, self._held[n.name]))
            variables += [(n.index, k) for k in n.told.keyframes.tolist()]
            poses.append(self.T_world_map[n.index] @ n.told.T_map_keyframe)
        shared = {v: mask for v, mask in masks.items() if mask != 1 << self.own}
        shared |= dict.fromkeys(variables[self.graph.keyframes :], 0)
        return TreeGraph(variables, np.concatenate(poses), shared, self.graph.odometry, doubted)

    def take_message(self, neighbor: Neighbor, code: int, payload: bytes) -> None:
        if code not in list(elimination_wire.Code):
            raise MalformedError(f"unknown message {code}")
        self._arrived.append((neighbor.index, payload))

    def advance(self) -> None:
        assert self._node is not None
        self._arrived, refused = elimination_wire.take_messages(self._node, self._arrived, len(self.team))
        self.refused += refused
        self._node.advance()
        for receiver, message in self._node.outbox:
            payload = elimination_wire.write_message(message, self.config.elimination_wire)
            self.send([self.neighbors[receiver]], payload)
        self._node.outbox.clear()

    # --- results

    @property
    def exchange(self) -> int:
        """Exchanges so far."""
        return 0 if self._node is None else self._node.exchange

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802 (a transform)
        return self.T_map_keyframe if self._node is None else self._node.poses[: self.graph.keyframes]

    @property
    def settled(self) -> bool:
        return self._node is not None and self._node.finished

    def kept(self) -> tuple[Array, dict[str, Array]]:
        if self._node is None:
            return super().kept()
        return self._loop_weights.weights, {peer: robust.weights for peer, robust in self._held.items()}
