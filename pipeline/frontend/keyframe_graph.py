"""Keyframes: which frames become one, and the solution of their pose graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import KeyframeConfig
from duagc.pipeline.geometry import projection, se3
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.registration import Level, Reference, ReferenceLevel, Registration, RgbdPyramid

MAX_STEPS = 20
STEP_TOLERANCE = 1e-9
OPEN_DIRECTION = 1e-4  # 1/m^2, 1/rad^2: a standard deviation of 100 m is no knowledge


@dataclass(frozen=True)
class OptimizedKeyframes:
    """Solution of the keyframes' pose graph.

    Attributes:
        T_map_keyframe: [k, 4, 4].
        normal_matrix: sparse [6k, 6k] of their right tangents, identity for the first, which is fixed.
        weights: [m], robust weight of every pair, 0..1.
        variance_factor: >= 1, by which the residuals exceed what the information of the pairs predicts; a factor on
            the covariance.
    """

    T_map_keyframe: Array
    normal_matrix: Any
    weights: Array
    variance_factor: float

    @cached_property
    def _factors(self) -> Any:
        """Factorization of the normal matrix."""
        from scipy.sparse.linalg import splu

        return splu(self.normal_matrix)

    def covariance(self, keyframes: Sequence[int]) -> Array:
        """Joint covariance [6n, 6n] of n keyframes' right tangents; zero for the first keyframe.

        Args:
            keyframes: their indices.
        """
        rows = np.concatenate([np.arange(6 * k, 6 * k + 6) for k in keyframes])
        columns = np.zeros((self.normal_matrix.shape[0], len(rows)))
        columns[rows, np.arange(len(rows))] = rows >= 6
        covariance = self._factors.solve(columns)[rows] * self.variance_factor
        covariance[rows < 6] = 0.0
        return 0.5 * (covariance + covariance.T)

    def relative_information(self, first: int, second: int) -> Array:
        """Information [6, 6] of T_first_second (right tangent).

        Args:
            first: index of the keyframe that it is seen from.
            second: index of the keyframe that is seen.
        """
        T = self.T_map_keyframe
        C = self.covariance([first, second])
        J = np.hstack([-se3.adjoint(se3.inverse(se3.inverse(T[first]) @ T[second])), np.eye(6)])
        information = np.linalg.inv(J @ C @ J.T)
        return 0.5 * (information + information.T)


def becomes_keyframe(result: Registration, pyramid: RgbdPyramid, config: KeyframeConfig) -> bool:
    """Whether a tracked frame shares too little with its keyframe, or moved or turned too far from it.

    Motion is measured by the median depth: a step of 10 cm changes a near view more than a far one.

    Args:
        result: registration of the frame to its keyframe.
        pyramid: of the frame.
        config: the limits.
    """
    return leaves_keyframe(shared_view(result, pyramid), result.T_reference_target, pyramid, config)


def shared_view(result: Registration, pyramid: RgbdPyramid) -> float:
    """The smaller share that a frame and its keyframe see of each other, 0..1.

    A camera that goes back sees all of its keyframe, and more and more around it.

    Args:
        result: registration of the frame to its keyframe.
        pyramid: of the frame; its camera is that of the keyframe.
    """
    camera, points = pyramid.levels[-1].camera, pyramid.levels[-1].points
    seen = se3.transform(result.T_reference_target, points)
    seen = seen[seen[:, 2] > 0]
    u, v = camera.project(seen).T
    inside = (u > -0.5) & (v > -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
    return min(result.overlap, result.view, np.count_nonzero(inside) / max(len(points), 1))


def leaves_keyframe(
    overlap: float, T_keyframe_camera: Array, pyramid: RgbdPyramid, config: KeyframeConfig
) -> bool:
    """Whether a view shares too little with its keyframe, or moved or turned too far from it.

    Args:
        overlap: share of the keyframe that it sees.
        T_keyframe_camera: [4, 4].
        pyramid: of the view.
        config: the limits.
    """
    if overlap < config.min_overlap:
        return True
    moved_m, turned_rad = se3.distance(np.eye(4), T_keyframe_camera)
    most_m = config.max_translation_of_depth * pyramid.levels[-1].median_depth_m
    return bool(moved_m > most_m or turned_rad > config.max_rotation_rad)


def predicted_overlap(reference: Reference, pyramid: RgbdPyramid, T_reference_target: Array) -> float:
    """Fraction of a reference's coarsest samples that a view would see on the same surface (within 10 % of depth).

    Args:
        reference: the samples.
        pyramid: of the view.
        T_reference_target: [4, 4], of the view.
    """
    return overlap(reference.levels[-1], pyramid.levels[len(reference.levels) - 1], T_reference_target)


def overlap(samples: ReferenceLevel, level: Level, T_reference_target: Array) -> float:
    """Fraction of samples that a view would see on the same surface (within 10 % of depth), and from the same side.

    Args:
        samples: of one level of a reference.
        level: of the view.
        T_reference_target: [4, 4], of the view.
    """
    T_target_reference = se3.inverse(T_reference_target)
    points = se3.transform(T_target_reference, samples.points.astype(np.float64))
    normals = samples.normals.astype(np.float64) @ T_target_reference[:3, :3].T
    return projection.overlap(points, level.camera, inverse_depth=level.inverse_depth, normals=normals)


def solve_pose_graph(
    T_map_keyframes: Array, pairs: Sequence[RelativePose], huber_sigmas: float
) -> OptimizedKeyframes:
    """Solve a pose graph: keyframe poses that agree best with all registrations; the first keyframe is fixed.

    Gauss-Newton on sum |log(T_first_second^-1 T_map_first^-1 T_map_second)|^2 weighted by the information, with
    Huber weights, in the right tangents of the poses. The normal matrix is sparse: its work grows with the pairs.

    Args:
        T_map_keyframes: [k, 4, 4], start.
        pairs: registrations; every keyframe is connected to the first through them.
        huber_sigmas: residuals beyond this count linearly.
    """
    from scipy.sparse.linalg import splu

    T = np.array(T_map_keyframes, dtype=np.float64)
    k = len(T)
    H, gradient, squares, weights = _normal_equations(T, pairs, huber_sigmas)
    if k < 2:
        return OptimizedKeyframes(T, H, np.zeros(0), 1.0)
    for _ in range(MAX_STEPS):
        step = -splu(H).solve(gradient).reshape(k, 6)
        T = T @ se3.exp(step)
        H, gradient, squares, weights = _normal_equations(T, pairs, huber_sigmas)
        if np.max(np.abs(step)) < STEP_TOLERANCE:
            break
    redundant = 6 * (len(pairs) - (k - 1))
    variance_factor = max(1.0, float(squares.sum()) / redundant) if redundant > 0 else 1.0
    return OptimizedKeyframes(T, H, weights, variance_factor)


def _normal_equations(
    T: Array, pairs: Sequence[RelativePose], huber_sigmas: float
) -> tuple[Any, Array, Array, Array]:
    """Sparse H [6k, 6k] and gradient [6k] with the first pose held, every pair's weighted square, and its weight."""
    from scipy.sparse import csc_array

    k = len(T)
    first = np.array([pair.i for pair in pairs], dtype=np.int64)
    second = np.array([pair.j for pair in pairs], dtype=np.int64)
    measured = np.array([pair.T_i_j for pair in pairs]).reshape(-1, 4, 4)
    information = np.array([pair.information for pair in pairs]).reshape(-1, 6, 6)
    T_first_second = se3.inverse(T[first]) @ T[second]
    residual = se3.log(se3.inverse(measured) @ T_first_second)
    # log(E exp(d)) = log E + d for a small error E; moving the first pose by d moves the second by -Ad d
    J_first = -se3.adjoint(se3.inverse(T_first_second))
    squares = np.einsum("ma,mab,mb->m", residual, information, residual)
    limit = huber_sigmas * np.sqrt(6)
    weights = np.minimum(1.0, limit / np.sqrt(np.maximum(squares, limit**2 * 1e-12)))
    W = weights[:, None, None] * information
    J_W = np.swapaxes(J_first, 1, 2) @ W
    forces = (W @ residual[..., None])[..., 0]
    gradient = np.zeros((k, 6))
    np.add.at(gradient, first, (J_W @ residual[..., None])[..., 0])
    np.add.at(gradient, second, forces)
    gradient[0] = 0.0
    # a trace of a prior on every pose keeps H regular where registrations leave a direction open
    prior = np.repeat(OPEN_DIRECTION * np.eye(6)[None], k, axis=0)
    prior[0] = np.eye(6)
    rows = np.concatenate([np.arange(k), first, first, second, second])
    columns = np.concatenate([np.arange(k), first, second, first, second])
    blocks = np.concatenate([prior, J_W @ J_first, J_W, np.swapaxes(J_W, 1, 2), W])
    held = ((rows == 0) | (columns == 0)) & (np.arange(len(rows)) >= k)
    rows, columns, blocks = rows[~held], columns[~held], blocks[~held]
    inner_row, inner_column = (axis.ravel() for axis in np.mgrid[:6, :6])
    H = csc_array(
        (
            blocks.reshape(-1),
            (
                (6 * rows[:, None] + inner_row).reshape(-1),
                (6 * columns[:, None] + inner_column).reshape(-1),
            ),
        ),
        shape=(6 * k, 6 * k),
    )
    return H, gradient.reshape(-1), weights * squares, weights
