"""Exact elimination to separators along a tree of robots: one Gauss-Newton step of the whole team per exchange.

Every robot has its own keyframes and copies of neighbors' keyframes, as in edge-ADMM: a *variable* is named
(owner, keyframe), and several robots may have it. Each robot linearizes its own factors. From the leaves to the root,
a robot adds what its children sent, eliminates every variable that no robot outside its subtree has, and sends the rest
up: a dense quadratic form over the variables that its subtree shares with others. The root solves; the answer comes
down, and every robot finds its eliminated variables from the shared ones. This is the multifrontal method with robots
as fronts: the step is that of the centralized solver, up to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.relative_poses import RelativePoses

Variable = tuple[int, int]  # index of the owner in the team, its keyframe
_FLOOR = 1e-12  # of the largest diagonal entry: keeps a matrix definite where a variable has no factor
_ANCHOR = 1e6  # of the largest diagonal entry, on the root's first keyframe; only fixes the gauge


@dataclass(frozen=True)
class Block:
    """Quadratic form that is left of a subtree: 1/2 d' H d + g' d over its shared variables, H [6 b, 6 b], g [6 b].

    Attributes:
        H: [6 b, 6 b]; None if it is that of the last block: nothing below was linearized anew.
        g: [6 b].
        cost: the subtree's |r|^2 at the linearization point.
        largest_step: largest component of its last step (m, rad).
        reweighted: whether some weight below has changed since the last block.
        unsure: whether some weight below is not final.
    """

    H: Array | None
    g: Array
    cost: float
    largest_step: float
    reweighted: bool
    unsure: bool


@dataclass(frozen=True)
class BackSubstitution:
    """The root's answer to the blocks of one exchange.

    Attributes:
        exchange: number of the exchange.
        accepted: whether the last step lowered the cost; else all robots return to their poses before it.
        finished: whether this is the last message.
        fresh: whether all robots linearize anew.
        damping: for the next blocks.
        delta: [s, 6], steps of the variables shared with the parent.
    """

    exchange: int
    accepted: bool
    finished: bool
    fresh: bool
    damping: float
    delta: Array


class Front:
    """The variables of one robot's subtree, and one linear step over them.

    `shared` are those that go up, in the order in which they were sent to the parent.
    """

    def __init__(
        self,
        own: Sequence[Variable],
        children: Mapping[int, Sequence[Variable]],
        shared: Sequence[Variable],
    ) -> None:
        """Lay out the variables.

        Args:
            own: variables of the robot's own factors, copies included.
            children: by child, its shared variables.
            shared: variables that other robots outside the subtree have.
        """
        everything = [*own, *(v for child in sorted(children) for v in children[child])]
        up = set(shared)
        eliminated = [v for v in dict.fromkeys(everything) if v not in up]
        at = {v: k for k, v in enumerate([*eliminated, *shared])}
        self.shared, self.eliminated, self.size = list(shared), len(eliminated), len(at)
        self.own_slots = np.array([at[v] for v in own], dtype=np.int64)
        self.child_slots = {child: np.array([at[v] for v in children[child]], np.int64) for child in children}
        self._solve: Callable[[Array], Array] | None = None
        self._coupling = self._rest = np.zeros((0, 0))

    def factorize(self, H_own: sparse.csc_matrix, children: Mapping[int, Array]) -> Array:
        """Add the children's blocks to the own one, eliminate; returns H [6 s, 6 s] over the shared ones.

        Args:
            H_own: sparse [6 v, 6 v], of the own factors, over the v own variables in the order in which they
                were given.
            children: by child, [6 b, 6 b], over its b shared variables.

        Raises:
            DuagError: what is to be eliminated is singular in its numbers.
        """
        own = H_own.tocoo()
        slots = _lanes(self.own_slots)
        rows, columns, values = [slots[own.row]], [slots[own.col]], [own.data]
        for child in sorted(children):
            slots, filled = _lanes(self.child_slots[child]), np.nonzero(children[child])
            rows.append(slots[filled[0]])
            columns.append(slots[filled[1]])
            values.append(children[child][filled])
        index = (np.concatenate(rows), np.concatenate(columns))
        shape = (6 * self.size, 6 * self.size)
        H = sparse.coo_matrix((np.concatenate(values), index), shape=shape).tocsc()
        e = 6 * self.eliminated
        across, kept = H[:e, e:], H[e:, e:].toarray()
        self._solve = least_squares.factorized(H[:e, :e].tocsc()) if e else None
        right = across.toarray()
        self._coupling = self._solve(right) if self._solve is not None and right.size else right
        S = kept - across.T @ self._coupling
        return 0.5 * (S + S.T)

    def eliminate(self, g_own: Array, children: Mapping[int, Array]) -> Array:
        """The gradient [6 s] over the shared variables, after `factorize`.

        Args:
            g_own: [v, 6], of the own factors, by tangents (translation, rotation) of the own variables.
            children: by child, [6 b], over its shared variables.
        """
        g = np.zeros(6 * self.size)
        g[_lanes(self.own_slots)] = g_own.ravel()
        for child in sorted(children):
            g[_lanes(self.child_slots[child])] += children[child]
        e = 6 * self.eliminated
        self._rest = self._solve(g[:e]) if self._solve is not None else g[:0]
        return g[e:] - self._coupling.T @ g[:e]

    def resolve(self, shared_step: Array) -> Array:
        """Steps of all variables from those of the shared ones, after `eliminate`.

        Args:
            shared_step: [s, 6], tangents (translation, rotation), m and rad.

        Returns:
            [e + s, 6], likewise: of the e eliminated variables, then of the shared ones.
        """
        eliminated = -self._rest - self._coupling @ shared_step.ravel()
        return np.concatenate([eliminated, shared_step.ravel()]).reshape(-1, 6)


def _lanes(slots: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of the tangents of some variables."""
    return (6 * slots[:, None] + np.arange(6)).ravel()


def damped(
    factors: RelativePoses, jacobians: tuple[Array, Array], n: int, *, damping: float, anchor: int | None
) -> sparse.csc_matrix:
    """Gauss-Newton matrix of a robot's own factors over its n variables, damped relative to its diagonal.

    Args:
        factors: of the robot.
        jacobians: of the factors.
        n: number of variables.
        damping: relative to the diagonal.
        anchor: own variable that is held, at the root: it only fixes the gauge; None: none.
    """
    H = least_squares.curvature_matrix(factors, jacobians, np.zeros((n, 6)))
    scale = H.diagonal().reshape(-1, 6)
    diagonal = damping * scale + _FLOOR * scale.max(initial=1.0)
    if anchor is not None:
        diagonal[anchor] += _ANCHOR * scale.max()
    return (H + sparse.diags(diagonal.ravel())).tocsc()


def shared_variables(owners: Mapping[Variable, int], subtree: int) -> list[Variable]:
    """Variables that a robot outside a subtree has, sorted.

    Args:
        owners: variable -> bit mask of all robots that have it, by its owner's account; 0 if the owner is not
            below.
        subtree: bit mask of the subtree's robots.
    """
    return sorted(v for v, mask in owners.items() if mask == 0 or mask & ~subtree)
