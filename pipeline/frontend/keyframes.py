"""Keyframes: which frames become one, and the refinement of their poses by all registrations between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.frontend.config import KeyframeConfig
from pipeline.geometry import se3
from pipeline.registration import Reference, Registration, RgbdPyramid

Array = NDArray[np.float64]
MAX_STEPS = 20
STEP_TOLERANCE = 1e-9


@dataclass(frozen=True)
class KeyframePair:
    """A registration between two keyframes: T_first_second [4, 4] and its information [6, 6], right tangent."""

    first: int
    second: int
    T_first_second: Array
    information: Array


@dataclass(frozen=True)
class Refined:
    """Keyframe poses after the refinement.

    T_map_keyframe: [k, 4, 4]. covariance: [6k, 6k] of their right tangents, zero for the first. weights: [m], robust
    weight of every pair, 0..1. contradiction: factor >= 1 on the covariance, by which the pairs contradict each
    other more than their information says.
    """

    T_map_keyframe: Array
    covariance: Array
    weights: Array
    contradiction: float


def becomes_keyframe(result: Registration, pyramid: RgbdPyramid, config: KeyframeConfig) -> bool:
    """Whether a tracked frame sees too little of its keyframe, or moved or turned too far from it.

    Motion is measured by the median depth: a step of 10 cm changes a near view more than a far one.
    """
    if min(result.overlap, result.view) < config.min_overlap:
        return True
    coarsest = pyramid.levels[-1].inverse_depth
    known = coarsest[coarsest > 0]
    median_depth_m = 1 / float(np.median(known)) if len(known) else np.inf
    moved_m, turned_rad = se3.distance(np.eye(4), result.T_reference_target)
    return bool(
        moved_m > config.max_translation_of_depth * median_depth_m or turned_rad > config.max_rotation_rad
    )


def predicted_overlap(reference: Reference, pyramid: RgbdPyramid, T_reference_target: Array) -> float:
    """Fraction of a reference's coarsest samples that a view would see on the same surface (within 10 % of depth)."""
    samples, level = reference.levels[-1], pyramid.levels[len(reference.levels) - 1]
    if len(samples) == 0:
        return 0.0
    points = se3.transform(se3.inverse(T_reference_target), samples.points.astype(np.float64))
    points = points[points[:, 2] > 0.05]
    u, v = np.rint(level.camera.project(points)).astype(np.int64).T
    inside = (u >= 0) & (u < level.camera.width) & (v >= 0) & (v < level.camera.height)
    inverse_depth = level.inverse_depth[v[inside], u[inside]]
    same = (inverse_depth > 0) & (np.abs(points[inside, 2] * inverse_depth - 1) < 0.1)
    return float(np.count_nonzero(same)) / len(samples)


def refine(T_map_keyframes: Array, pairs: Sequence[KeyframePair], huber_sigmas: float) -> Refined:
    """Keyframe poses that agree best with all registrations between them; the first keyframe stays.

    Gauss-Newton on sum |log(T_first_second^-1 T_map_first^-1 T_map_second)|^2 weighted by the information, with
    Huber weights, in the right tangents of the poses.

    Args:
        T_map_keyframes: [k, 4, 4], start.
        pairs: registrations; every keyframe is connected to the first through them.
    """
    T = np.array(T_map_keyframes, dtype=np.float64)
    k = len(T)
    if k < 2:
        return Refined(T, np.zeros((6 * k, 6 * k)), np.zeros(0), 1.0)
    H, squares, weights = np.eye(6 * k), np.zeros(0), np.zeros(0)
    for _ in range(MAX_STEPS):
        H, gradient, squares, weights = _normal_equations(T, pairs, huber_sigmas)
        step = -np.linalg.solve(H, gradient).reshape(k, 6)
        T = T @ se3.exp(step)
        if np.max(np.abs(step)) < STEP_TOLERANCE:
            break
    redundant = 6 * (len(pairs) - (k - 1))
    contradiction = max(1.0, float(squares.sum()) / redundant) if redundant > 0 else 1.0
    covariance = np.zeros((6 * k, 6 * k))
    covariance[6:, 6:] = np.linalg.inv(H[6:, 6:]) * contradiction
    return Refined(T, covariance, weights, contradiction)


def _normal_equations(
    T: Array, pairs: Sequence[KeyframePair], huber_sigmas: float
) -> tuple[Array, Array, Array, Array]:
    """H [6k, 6k] and gradient [6k] with the first pose held, every pair's weighted square, and its weight."""
    k = len(T)
    H, gradient = np.zeros((6 * k, 6 * k)), np.zeros(6 * k)
    squares, weights = np.zeros(len(pairs)), np.zeros(len(pairs))
    for row, pair in enumerate(pairs):
        i, j = slice(6 * pair.first, 6 * pair.first + 6), slice(6 * pair.second, 6 * pair.second + 6)
        T_first_second = se3.inverse(T[pair.first]) @ T[pair.second]
        residual = se3.log(se3.inverse(pair.T_first_second) @ T_first_second)
        # log(E exp(d)) = log E + d for a small error E; moving the first pose by d moves the second by -Ad d
        J_first, information = -se3.adjoint(se3.inverse(T_first_second)), pair.information
        square = float(residual @ information @ residual)
        weight = min(1.0, huber_sigmas * np.sqrt(6) / np.sqrt(square)) if square > 0 else 1.0
        squares[row], weights[row] = weight * square, weight
        W = weight * information
        H[i, i] += J_first.T @ W @ J_first
        H[i, j] += J_first.T @ W
        H[j, i] += W @ J_first
        H[j, j] += W
        gradient[i] += J_first.T @ W @ residual
        gradient[j] += W @ residual
    H[:6], H[:, :6], gradient[:6] = 0.0, 0.0, 0.0
    H[:6, :6] = np.eye(6)
    return H, gradient, squares, weights


def relative_information(T: Array, covariance: Array, first: int, second: int) -> Array:
    """Information [6, 6] of T_first_second (right tangent) from the joint covariance of `refine`."""
    i, j = slice(6 * first, 6 * first + 6), slice(6 * second, 6 * second + 6)
    J_first = -se3.adjoint(se3.inverse(se3.inverse(T[first]) @ T[second]))
    C = covariance
    relative = J_first @ C[i, i] @ J_first.T + J_first @ C[i, j] + C[j, i] @ J_first.T + C[j, j]
    information = np.linalg.inv(relative)
    return 0.5 * (information + information.T)
