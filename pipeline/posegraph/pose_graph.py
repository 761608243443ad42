"""A pose graph solved in one place: a robot's own, or the team's, which the decentralized solver must reach."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from duagc.pipeline.base.arrays import Array, rows_not_finite
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.relative_poses import (
    HeldLoopClosures,
    RelativePoses,
    closures_as_relative_poses,
)


@dataclass(frozen=True)
class PoseGraphSolution:
    """A minimum of a pose graph.

    Attributes:
        poses: T_world_keyframe [n, 4, 4].
        cost: sum w |r|^2, no unit.
        iterations: steps taken.
        converged: the step fell below the tolerance.
    """

    poses: Array
    cost: float
    iterations: int
    converged: bool


def solve_pose_graph(
    relative_poses: RelativePoses,
    T_start: Array,
    weights: ArrayLike = 1.0,
    *,
    iterations: int = 100,
    tolerance: float = 1e-10,
) -> PoseGraphSolution:
    """Minimize sum w |r|^2 by Levenberg-Marquardt; pose 0 is held, which only fixes the gauge.

    Args:
        relative_poses: between the n variables; the graph must be connected.
        T_start: T_world_keyframe [n, 4, 4].
        weights: [m], one per relative pose, or one for all.
        iterations: limit, damped attempts included.
        tolerance: on the largest component of a step (m, rad).
    Returns:
        The poses, and whether they converged; the cost is that of `least_squares`.
    Raises:
        DuagError: a number is not finite, or the graph cannot be solved for.
    """
    w = np.broadcast_to(np.asarray(weights, dtype=np.float64), (len(relative_poses),))
    measured = {"relative pose": relative_poses.T_i_j, "information": relative_poses.information}
    for name, numbers in ({"start": T_start, "weight": w} | measured).items():
        if len(bad := rows_not_finite(numbers)):
            raise DuagError(f"pose graph: {name} {bad[0]} is not finite, expected finite numbers")
    T, damping, converged, step = np.array(T_start, dtype=np.float64), 0.0, False, 0
    value = least_squares.cost(relative_poses, T, w)
    while step < iterations and not converged and len(relative_poses):
        step += 1
        g, jacobians = least_squares.gradient(relative_poses, w, T)
        undamped = least_squares.curvature_matrix(relative_poses, jacobians, np.zeros_like(g))
        scale = undamped.diagonal().reshape(-1, 6)
        diagonal = damping * scale + 1e-12 * scale.max()
        diagonal[0] += 1e6 * scale.max()
        solve = least_squares.factorized(least_squares.curvature_matrix(relative_poses, jacobians, diagonal))
        delta = -solve(g.ravel()).reshape(-1, 6)
        candidate = least_squares.retract(T, delta)
        candidate_value = least_squares.cost(relative_poses, candidate, w)
        converged = bool(np.abs(delta).max() < tolerance)
        if candidate_value <= value:
            T, value = candidate, candidate_value
            damping = 0.0 if damping < 1e-7 else damping / 10
        elif not converged:
            damping = max(1e-6, 10 * damping)
    return PoseGraphSolution(T, value, step, converged)


@dataclass(frozen=True)
class PoseGraph:
    """A team's graph: variables of all robots one after the other, in order of name.

    Attributes:
        first: index of each robot's first keyframe among the variables, by name.
        relative_poses: odometry of all robots, then loop closures.
        weights: [m], robust weight of each relative pose; 1 for odometry.
        T_start: [n, 4, 4], T_world_keyframe to start from.
    """

    first: dict[str, int]
    relative_poses: RelativePoses
    weights: Array
    T_start: Array

    @staticmethod
    def of_team(
        T_world_keyframe: Mapping[str, Array],
        odometry: Mapping[str, RelativePoses],
        loop_closures: Sequence[HeldLoopClosures],
        config: LoopClosureConfig,
    ) -> PoseGraph:
        """Put the whole team into one graph.

        Args:
            T_world_keyframe: start [n, 4, 4] of every robot, in one frame.
            odometry: every robot's own relative poses, as its agent uses them (`PoseAgent.odometry`).
            loop_closures: of every pair; they follow the odometry in this order.
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
        weights = [np.ones(len(part)) for part in parts]
        for held in loop_closures:
            i = [first[held.robot] + c.own_keyframe for c in held.loop_closures]
            j = [first[held.peer] + c.peer_keyframe for c in held.loop_closures]
            parts.append(closures_as_relative_poses(held.loop_closures, i, j, config))
            weights.append(np.array(held.weights, dtype=np.float64))
        start = np.concatenate([T_world_keyframe[robot] for robot in sorted(first)])
        return PoseGraph(first, RelativePoses.concatenate(parts), np.concatenate(weights), start)

    def of(self, robot: str, poses: Array) -> Array:
        """One robot's poses [k, 4, 4] out of the team's.

        Args:
            robot: its name.
            poses: [n, 4, 4], of all variables.
        """
        ends = sorted([*self.first.values(), len(self.T_start)])
        start = self.first[robot]
        return poses[start : ends[ends.index(start) + 1]]
