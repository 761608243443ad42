"""Where a robot starts: its own graph solved alone, in its own frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.gnc import controls, graduated_weights
from duagc.pipeline.posegraph.pose_graph import solve_pose_graph
from duagc.pipeline.posegraph.relative_poses import RelativePoses

_STEPS = 3  # Gauss-Newton steps per step of the graduated weights


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
    Y[3:] = sparse_linalg.splu((M[:, 3:].T @ M[:, 3:]).tocsc()).solve(-(M[:, 3:].T @ M[:, :3]).toarray())
    rotations = so3.project(Y.reshape(n, 3, 3).swapaxes(-1, -2))
    e, root = np.arange(m), np.sqrt(factors.information[:, 0, 0])
    index = (np.concatenate([e, e]), np.concatenate([factors.j, factors.i]))
    B = sparse.csc_matrix((np.concatenate([root, -root]), index), shape=(m, n))[:, 1:]
    right = root[:, None] * (rotations[factors.i] @ factors.T_i_j[:, :3, 3:])[..., 0]
    t = np.concatenate([np.zeros((1, 3)), sparse_linalg.splu((B.T @ B).tocsc()).solve(B.T @ right)])
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
    c2, trusted = config.truncation**2, np.ones(len(odometry))
    for mu in controls(config):
        squared = least_squares.squared_residuals(loops, T)
        weights = graduated_weights(squared, c2, mu)
        T = solve_pose_graph(both, T, np.concatenate([trusted, weights]), iterations=_STEPS).poses
    kept = least_squares.squared_residuals(loops, T) <= c2
    return solve_pose_graph(both, T, np.concatenate([trusted, kept])).poses, kept
