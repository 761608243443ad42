"""Exact elimination on the wire: blocks go up the best supported tree of robots, steps come down.

One exchange is a block up and a step down every link of the tree: a Gauss-Newton step of the whole team, damped after
Levenberg and Marquardt where it would not lower the cost. A matrix is sent again only where rotations below moved (or
weights or damping changed); gradients always. The root, the lowest name, only adds and decides on the
damping; it sees a quadratic form over shared keyframes, nobody's graph.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.consensus import factors as pose_factors
from pipeline.consensus.closures import closure_factors, holder, spanning_tree
from pipeline.consensus.elimination import Block, Front, Variable, damped, shared_variables
from pipeline.consensus.factors import Factors, retract
from pipeline.consensus.graphs import RobotGraph
from pipeline.consensus.robust import RobustWeights
from pipeline.exchange.packets import MalformedError
from pipeline.posegraph import wire
from pipeline.posegraph.agent import GraphAgent, Neighbour
from pipeline.posegraph.config import PoseGraphConfig
from pipeline.posegraph.wire import Code, Step

Array = NDArray[np.float64]
_SLOW = 0.5  # share of the step before from which the matrices are too old
_ROUNDING = 1e-10  # relative rise of the cost that is no rise


class EliminationAgent(GraphAgent):
    """A node of the tree.

    Copies must start where their owners are to the last bit but a few: every step moves both alike.
    """

    precision = "float64"

    def __init__(self, graph: RobotGraph, team: Sequence[str], config: PoseGraphConfig) -> None:
        super().__init__(graph, team, config)
        self.exchange, self.finished, self._laid_out = 0, False, False
        self._arrived: list[
            tuple[Neighbour, bytes]
        ] = []  # to be used in `advance`: some come before the start

    def start(self) -> None:
        self.first_round = self.round
        names = [self.team[m] for m in self.T_world_map]
        support = {(self.team[a], self.team[b]): float(f.support) for (a, b), f in self._frames.items()}
        tree = {
            self.team.index(robot): None if parent is None else self.team.index(parent)
            for robot, parent in spanning_tree(support, names).items()
        }
        self._parent = tree[self.own]
        self._children = sorted(robot for robot, parent in tree.items() if parent == self.own)
        self._subtree = 0
        for robot in tree:
            at: int | None = robot
            while at is not None and at != self.own:
                at = tree[at]
            self._subtree |= (at == self.own) << robot
        self._fronts: dict[int, dict[Variable, int]] = {}
        self._blocks: dict[int, Block] = {}
        self._damping = self._damped = self._largest_step = 0.0
        self._moved_rad = np.inf  # since the last linearisation
        self._matrices: dict[int, Array] = {}  # by child: the last one that came
        self._step_before = np.inf
        self._cost: float | None = None  # at the root: of the last accepted poses
        self._sent = -1  # exchange whose block went up
        self._variables_of_own()

    def _variables_of_own(self) -> None:
        """Own keyframes, then copies by neighbour, and factors over them: as in edge-ADMM."""
        self._variables: list[Variable] = [(self.own, k) for k in range(self.graph.keyframes)]
        poses = [self.T_world_map[self.own] @ self.T_map_keyframe]
        masks = dict.fromkeys(range(self.graph.keyframes), 1 << self.own)
        parts, c = [self.own_factors()], self.config.consensus
        self._held: dict[str, tuple[Factors, RobustWeights]] = {}
        for n in self.neighbours.values():
            if holder(self.graph.name, n.name, n.closures) != self.graph.name:
                for k in n.own_keyframes.tolist():
                    masks[k] |= 1 << n.index
                continue
            assert n.told is not None
            assert n.keep is not None
            slots = len(self._variables) + np.searchsorted(
                n.told.keyframes, [k.peer_keyframe for k in n.closures]
            )
            held = closure_factors(n.closures, [k.own_keyframe for k in n.closures], slots, c.closures)
            self._held[n.name] = (held, RobustWeights(n.keep.astype(np.float64), c))
            self._variables += [(n.index, k) for k in n.told.keyframes.tolist()]
            poses.append(self.T_world_map[n.index] @ n.told.T_map_keyframe)
            parts.append(held)
        self._x = self._before = np.concatenate(poses)
        self._factors = Factors.concatenate(parts)
        self._loop_weights = RobustWeights(self.keep_loops.astype(np.float64), c)
        everybody = {(self.own, k): mask for k, mask in masks.items() if mask != 1 << self.own}
        copies = dict.fromkeys(self._variables[self.graph.keyframes :], 0)
        self._everybody: dict[Variable, int] = {**copies, **everybody}

    # --- messages

    def take_message(self, neighbour: Neighbour, code: int, payload: bytes) -> None:

        if code not in (Code.FRONT, Code.BLOCK, Code.STEP):
            raise MalformedError(f"unknown message {code}")
        self._arrived.append((neighbour, payload))

    def advance(self) -> None:
        arrived, self._arrived = self._arrived, []
        for n, payload in arrived:
            try:
                self._use(n, payload)
            except MalformedError as error:
                self.refused.append(str(error))
        if not self._laid_out and set(self._fronts) == set(self._children):
            self._lay_out()
        if self._laid_out and not self.finished and set(self._blocks) == set(self._children):
            self._reduce()

    def _use(self, n: Neighbour, payload: bytes) -> None:
        code = payload[0]
        if code == Code.STEP and n.index == self._parent and self._laid_out:
            self._descend(wire.read_step(payload, len(self._front.shared)))
        elif code == Code.FRONT and n.index in self._children:
            self._fronts[n.index] = wire.read_front(payload, len(self.team))
        elif code == Code.BLOCK and n.index in self._children and n.index in self._fronts:
            exchange, block = wire.read_block(payload, len(self._fronts[n.index]))
            if exchange != self.exchange:
                raise MalformedError(f"block of exchange {exchange} in exchange {self.exchange}")
            if block.H is not None:
                self._matrices[n.index] = block.H
            elif n.index not in self._matrices:
                raise MalformedError("block without its first matrix")
            self._blocks[n.index] = block
        else:
            raise MalformedError(f"message {code} does not come from there, or not now")

    # --- one exchange

    def _lay_out(self) -> None:
        """All children have said what they share: say the same to the parent."""
        self._laid_out = True
        known = dict(self._everybody)
        for child in self._children:
            for v, mask in self._fronts[child].items():
                known[v] = known.get(v, 0) | mask
        shared = shared_variables(known, self._subtree)
        self._front = Front(self._variables, {c: list(self._fronts[c]) for c in self._children}, shared)
        if self._parent is not None:
            payload = wire.write_front({v: known[v] for v in shared})
            self.send([self.neighbours[self._parent]], payload)

    def _reduce(self) -> None:
        """All blocks of this exchange are here: eliminate; send up, or decide at the root."""
        if self._sent == self.exchange:
            return
        self._sent = self.exchange
        reweighted = self._weigh()
        weights, blocks = self._weights(), self._blocks.values()
        g, jacobians = pose_factors.gradient(self._factors, weights, self._x)
        H = self._relinearised(jacobians, reweighted)
        block = Block(
            H,
            self._front.eliminate(g, {child: b.g for child, b in self._blocks.items()}),
            pose_factors.cost(self._factors, self._x, weights) + sum(b.cost for b in blocks),
            max([self._largest_step, *(b.largest_step for b in blocks)]),
            reweighted or any(b.reweighted for b in blocks),
            self._unsure() or any(b.unsure for b in blocks),
        )
        if self._parent is None:
            self._decide_step(block)
        else:
            payload = wire.write_block(self.exchange, block, self.config.elimination_wire)
            self.send([self.neighbours[self._parent]], payload)

    def _relinearised(self, jacobians: tuple[Array, Array], reweighted: bool) -> Array | None:
        """The eliminated matrix, or None if the last one still holds: here, and everywhere below."""
        moved = self._moved_rad > self.config.consensus.relinearise_rad
        stale = moved or reweighted or self._damping != self._damped
        if stale:
            anchor = 0 if self._parent is None else None
            self._H_own = damped(self._factors, jacobians, len(self._x), self._damping, anchor)
            self._moved_rad, self._damped = 0.0, self._damping
        if not stale and all(block.H is None for block in self._blocks.values()):
            return None
        return self._front.factorise(self._H_own, self._matrices)

    def _decide_step(self, block: Block) -> None:
        """At the root: was the last step good, and what comes next."""
        small = block.largest_step < self.config.elimination_tolerance and self.exchange > 0
        accepted = block.reweighted or self._cost is None or block.cost <= self._cost * (1 + _ROUNDING)
        damping = max(1e-6, 10 * self._damping) if not accepted else self._damping / 10
        if accepted:
            self._cost = block.cost
            damping = damping if damping > 1e-8 else 0.0
        fresh = not accepted or block.largest_step > _SLOW * self._step_before
        self._step_before = block.largest_step if self.exchange else np.inf
        finished = small and not block.unsure
        self._descend(Step(self.exchange, accepted, finished, fresh, damping, np.zeros((0, 6))))

    def _descend(self, step: Step) -> None:
        """Move, and hand the children their part of the step."""
        if step.exchange != self.exchange:
            raise MalformedError(f"step of exchange {step.exchange} in exchange {self.exchange}")
        if step.accepted:
            delta = self._front.resolve(step.delta)
            own = delta[self._front.own_slots]
            self._before, self._x = self._x, retract(self._x, own)
            self._largest_step = float(np.abs(own).max())
            self._moved_rad += float(np.abs(own[:, 3:]).max())
        else:
            delta, self._x = np.zeros((0, 6)), self._before
        for child in self._children:
            part = delta[self._front.child_slots[child]] if step.accepted else delta
            answer = Step(step.exchange, step.accepted, step.finished, step.fresh, step.damping, part)
            self.send([self.neighbours[child]], wire.write_step(answer))
        if step.fresh:
            self._moved_rad = np.inf
        self._damping, self.finished = step.damping, step.finished
        self._blocks = {}
        self.exchange += 1

    # --- robust weights: one step of the schedule per exchange

    def _weigh(self) -> bool:
        """Take the next robust weights; True if some changed."""
        received = float(self.exchange * self.config.consensus.robust_packets)
        groups = [(self.graph.loops, self._loop_weights), *self._held.values()]

        def squared(factors: Factors) -> Array:
            return pose_factors.squared_residuals(factors, self._x)

        changed = False
        for factors, robust in groups:
            changed |= robust.advance(received, False, lambda factors=factors: squared(factors))  # type: ignore[misc]
        return changed

    def _weights(self) -> Array:
        held = [robust.weights for _, robust in self._held.values()]
        return np.concatenate([np.ones(len(self.graph.odometry)), self._loop_weights.weights, *held])

    def _unsure(self) -> bool:
        return not (self._loop_weights.done and all(robust.done for _, robust in self._held.values()))

    # --- results

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802 (a transform)
        return self._x[: self.graph.keyframes] if self.T_world_map else self.T_map_keyframe

    @property
    def settled(self) -> bool:
        return self.finished

    def kept(self) -> tuple[Array, dict[str, Array]]:
        if not self.T_world_map:
            return super().kept()
        held = {peer: robust.weights for peer, (_, robust) in self._held.items()}
        return self._loop_weights.weights, held
