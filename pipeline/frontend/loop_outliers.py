"""Loop closures of a robot's path that contradict the path and each other are left out.

Geometric verification lets through a place that only looks like another one. Such a loop closure bends the path, and
the joint optimization of the images then starts from a wrong place. Around a cycle of registrations and loop closures
the motions must compose to the identity, as far as drift lets them. Graduated non-convexity with truncated least
squares finds the loop closures that do (Yang, Antonante, Tzoumas and Carlone 2020). What tracking followed from frame
to frame is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import LoopConfig
from duagc.pipeline.frontend.keyframe_graph import solve_pose_graph
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.spd import add_covariance
from duagc.pipeline.posegraph.gnc import INLIER_WEIGHT, graduated_weights
from duagc.pipeline.posegraph.relative_poses import RelativePose

CHI2_6_999 = 22.46  # 99.9 % quantile of chi^2 with 6 degrees of freedom
GROWTH = 1.4  # of the control parameter per step
LAST_CONTROL = 300.0
LINEAR_FROM = 1e9  # sigmas: no Huber weights besides


def consistent_loops(
    T_map_keyframes: Array, tracked: Sequence[RelativePose], loops: Sequence[RelativePose], config: LoopConfig
) -> list[RelativePose]:
    """The loop closures that agree with the path and with each other.

    Args:
        T_map_keyframes: [k, 4, 4], as tracked.
        tracked: registrations that connect the keyframes.
        loops: verified loop closures.
        config: how much drift is usual.
    """
    if not (config.robust and loops):
        return list(loops)
    path = _relaxed(tracked, config.odometry_floor_m, config.odometry_floor_rad)
    closures = _relaxed(loops, config.closure_floor_m, config.closure_floor_rad)
    weights = np.ones(len(loops))
    squared = _squared(T_map_keyframes, path, closures, weights)
    if np.all(squared <= CHI2_6_999):
        return list(loops)
    control = CHI2_6_999 / (2 * float(squared.max()) - CHI2_6_999)
    while control <= LAST_CONTROL:
        weights = graduated_weights(squared, CHI2_6_999, control)
        squared = _squared(T_map_keyframes, path, closures, weights)
        if np.all((weights == 0) | (weights == 1)):
            break
        control *= GROWTH
    return [loop for loop, weight in zip(loops, weights, strict=True) if weight >= INLIER_WEIGHT]


def _relaxed(pairs: Sequence[RelativePose], floor_m: float, floor_rad: float) -> list[RelativePose]:
    """The same with the covariance of what their information does not contain added."""
    floor = np.diag([floor_m**2] * 3 + [floor_rad**2] * 3)
    return [replace(pair, information=add_covariance(pair.information, floor)) for pair in pairs]


def _squared(
    T_map_keyframes: Array, path: Sequence[RelativePose], closures: Sequence[RelativePose], weights: Array
) -> Array:
    """Squared residuals [m] of the loop closures, in their sigmas, at the poses that fit all as they are weighted."""
    weighted = [replace(c, information=w * c.information) for c, w in zip(closures, weights, strict=True)]
    T = solve_pose_graph(T_map_keyframes, [*path, *weighted], LINEAR_FROM).T_map_keyframe
    errors = [se3.log(se3.inverse(c.T_i_j) @ se3.inverse(T[c.i]) @ T[c.j]) for c in closures]
    return np.array([e @ c.information @ e for e, c in zip(errors, closures, strict=True)])
