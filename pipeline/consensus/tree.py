"""One robot's node in the elimination along a tree of robots: how it answers the messages of its neighbors there.

One exchange is a block up and a step down every link of the tree: a Gauss-Newton step of the whole team, damped after
Levenberg and Marquardt where it would not lower the cost. A matrix is sent again only where rotations below moved (or
weights or damping changed); gradients always. The root only adds and decides on the damping; it sees a quadratic form
over shared keyframes, no robot's graph.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.elimination import (
    BackSubstitution,
    Block,
    Front,
    Variable,
    damped,
    shared_variables,
)
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.gnc import RobustWeights
from duagc.pipeline.posegraph.least_squares import retract
from duagc.pipeline.posegraph.relative_poses import RelativePoses

Message = dict[Variable, int] | tuple[int, Block] | BackSubstitution
"""Up: which robots have which variables, or a block and its exchange. Down: a step."""
_SLOW = 0.5  # share of the step before from which the matrices are too old
_ROUNDING = 1e-10  # relative rise of the cost that is no rise


@dataclass(frozen=True)
class TreePlace:
    """A robot's place in the tree.

    Attributes:
        own: own index.
        parent: index of the parent; None: it is the root.
        children: indices.
        subtree: bit mask of all robots below, itself included.
    """

    own: int
    parent: int | None
    children: tuple[int, ...]
    subtree: int

    @staticmethod
    def of(own: int, parent: Mapping[int, int | None]) -> TreePlace:
        """From the parent of every robot of the component.

        Args:
            own: own index.
            parent: index of the parent by that of the robot; None for the root.
        """
        subtree = 0
        for robot in parent:
            at: int | None = robot
            while at is not None and at != own:
                at = parent[at]
            subtree |= (at == own) << robot
        return TreePlace(own, parent[own], tuple(sorted(r for r, p in parent.items() if p == own)), subtree)


@dataclass(frozen=True)
class TreeGraph:
    """The part of the team's graph that one robot has.

    Attributes:
        variables: own keyframes, then copies of neighbors' keyframes.
        poses: [v, 4, 4], initial values; a copy must start where its owner starts, up to rounding, because every step
            moves both alike.
        shared: variables that others have too, with the mask of all robots that have them by their owner's account;
            0 for copies.
        trusted: factors of weight one.
        robust: groups of factors with robust weights.
    """

    variables: Sequence[Variable]
    poses: Array
    shared: Mapping[Variable, int]
    trusted: RelativePoses
    robust: Sequence[tuple[RelativePoses, RobustWeights]]


class TreeNode:
    """One node. Messages come in by `take_...`; `advance` computes; what is to be sent lies in `outbox`."""

    def __init__(
        self, place: TreePlace, graph: TreeGraph, config: PoseConsensusConfig, tolerance: float
    ) -> None:
        """Start at exchange 0.

        Args:
            place: in the tree.
            graph: the robot's part of it.
            config: the same at all robots.
            tolerance: the steps end when nothing moves more than this (m, rad).
        """
        self.place, self.graph, self.config, self.tolerance = place, graph, config, tolerance
        self.poses = self._before = np.array(graph.poses)
        self.exchange, self.finished = 0, False
        self.outbox: list[tuple[int, Message]] = []
        self.largest_step = 0.0
        self.factorizations = 0
        self._factors = RelativePoses.concatenate([graph.trusted, *(factors for factors, _ in graph.robust)])
        self._front: Front | None = None
        self._fronts: dict[int, dict[Variable, int]] = {}
        self._blocks: dict[int, Block] = {}
        self._matrices: dict[int, Array] = {}  # by child: the last one that came
        self._damping = self._damped = 0.0
        self._moved_rad = self._step_before = np.inf  # since the last linearization; of the exchange before
        self._cost: float | None = None  # at the root: of the last accepted poses
        self._returned = False  # at the root: the last step was refused, all are where they were before it
        self._sent = -1  # exchange whose block went up

    # --- messages

    def take_front(self, child: int, owners: dict[Variable, int]) -> None:
        """A child's subtree shares these variables with others.

        Args:
            child: index of the sender.
            owners: mask of all robots that have each variable, by its owner's account; 0 if the owner is not
                below.

        Raises:
            ValueError: it is not from a child, or came before.
        """
        if child not in self.place.children or child in self._fronts:
            raise ValueError("front: not from a child, or received before")
        self._fronts[child] = owners

    def take_block(self, child: int, exchange: int, block: Block) -> None:
        """What is left of a child's subtree in this exchange.

        Args:
            child: index of the sender.
            exchange: number of the exchange.
            block: over the variables of its front, in their order.

        Raises:
            ValueError: it is of another exchange, or the first one has no matrix.
        """
        if exchange != self.exchange:
            raise ValueError(f"block of exchange {exchange} in exchange {self.exchange}")
        if block.H is not None:
            self._matrices[child] = block.H
        elif child not in self._matrices:
            raise ValueError("block without its first matrix")
        self._blocks[child] = block

    def take_step(self, sender: int, step: BackSubstitution) -> None:
        """The parent's answer.

        Args:
            sender: index of the robot that sent it.
            step: of the variables of the own front, in their order.

        Raises:
            ValueError: it is not from the parent, or not of this exchange.
        """
        if sender != self.place.parent:
            raise ValueError("step: not from the parent")
        self._descend(step)

    def waits_for_front(self, child: int) -> bool:
        """Whether a child has not yet sent its shared variables.

        Args:
            child: index of the sender.
        """
        return child in self.place.children and child not in self._fronts

    def variables_of(self, child: int) -> int:
        """How many variables a child's blocks are about.

        Args:
            child: index of the sender.

        Raises:
            ValueError: it is no child, or has not sent its shared variables.
        """
        if child not in self._fronts:
            raise ValueError("block: not from a child, or before its front")
        return len(self._fronts[child])

    def variables_above(self) -> int:
        """How many variables a step of the parent is about."""
        if self._front is None:
            raise ValueError("step: before all children have sent their shared variables")
        return len(self._front.shared)

    # --- one exchange

    def advance(self) -> None:
        """Lay out once all children have sent their shared variables; send a block up once theirs are here."""
        if self._front is None and set(self._fronts) == set(self.place.children):
            self._lay_out()
        here = set(self._blocks) == set(self.place.children)
        if self._front is not None and here and not self.finished and self._sent != self.exchange:
            self._reduce(self._front)

    def _lay_out(self) -> None:
        """All children have sent their shared variables: send the own ones to the parent."""
        known = dict(self.graph.shared)
        for child in self.place.children:
            for v, mask in self._fronts[child].items():
                known[v] = known.get(v, 0) | mask
        # nothing is shared beyond the root, whatever a front claims
        shared = [] if self.place.parent is None else shared_variables(known, self.place.subtree)
        children = {c: list(self._fronts[c]) for c in self.place.children}
        self._front = Front(self.graph.variables, children, shared)
        if self.place.parent is not None:
            self.outbox.append((self.place.parent, {v: known[v] for v in shared}))

    def _reduce(self, front: Front) -> None:
        """All blocks of this exchange are here: eliminate; send up, or decide at the root."""
        self._sent = self.exchange
        reweighted = self._weigh()
        weights, blocks = self._weights(), self._blocks.values()
        g, jacobians = least_squares.gradient(self._factors, weights, self.poses)
        H = self._relinearized(front, jacobians, reweighted)
        block = Block(
            H,
            front.eliminate(g, {child: b.g for child, b in self._blocks.items()}),
            least_squares.cost(self._factors, self.poses, weights) + sum(b.cost for b in blocks),
            max([self.largest_step, *(b.largest_step for b in blocks)]),
            reweighted or any(b.reweighted for b in blocks),
            not self.robust_done or any(b.unsure for b in blocks),
        )
        if self.place.parent is None:
            self._decide_step(block)
        else:
            self.outbox.append((self.place.parent, (self.exchange, block)))

    def _relinearized(self, front: Front, jacobians: tuple[Array, Array], reweighted: bool) -> Array | None:
        """The eliminated matrix, or None if the last one still holds: here, and everywhere below."""
        moved = self._moved_rad > self.config.relinearize_rad
        stale = moved or reweighted or self._damping != self._damped
        if stale:
            anchor = 0 if self.place.parent is None else None
            self._H_own = damped(
                self._factors, jacobians, len(self.poses), damping=self._damping, anchor=anchor
            )
            self._moved_rad, self._damped = 0.0, self._damping
        if not stale and all(block.H is None for block in self._blocks.values()):
            return None
        self.factorizations += 1
        return front.factorize(self._H_own, self._matrices)

    def _decide_step(self, block: Block) -> None:
        """At the root: was the last step good, and what comes next."""
        small = block.largest_step < self.tolerance and self.exchange > 0
        accepted = block.reweighted or self._cost is None or block.cost <= self._cost * (1 + _ROUNDING)
        damping = self._damping  # of the step that comes after a return: it is the first one at these poses
        if not accepted:
            damping = max(1e-6, 10 * damping)
        elif not self._returned:
            damping = damping / 10 if damping > 1e-7 else 0.0
        if accepted:
            self._cost = block.cost
        self._returned = not accepted
        fresh = not accepted or block.largest_step > _SLOW * self._step_before
        self._step_before = block.largest_step if self.exchange else np.inf
        finished = small and not block.unsure
        self._descend(BackSubstitution(self.exchange, accepted, finished, fresh, damping, np.zeros((0, 6))))

    def _descend(self, step: BackSubstitution) -> None:
        """Move, and hand the children their part of the step."""
        if step.exchange != self.exchange or self._sent != self.exchange or self._front is None:
            raise ValueError(f"step of exchange {step.exchange} in exchange {self.exchange}")
        if step.accepted:
            delta = self._front.resolve(step.delta)
            own = delta[self._front.own_slots]
            self._before, self.poses = self.poses, retract(self.poses, own)
            self.largest_step = float(np.abs(own).max())
            self._moved_rad += float(np.abs(own[:, 3:]).max())
        else:
            delta, self.poses = np.zeros((0, 6)), self._before
        for child in self.place.children:
            part = delta[self._front.child_slots[child]] if step.accepted else delta
            answer = BackSubstitution(
                step.exchange, step.accepted, step.finished, step.fresh, step.damping, part
            )
            self.outbox.append((child, answer))
        if step.fresh:
            self._moved_rad = np.inf
        self._damping, self.finished = step.damping, step.finished
        self._blocks = {}
        self.exchange += 1

    # --- robust weights: one step of the schedule per exchange

    def _weigh(self) -> bool:
        """Take the next robust weights; True if some changed."""
        received, changed = float(self.exchange * self.config.robust_packets), False
        for factors, robust in self.graph.robust:

            def squared(factors: RelativePoses = factors) -> Array:
                return least_squares.squared_residuals(factors, self.poses)

            steady = robust.scheduled and self.largest_step < self.tolerance
            changed |= robust.advance(received, steady, squared)
        return changed

    def _weights(self) -> Array:
        graduated = [robust.weights for _, robust in self.graph.robust]
        return np.concatenate([np.ones(len(self.graph.trusted)), *graduated])

    @property
    def robust_done(self) -> bool:
        """Whether the weights of all own factors are final."""
        return all(robust.done for _, robust in self.graph.robust)

    @property
    def cost(self) -> float:
        """Of the own factors, weighted."""
        return least_squares.cost(self._factors, self.poses, self._weights())
