"""A pose graph solved in one place: a robot's own, or the team's, which the decentralized solver must reach."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.posegraph import factors as pose_factors
from duagc.pipeline.posegraph.factors import Factors
from duagc.pipeline.posegraph.loop_closures import Closure, ClosureConfig, closure_factors

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CentralSolution:
    """T_world_keyframe [n, 4, 4], the cost sum w |r|^2, steps taken, and whether the step fell below tolerance."""

    poses: Array
    cost: float
    iterations: int
    converged: bool


def solve_central(
    factors: Factors,
    T_start: Array,
    weights: ArrayLike = 1.0,
    *,
    iterations: int = 100,
    tolerance: float = 1e-10,
) -> CentralSolution:
    """Minimize sum w |r|^2 by Levenberg-Marquardt; pose 0 is held, which only fixes the gauge.

    Args:
        factors: relative poses between the n variables; the graph must be connected.
        T_start: T_world_keyframe [n, 4, 4].
        weights: one per factor, or one for all.
        iterations: limit, damped attempts included.
        tolerance: on the largest component of a step (m, rad).
    """
    w = np.broadcast_to(np.asarray(weights, dtype=np.float64), (len(factors),))
    T, damping, converged, step = np.array(T_start, dtype=np.float64), 0.0, False, 0
    value = pose_factors.cost(factors, T, w)
    while step < iterations and not converged and len(factors):
        step += 1
        g, jacobians = pose_factors.gradient(factors, w, T)
        undamped = pose_factors.curvature_matrix(factors, jacobians, np.zeros_like(g))
        scale = undamped.diagonal().reshape(-1, 6)
        diagonal = damping * scale + 1e-12 * scale.max()
        diagonal[0] += 1e6 * scale.max()
        solve = pose_factors.factorized(pose_factors.curvature_matrix(factors, jacobians, diagonal))
        delta = -solve(g.ravel()).reshape(-1, 6)
        candidate = pose_factors.retract(T, delta)
        candidate_value = pose_factors.cost(factors, candidate, w)
        converged = bool(np.abs(delta).max() < tolerance)
        if candidate_value <= value:
            T, value = candidate, candidate_value
            damping = 0.0 if damping < 1e-7 else damping / 10
        elif not converged:
            damping = max(1e-6, 10 * damping)
    return CentralSolution(T, value, step, converged)


@dataclass(frozen=True)
class Team:
    """A whole team's graph: variables of all robots one after the other, in order of name."""

    first: dict[str, int]
    factors: Factors
    T_start: Array

    def of(self, robot: str, poses: Array) -> Array:
        """One robot's poses out of the team's [n, 4, 4]."""
        ends = sorted([*self.first.values(), len(self.T_start)])
        start = self.first[robot]
        return poses[start : ends[ends.index(start) + 1]]


def team_graph(
    T_world_keyframe: Mapping[str, Array],
    odometry: Mapping[str, Factors],
    closures: Sequence[tuple[str, str, Sequence[Closure]]],
    config: ClosureConfig,
) -> Team:
    """Put the whole team into one graph.

    Args:
        T_world_keyframe: start [n, 4, 4] of every robot, in one frame.
        odometry: every robot's own factors, as its agent uses them (`PoseAgent.odometry`).
        closures: (own robot, peer robot, closures that the own robot holds); factors in this order after the odometry.
        config: for the sigma floor, as the agents use it.
    """
    first, count = {}, 0
    for robot in sorted(T_world_keyframe):
        first[robot] = count
        count += len(T_world_keyframe[robot])
    parts = [
        odometry[robot].renamed(first[robot] + np.arange(len(T_world_keyframe[robot])))
        for robot in sorted(first)
    ]
    for own, peer, held in closures:
        i = [first[own] + c.own_keyframe for c in held]
        j = [first[peer] + c.peer_keyframe for c in held]
        parts.append(closure_factors(held, i, j, config))
    start = np.concatenate([T_world_keyframe[robot] for robot in sorted(first)])
    return Team(first, Factors.concatenate(parts), start)
