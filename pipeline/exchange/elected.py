"""An elected robot solves for all, to compare with: every robot's graph goes up the tree, one answer comes down.

The elected robot is the root of the tree along which the maps were placed. It weighs all loop closures, and all loops
of single robots, by graduated non-convexity from where the maps were placed, keeps those whose residuals are below the
truncation, and solves what is left. It knows every robot's keyframes and relative poses, which no robot of the other
solvers does, and every robot waits for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.local_problem import with_floor
from duagc.pipeline.exchange.pose_solver import LinkStart, SolverStart
from duagc.pipeline.exchange.wire import elected_wire
from duagc.pipeline.exchange.wire.elected_wire import AnswerPart, GraphPart
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.gnc import INLIER_WEIGHT
from duagc.pipeline.posegraph.initialization import graduated
from duagc.pipeline.posegraph.pose_graph import solve_pose_graph
from duagc.pipeline.posegraph.relative_poses import RelativePoses, closures_as_relative_poses


def solve_for_all(
    parts: Mapping[int, GraphPart], root: int, config: PoseConsensusConfig
) -> dict[int, AnswerPart]:
    """The answer for every robot; the first keyframe of the root stays where it is.

    Args:
        parts: of all robots, by index.
        root: index of the elected robot.
        config: robust threshold and schedule, floors.

    Raises:
        MalformedError: a loop closure is with a robot or a keyframe that is not there.
    """
    order = [root, *sorted(parts.keys() - {root})]
    sizes = [len(parts[r].T_world_keyframe) for r in order]
    first = dict(zip(order, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))
    T = np.concatenate([parts[r].T_world_keyframe for r in order])
    trusted, robust, held = [], [], list[tuple[int, int | None]]()
    for r in order:
        names = first[r] + np.arange(len(parts[r].T_world_keyframe))
        trusted.append(with_floor(parts[r].trusted, config).renamed(names))
        robust.append(with_floor(parts[r].loops, config).renamed(names))
        held.append((r, None))
        for peer, closures in sorted(parts[r].closures.items()):
            theirs = np.array([c.peer_keyframe for c in closures], dtype=np.int64)
            if peer not in parts or np.any(theirs >= len(parts[peer].T_world_keyframe)):
                raise MalformedError("graphs: a loop closure with what is not there")
            own = [first[r] + c.own_keyframe for c in closures]
            robust.append(closures_as_relative_poses(closures, own, first[peer] + theirs, config.closures))
            held.append((r, peer))
    known, doubted = RelativePoses.concatenate(trusted), RelativePoses.concatenate(robust)
    weights, held_first = np.ones(len(doubted)), T[0].copy()
    if config.robust and len(doubted):
        T = graduated(known, doubted, T, config)
        weights = (least_squares.squared_residuals(doubted, T) <= config.truncation**2).astype(np.float64)
    graph = RelativePoses.concatenate([known, doubted.select(weights > 0)])
    T = solve_pose_graph(graph, T).poses
    T = held_first @ se3.inverse(T[0]) @ T
    ends = np.cumsum([len(part) for part in robust])[:-1]
    of = dict(zip(held, np.split(weights, ends), strict=True))
    return {
        r: AnswerPart(
            T[first[r] : first[r] + len(parts[r].T_world_keyframe)],
            of[r, None],
            {peer: of[r, peer] for peer in parts[r].closures},
        )
        for r in order
    }


def _expanded(weights: Array, keep: NDArray[np.bool_]) -> Array:
    """Weights of all from those of the kept ones; the others count zero."""
    out = np.zeros(len(keep))
    out[keep] = weights
    return out


class ElectedSolver:
    """One robot's side; everything that it sends is a reliable message."""

    def __init__(self, start: SolverStart, config: PoseConsensusConfig, team: int) -> None:
        """Lay out the own graph.

        Args:
            start: what the robot knows.
            config: the same at all robots.
            team: number of robots.
        """
        self.start, self.config, self.team = start, config, team
        self.refused: list[str] = []
        own, held = start.own, {link.index: link for link in start.links if link.closures}
        self._keep = {index: np.ones(len(link.closures), bool) for index, link in held.items()}
        loops, self._keep_loops = own.loops, np.ones(len(own.loops), bool)
        if not config.robust:
            self._keep = {index: np.asarray(link.keep, bool) for index, link in held.items()}
            self._keep_loops = np.asarray(own.keep_loops, bool)
            loops = loops.select(self._keep_loops)
        closures = {index: tuple(compress(held[index].closures, keep)) for index, keep in self._keep.items()}
        self._own = GraphPart(start.T_world_map @ own.T_first_keyframe, own.relative_poses, loops, closures)
        self._index = {link.name: link.index for link in start.links}
        self._parts: dict[int, dict[int, GraphPart]] = {}
        self._outbox: list[tuple[int, bytes]] = []
        self._sent = False
        self._answer: AnswerPart | None = None
        self._change = np.inf

    def advance(self) -> None:
        if self._sent or any(child not in self._parts for child in self.start.tree.children):
            return
        self._sent = True
        whole = {self.start.index: self._own}
        for below in self._parts.values():
            whole |= below
        if self.start.tree.parent is not None:
            self._outbox.append((self.start.tree.parent, elected_wire.write_graphs(whole)))
            return
        try:
            self._give(solve_for_all(whole, self.start.index, self.config))
        except (ValueError, IndexError, DuagError) as error:  # of what the others sent
            self.refused.append(str(error))

    def _give(self, answer: dict[int, AnswerPart]) -> None:
        """Keep the own part of the answer, and pass the others on."""
        mine, own = answer.pop(self.start.index), self._own
        weights = {peer: len(w) for peer, w in mine.closure_weights.items()}
        sizes = len(mine.T_world_keyframe), len(mine.loop_weights), weights
        closures = {peer: len(c) for peer, c in own.closures.items()}
        if sizes != (len(own.T_world_keyframe), len(own.loops), closures):
            raise MalformedError("answer: of another graph")
        if not np.isfinite(mine.T_world_keyframe).all():
            raise MalformedError("answer: not a finite number")
        self._change = float(np.abs(mine.T_world_keyframe - own.T_world_keyframe).max())
        self._answer = mine
        for child in self.start.tree.children:
            below = {r: part for r, part in answer.items() if r in self._parts[child]}
            self._outbox.append((child, elected_wire.write_answer(below)))

    def states(self, neighbor: LinkStart, room_bytes: int) -> list[bytes]:
        """Nothing: everything that this solver sends is a reliable message.

        Args:
            neighbor: the receiver.
            room_bytes: not used.
        """
        return []

    def take_state(self, neighbor: LinkStart, payload: bytes) -> None:
        """Refuse what a neighbor sent in a round: this solver uses no poses of a round.

        Args:
            neighbor: the sender.
            payload: not read.

        Raises:
            ValueError: always.
        """
        raise ValueError("state: poses, where an elected robot sends them in a message")

    def messages(self) -> list[tuple[int, bytes]]:
        sent, self._outbox = self._outbox, []
        return sent

    def take_message(self, sender: int, payload: bytes) -> None:
        """Use graphs of a child, or the answer of the parent; what cannot be used goes to `refused`.

        Args:
            sender: index of the neighbor.
            payload: of its message, from `elected_wire`.
        """
        try:
            if sender in self.start.tree.children and sender not in self._parts:
                self._parts[sender] = self._read_graphs(sender, payload)
            elif sender == self.start.tree.parent and self._sent and self._answer is None:
                answer = elected_wire.read_answer(payload)
                if self.start.index not in answer:
                    raise MalformedError("answer: lacks this robot")
                self._give(answer)
            else:
                raise MalformedError("elected: not expected from this robot, or came twice")
        except ValueError as error:
            self.refused.append(str(error))

    def _read_graphs(self, child: int, payload: bytes) -> dict[int, GraphPart]:
        """The graphs of a child's subtree: of robots below this one that no other child sent."""
        parts = elected_wire.read_graphs(payload, self.team)
        known = {self.start.index}.union(*self._parts.values())
        if child not in parts or any(r in known or not self.start.tree.subtree >> r & 1 for r in parts):
            raise MalformedError("graphs: lacks its sender, or has a robot that is not below it")
        return parts

    @property
    def converged(self) -> bool:
        return self._answer is not None

    @property
    def largest_change(self) -> float:
        return self._change if self._answer is None else 0.0

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802
        found = self._own if self._answer is None else self._answer
        return found.T_world_keyframe.copy()

    def weights(self, peer: str) -> Array:
        """Robust weight of every loop closure held with a neighbor; before the answer, what it begins with.

        Args:
            peer: name of the neighbor.

        Returns:
            [m], 0 to 1, in the order in which the loop closures were given; 0 where they were left out.
        """
        index = self._index[peer]
        keep = self._keep.get(index, np.zeros(0, bool))
        if self._answer is None or not len(keep):
            return keep.astype(np.float64)
        return _expanded(self._answer.closure_weights[index], keep)

    @property
    def loop_weights(self) -> Array:
        if self._answer is None:
            return self.start.own.keep_loops.astype(np.float64)
        return _expanded(self._answer.loop_weights, self._keep_loops)

    def refuted(self, peer: str) -> bool:
        """Whether the answer leaves too few of the loop closures held with a neighbor; False before it.

        Args:
            peer: name of the neighbor.
        """
        index = self._index[peer]
        if self._answer is None or index not in self._own.closures:
            return False
        inliers = int(np.count_nonzero(self.weights(peer) >= INLIER_WEIGHT))
        return inliers < self.config.closures.min_support

    def residuals(self) -> dict[str, Any]:
        names = {index: name for name, index in self._index.items()}
        done = int(self._answer is not None)
        return {
            "primal": 0.0,
            "dual": 0.0,
            "cost": 0.0,
            "step": self.largest_change,
            "penalties": dict.fromkeys(self._index, (0.0, 0.0)),
            "versions": dict.fromkeys(self._index, done),
            "weights": {names[index]: self.weights(names[index]).tolist() for index in self._own.closures},
            "factorizations": done,
        }
