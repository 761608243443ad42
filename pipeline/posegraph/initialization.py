"""Where a robot starts: its own graph solved alone, in its own frame."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.gnc import controls, convex_control, graduated_weights
from duagc.pipeline.posegraph.pose_graph import solve_pose_graph
from duagc.pipeline.posegraph.relative_poses import RelativePoses

_HELD = 1e6  # of the stiffest factor: only fixes the gauge


def chordal(factors: RelativePoses, n: int) -> Array:
    """Chordal start [n, 4, 4]: linear rotations, then linear translations; variable 0 at the identity.

    Args:
        factors: isotropic relative poses (`isotropic_information`); the graph must be connected.
        n: number of variables.
    Source: Martinec and Pajdla 2007; Carlone et al., "Initialization techniques for 3D SLAM", 2015.
    """
    m, R = len(factors), factors.T_i_j[:, :3, :3]
    root = np.sqrt(factors.information[:, 3, 3] / 2)
    rows, columns, values = [], [], []
    for a in range(3):
        e = 3 * np.arange(m) + a
        rows += [e] * 4
        columns += [3 * factors.j + a, *(3 * factors.i + b for b in range(3))]
        values += [root, *(-root * R[:, b, a] for b in range(3))]
    index = (np.concatenate(rows), np.concatenate(columns))
    M = sparse.csc_matrix((np.concatenate(values), index), shape=(3 * m, 3 * n))
    Y = np.concatenate([np.eye(3), np.zeros((3 * n - 3, 3))])
    Y[3:] = least_squares.decomposed((M[:, 3:].T @ M[:, 3:]).tocsc()).solve(
        -(M[:, 3:].T @ M[:, :3]).toarray()
    )
    rotations = so3.project(Y.reshape(n, 3, 3).swapaxes(-1, -2))
    e, root = np.arange(m), np.sqrt(factors.information[:, 0, 0])
    index = (np.concatenate([e, e]), np.concatenate([factors.j, factors.i]))
    B = sparse.csc_matrix((np.concatenate([root, -root]), index), shape=(m, n))[:, 1:]
    right = root[:, None] * (rotations[factors.i] @ factors.T_i_j[:, :3, 3:])[..., 0]
    t = np.concatenate([np.zeros((1, 3)), least_squares.decomposed((B.T @ B).tocsc()).solve(B.T @ right)])
    return se3.from_rotation_translation(rotations, t)


def own_start(
    odometry: RelativePoses, loops: RelativePoses, n: int, config: PoseConsensusConfig
) -> tuple[Array, NDArray[np.bool_]]:
    """A robot's own optimum before it has met any other robot.

    Args:
        odometry: connects all n keyframes and is trusted.
        loops: the other relative poses between own keyframes.
        n: number of keyframes.
        config: with `robust`, loops may be false.
    Returns:
        T_map_keyframe [n, 4, 4], keyframe 0 at the identity; which loops fit (all of them if none may be false).
    """
    kept = np.ones(len(loops), dtype=bool)
    if n == 1:
        return np.eye(4)[None], kept
    both = RelativePoses.concatenate([odometry, loops])
    if not (config.robust and len(loops)):
        return solve_pose_graph(both, chordal(both, n)).poses, kept
    T = solve_pose_graph(odometry, chordal(odometry, n)).poses
    T = graduated(odometry, loops, T, config)
    kept = least_squares.squared_residuals(loops, T) <= config.truncation**2
    return solve_pose_graph(RelativePoses.concatenate([odometry, loops.select(kept)]), T).poses, kept


def graduated(trusted: RelativePoses, loops: RelativePoses, T: Array, config: PoseConsensusConfig) -> Array:
    """Poses that as many relative poses as possible agree on, by graduated non-convexity.

    One Gauss-Newton step per step of the schedule: the weights change slowly, and poses follow them. It ends when all
    weights are zero or one, or with the schedule.

    Args:
        trusted: relative poses of weight one.
        loops: relative poses that may be false.
        T: [n, 4, 4], to start from; pose 0 is held.
        config: threshold and schedule.
    """
    c2 = config.truncation**2
    for mu in _schedule(least_squares.squared_residuals(loops, T), config):
        weights = graduated_weights(least_squares.squared_residuals(loops, T), c2, mu)
        if np.all((weights == 0.0) | (weights == 1.0)):
            break
        counts = weights > 0.0  # the others would only fill the factorization
        graph = RelativePoses.concatenate([trusted, loops.select(counts)])
        T = gauss_newton(graph, T, np.concatenate([np.ones(len(trusted)), weights[counts]]))
    return T


def _schedule(squared: Array, config: PoseConsensusConfig) -> list[float]:
    """Control parameters; from where the worst loop is just convex if all are too far off for the usual beginning.

    A long walk may drift by thousands of standard deviations of its loops. Were all of them without weight, nothing
    would bring the poses nearer.

    Args:
        squared: [m], squared residuals at the start.
        config: threshold and schedule.
    """
    usual = controls(config)
    if graduated_weights(squared, config.truncation**2, usual[0]).any():
        return usual
    earlier = math.ceil(math.log(usual[0] / convex_control(squared, config)) / math.log(config.robust_growth))
    return [usual[0] * config.robust_growth**-k for k in range(earlier, 0, -1)] + usual


def gauss_newton(graph: RelativePoses, T: Array, weights: Array) -> Array:
    """Poses [n, 4, 4] after one Gauss-Newton step; pose 0 is held.

    Args:
        graph: m relative poses.
        T: [n, 4, 4], to start from.
        weights: [m].
    """
    g, jacobians = least_squares.gradient(graph, weights, T)
    scale = max(float((J**2).sum(axis=1).max(initial=0.0)) for J in jacobians)
    diagonal = np.full_like(g, 1e-12 * scale)
    diagonal[0] = _HELD * scale
    step = least_squares.factorized(least_squares.curvature_matrix(graph, jacobians, diagonal))(g.ravel())
    return least_squares.retract(T, -step.reshape(-1, 6))
