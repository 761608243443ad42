"""One robot's block of the team's poses: the minimum over own keyframes, with all others held where they are.

The cost is that of own relative poses and of the loop closures with neighbors, whose keyframes are constants. Each step
is one of Gauss and Newton, shortened until the cost does not rise; so no block update raises the cost of the team.
"""

from __future__ import annotations

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.least_squares import retract
from duagc.pipeline.posegraph.relative_poses import RelativePoses

STEPS, HALVINGS = 5, 20
_ROUNDING = 1e-12  # relative rise of the cost that is no rise


def minimized(
    factors: RelativePoses, weights: Array, x: Array, held: Array, *, config: PoseConsensusConfig
) -> Array:
    """Own keyframes [n, 4, 4] at their minimum, as far as a few steps lead.

    Args:
        factors: between own keyframes, 0 to n, and to those of neighbors, which follow.
        weights: one of every factor.
        x: [n, 4, 4], own keyframes to start from.
        held: [k, 4, 4], keyframes of neighbors.
        config: longest turn of a step, and the tolerance.
    """
    counts = weights > 0.0
    graph, weights = factors.select(counts), weights[counts]
    for _ in range(STEPS):
        moved = _step(graph, weights, x, held, limit_rad=config.step_limit_rad)
        change = float(np.abs(least_squares.difference(moved, x)).max())
        x = moved
        if change < 0.1 * config.tolerance:
            break
    return x


def _step(graph: RelativePoses, weights: Array, x: Array, held: Array, *, limit_rad: float) -> Array:
    """One Gauss-Newton step of the own keyframes; they stay if no part of it lowers the cost."""
    n, everything = len(x), np.concatenate([x, held])
    before = least_squares.cost(graph, everything, weights)
    g, jacobians = least_squares.gradient(graph, weights, everything)
    stiffest = max(float((J**2).sum(axis=1).max(initial=0.0)) for J in jacobians)
    diagonal = np.full_like(g, 1e-9 * max(stiffest, 1e-300))  # nothing may hold the own keyframes
    H = least_squares.curvature_matrix(graph, jacobians, diagonal)[: 6 * n, : 6 * n]
    delta = -least_squares.factorized(H.tocsc())(g[:n].ravel()).reshape(-1, 6)
    turn_rad = float(np.linalg.norm(delta[:, 3:], axis=1).max())
    delta *= min(1.0, limit_rad / max(turn_rad, 1e-12))
    for _ in range(HALVINGS):
        moved = retract(x, delta)
        if least_squares.cost(graph, np.concatenate([moved, held]), weights) <= before * (1 + _ROUNDING):
            return moved
        delta /= 2.0
    return x
