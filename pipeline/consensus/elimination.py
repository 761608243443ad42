"""Exact elimination to separators along a tree of robots: one Gauss-Newton step of the whole team per exchange.

Every robot has its own keyframes and copies of neighbours' keyframes, as in edge-ADMM: a *variable* is named
(owner, keyframe), and several robots may have it. Each robot linearises its own factors. From the leaves to the root,
a robot adds what its children sent, eliminates every variable that nobody outside its subtree has, and sends the rest
up: a dense quadratic form over the variables that its subtree shares with others. The root solves; the answer comes
down, and every robot finds its eliminated variables from the shared ones. This is the multifrontal method with robots
as fronts: the step is that of the centralised solver, up to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from pipeline.consensus import factors as pose_factors
from pipeline.consensus.factors import Factors

Array = NDArray[np.float64]
Variable = tuple[int, int]  # index of the owner in the team, its keyframe
_FLOOR = 1e-12  # of the largest diagonal entry: keeps a matrix definite where nothing holds a variable
_ANCHOR = 1e6  # of the largest diagonal entry, on the root's first keyframe; only fixes the gauge


@dataclass(frozen=True)
class Block:
    """Quadratic form that is left of a subtree: 1/2 d' H d + g' d over its shared variables, H [6 b, 6 b], g [6 b].

    cost: the subtree's |r|^2 at the linearisation point. largest_step: largest component of its last step (m, rad).
    reweighted: some weight below has changed since the last block. unsure: some weight below is not final.
    """

    H: Array
    g: Array
    cost: float
    largest_step: float
    reweighted: bool
    unsure: bool


class Front:
    """The variables of one robot's subtree, and one linear step over them.

    `shared` are those that go up: in the order that the parent was told.
    """

    def __init__(
        self,
        own: Sequence[Variable],
        children: Mapping[int, Sequence[Variable]],
        shared: Sequence[Variable],
    ) -> None:
        """own: variables of the robot's own factors, copies included. children: by child, its shared variables."""
        eliminated = [*own, *(v for child in sorted(children) for v in children[child])]
        eliminated = [v for v in dict.fromkeys(eliminated) if v not in set(shared)]
        order = [*eliminated, *shared]
        at = {v: k for k, v in enumerate(order)}
        self.variables, self.shared, self.eliminated = order, list(shared), len(eliminated)
        self.own_slots = np.array([at[v] for v in own], dtype=np.int64)
        self.child_slots = {child: np.array([at[v] for v in children[child]], np.int64) for child in children}
        self._back: tuple[object, Array, Array] | None = None

    def reduce(
        self,
        factors: Factors,
        weights: Array,
        T: Array,
        children: Mapping[int, Block],
        damping: float,
        anchor: int | None = None,
    ) -> tuple[Array, Array]:
        """Linearise own factors at poses T [own, 4, 4], add the children's blocks, eliminate.

        Args:
            damping: Levenberg-Marquardt, relative to the diagonal. anchor: own variable that is held, at the root.
        Returns:
            H [6 s, 6 s] and g [6 s] over the shared variables.
        """
        g_own, jacobians = pose_factors.gradient(factors, weights, T)
        undamped = pose_factors.curvature_matrix(factors, jacobians, np.zeros_like(g_own))
        scale = undamped.diagonal().reshape(-1, 6)
        diagonal = damping * scale + _FLOOR * scale.max(initial=1.0)
        if anchor is not None:
            diagonal[anchor] += _ANCHOR * scale.max()
        H_own = (undamped + sparse.diags(diagonal.ravel())).tocoo()
        lanes = np.arange(6)
        own = (6 * self.own_slots[:, None] + lanes).ravel()
        g = np.zeros(6 * len(self.variables))
        g[own] = g_own.ravel()
        rows, columns, values = [own[H_own.row]], [own[H_own.col]], [H_own.data]
        for child in sorted(children):
            slots = (6 * self.child_slots[child][:, None] + lanes).ravel()
            block = children[child]
            filled = np.nonzero(block.H)
            rows.append(slots[filled[0]])
            columns.append(slots[filled[1]])
            values.append(block.H[filled])
            g[slots] += block.g
        size = 6 * len(self.variables)
        index = (np.concatenate(rows), np.concatenate(columns))
        H = sparse.coo_matrix((np.concatenate(values), index), shape=(size, size)).tocsc()
        e = 6 * self.eliminated
        H_es = np.ascontiguousarray(H[:e, e:].toarray())
        H_ss, g_s = H[e:, e:].toarray(), g[e:].copy()
        if e == 0:
            self._back = (None, np.zeros((0, len(g_s))), np.zeros(0))
            return H_ss, g_s
        solve = pose_factors.factorised(H[:e, :e].tocsc())
        X = solve(H_es) if H_es.shape[1] else H_es
        y = solve(g[:e])
        self._back = (solve, X, y)
        S = H_ss - H_es.T @ X
        return 0.5 * (S + S.T), g_s - H_es.T @ y

    def resolve(self, shared_step: Array) -> Array:
        """Steps [v, 6] of all variables from those of the shared ones [s, 6]."""
        assert self._back is not None
        _, X, y = self._back
        eliminated = -y - X @ shared_step.ravel()
        return np.concatenate([eliminated, shared_step.ravel()]).reshape(-1, 6)


def shared_variables(everybody: Mapping[Variable, int], subtree: int) -> list[Variable]:
    """Variables that somebody outside a subtree has, sorted.

    Args:
        everybody: variable -> bit mask of all robots that have it, as its owner says; 0 if the owner is not below.
        subtree: bit mask of the subtree's robots.
    """
    return sorted(v for v, mask in everybody.items() if mask == 0 or mask & ~subtree)
