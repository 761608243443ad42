"""Loop closures of a robot's path that contradict the path and each other are left out.

Geometric verification lets through a place that only looks like another one. Such a loop closure bends the path, and
the joint optimization of the images then starts from a wrong place. Around a cycle of registrations and loop closures
the motions must compose to the identity, as far as drift lets them. Graduated non-convexity with truncated least
squares finds the loop closures that do (Yang, Antonante, Tzoumas and Carlone 2020). What tracking followed from frame
to frame is kept.

Many loop closures between floors that are built alike agree with each other, and outweigh the path. They bend it all
along its way by more than it is uncertain, where true ones move a place at which tracking was wrong. So a set of loop
closures counts only while most registrations of the path between their ends still fit.
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
from duagc.pipeline.geometry.statistics import CHI2_6_MEDIAN
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
        T_map_keyframes: [k, 4, 4], by the registrations of tracking; where the solution starts.
        tracked: registrations that connect the keyframes.
        loops: verified loop closures.
        config: how much drift is usual.
    """
    if not (config.robust and loops):
        return list(loops)
    path = _relaxed(tracked, config.odometry_floor_m, config.odometry_floor_rad)
    left = list(zip(loops, _relaxed(loops, config.closure_floor_m, config.closure_floor_rad), strict=True))
    while left:
        weights = _weights(T_map_keyframes, path, [closure for _, closure in left])
        kept = [k for k, weight in enumerate(weights) if weight >= INLIER_WEIGHT]
        bending = _bending(T_map_keyframes, path, [left[k][1] for k in kept])
        if not bending:
            return [left[k][0] for k in kept]
        dropped = {kept[k] for k in bending}
        left = [pair for k, pair in enumerate(left) if k not in dropped]
    return []


def _weights(T_map_keyframes: Array, path: Sequence[RelativePose], closures: Sequence[RelativePose]) -> Array:
    """Weights [m] of loop closures by graduated non-convexity: 1 of those that agree with path and each other."""
    weights = np.ones(len(closures))
    squared = _squared(T_map_keyframes, path, closures, weights)
    if np.all(squared <= CHI2_6_999):
        return weights
    control = CHI2_6_999 / (2 * float(squared.max()) - CHI2_6_999)
    while control <= LAST_CONTROL:
        weights = graduated_weights(squared, CHI2_6_999, control)
        squared = _squared(T_map_keyframes, path, closures, weights)
        if np.all((weights == 0) | (weights == 1)):
            break
        control *= GROWTH
    return weights


def _bending(
    T_map_keyframes: Array, path: Sequence[RelativePose], closures: Sequence[RelativePose]
) -> list[int]:
    """Indices of the fewest loop closures, those farthest from the path, without which the path is not bent."""
    alone = _path_errors(T_map_keyframes, path, [])
    if not _bends(_path_errors(T_map_keyframes, path, closures) - alone, path, closures):
        return []
    off = _errors(closures, T_map_keyframes) / [abs(closure.j - closure.i) for closure in closures]
    order = np.argsort(off, kind="stable").tolist()
    most, least = len(order), 0  # so many of the nearest bend the path, and so few do not
    while most - least > 1:
        middle = (most + least) // 2
        nearest = [closures[k] for k in order[:middle]]
        if _bends(_path_errors(T_map_keyframes, path, nearest) - alone, path, nearest):
            most = middle
        else:
            least = middle
    return order[least:]


def _bends(added: Array, path: Sequence[RelativePose], closures: Sequence[RelativePose]) -> bool:
    """Whether between the ends of a loop closure most squared residuals of the path grew beyond what is usual.

    Args:
        added: by the loop closures to the residuals of the path, [m].
        path: its m registrations.
        closures: the loop closures.
    """
    ends = np.sort([(pair.i, pair.j) for pair in path], axis=1)
    spans = {(min(closure.i, closure.j), max(closure.i, closure.j)) for closure in closures}
    between = [added[(ends[:, 0] >= first) & (ends[:, 1] <= last)] for first, last in spans]
    return any(part.size and float(np.median(part)) > CHI2_6_MEDIAN for part in between)


def _path_errors(
    T_map_keyframes: Array, path: Sequence[RelativePose], closures: Sequence[RelativePose]
) -> Array:
    """Squared residuals [m] of the path, in their sigmas, at the poses that fit it and loop closures."""
    return _errors(path, solve_pose_graph(T_map_keyframes, [*path, *closures], LINEAR_FROM).T_map_keyframe)


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
    return _errors(closures, T)


def _errors(pairs: Sequence[RelativePose], T_map_keyframes: Array) -> Array:
    """Squared residuals [m] of relative poses, in their sigmas, at poses [k, 4, 4]."""
    errors = [
        se3.log(se3.inverse(p.T_i_j) @ se3.inverse(T_map_keyframes[p.i]) @ T_map_keyframes[p.j])
        for p in pairs
    ]
    return np.array([e @ p.information @ e for e, p in zip(errors, pairs, strict=True)])
