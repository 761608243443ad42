"""The motion that matched points of two views agree on: RANSAC, and a fit that knows how their errors lie.

A feature is found to a fraction of a pixel, and its depth is as noisy as the camera has it: at some meters the error of
a point lies along its ray, ten times longer than wide. Distances that count alike in all directions (Kabsch) let the
farthest points decide; weighted by their covariances the motion is up to three times nearer to the truth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.registration import RegistrationConfig
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.depth_noise import DepthNoise
from duagc.pipeline.geometry.statistics import huber_divisor, median
from duagc.pipeline.registration.normal_equations import regular

REFINEMENT_ROUNDS = 3  # of fitting to the inliers and finding them again
WEIGHTED_STEPS = 6  # of Gauss-Newton, each with new weights
HUBER_SIGMAS = 2.4  # of distances in three dimensions, two of three of which are below 1.9
DEPTH_NOISE = DepthNoise.stated(RegistrationConfig())  # of structured light; its scale is estimated
LEAST_ANGLE_RAD, LARGEST_ANGLE_RAD = 5e-4, 1e-2  # of a feature: a quarter of a pixel, and some pixels
LEAST_FACTOR, LARGEST_FACTOR = 0.1, 10.0  # on the noise of depth: exact depth, and poor stereo
INDEPENDENT_FEATURES = 10  # at most as many of the errors of matched points count as independent
MEDIAN_OF_SQUARES = 0.455  # of a standard normal number


def fit(points_a: Array, points_b: Array) -> Array:
    """T_a_b [..., 4, 4] that minimizes sum |a - T_a_b b|^2 over paired points (Kabsch, batched).

    Args:
        points_a: [..., n, 3].
        points_b: [..., n, 3].
    """
    mean_a, mean_b = points_a.mean(axis=-2, keepdims=True), points_b.mean(axis=-2, keepdims=True)
    R = so3.project(np.swapaxes(points_a - mean_a, -1, -2) @ (points_b - mean_b))
    return se3.from_rotation_translation(R, mean_a[..., 0, :] - (R @ mean_b[..., 0, :, None])[..., 0])


def ransac(
    points_a: Array,
    points_b: Array,
    *,
    inlier_m: float,
    hypotheses: int,
    rng: np.random.Generator,
    weighted: bool = True,
) -> tuple[Array, NDArray[np.bool_]]:
    """The motion that most matched points agree on.

    Args:
        points_a: [n, 3], n >= 3, camera frame a, meters.
        points_b: [n, 3], the same points in camera frame b.
        inlier_m: largest distance at one meter of depth; it grows with depth as the noise of a depth camera
            does.
        hypotheses: three-point samples drawn.
        rng: draws them.
        weighted: fit it to its inliers by `weighted_fit`; else only by `fit`, where just the inliers are wanted.

    Returns:
        T_a_b [4, 4] and the inliers [n].
    """
    n = len(points_a)
    # three different indices per row, without rejection: the second and third skip those before them
    i = rng.integers(0, n, hypotheses)
    j = rng.integers(0, n - 1, hypotheses)
    k = rng.integers(0, n - 2, hypotheses)
    j += j >= i
    low, high = np.minimum(i, j), np.maximum(i, j)
    k += k >= low
    k += k >= high
    triples = np.stack([i, j, k], axis=1)
    limit_m = inlier_m * np.maximum(1.0, np.maximum(points_a[:, 2], points_b[:, 2]))

    def agreeing(T: Array) -> NDArray[np.bool_]:
        return np.linalg.norm(points_a - se3.transform(T, points_b), axis=-1) < limit_m

    T = fit(points_a[triples], points_b[triples])
    counts = agreeing(T).sum(axis=1)
    best = T[int(np.argmax(counts))]
    inliers = agreeing(best)
    for _ in range(REFINEMENT_ROUNDS):
        if inliers.sum() < 3:
            return best, inliers
        best = fit(points_a[inliers], points_b[inliers])
        inliers = agreeing(best)
    if inliers.sum() < 3 or not weighted:
        return best, inliers
    best = weighted_fit(points_a[inliers], points_b[inliers], best)
    return best, agreeing(best)


def weighted_fit(points_a: Array, points_b: Array, T_a_b: Array) -> Array:
    """T_a_b [4, 4] with the least distances between paired points by the covariances of these distances.

    How well features are found, as an angle, and how noisy depth is, as a factor, are estimated from the distances.

    Args:
        points_a: [n, 3], n >= 3, camera frame a, meters.
        points_b: [n, 3], the same points in camera frame b.
        T_a_b: [4, 4], where to start.
    """
    T = T_a_b
    depth_a, depth_b = (_along(points) for points in (points_a, points_b))
    for _ in range(WEIGHTED_STEPS):
        pairs = _Pairs.at(T, points_a, points_b, depth_a=depth_a, depth_b=depth_b)
        W = np.linalg.inv(pairs.covariances())
        squared = np.einsum("ni,nij,nj->n", pairs.distances, W, pairs.distances)
        W /= huber_divisor(np.sqrt(squared), HUBER_SIGMAS)[:, None, None]
        R = T[:3, :3]
        J = np.concatenate([np.broadcast_to(R, (len(points_b), 3, 3)), -R @ so3.hat(points_b)], axis=-1)
        H = np.einsum("nia,nij,njb->ab", J, W, J)
        gradient = np.einsum("nia,nij,nj->a", J, W, pairs.distances)
        T = T @ se3.exp(np.linalg.solve(regular(H), gradient))
    return se3.from_rotation_translation(so3.project(T[:3, :3]), T[:3, 3])


def _along(points: Array) -> Array:
    """Standard deviations [n] of points along their rays by the noise of depth, before its factor."""
    depth_m = points[:, 2]
    return np.asarray(DEPTH_NOISE.sigma_m(depth_m) * np.linalg.norm(points, axis=1) / depth_m)


@dataclass(frozen=True)
class _Pairs:
    """Paired points at one motion, in frame a.

    Attributes:
        distances: [n, 3], of the points b from the points a.
        rays_a: [n, 3], unit vectors.
        rays_b: [n, 3], the same of camera b.
        squared_m2: [n], sums of the squared lengths of both rays.
        depth_a: [n], standard deviations along the rays of a by the noise of depth, before its factor.
        depth_b: the same of b.
    """

    distances: Array
    rays_a: Array
    rays_b: Array
    squared_m2: Array
    depth_a: Array
    depth_b: Array

    @staticmethod
    def at(T_a_b: Array, points_a: Array, points_b: Array, *, depth_a: Array, depth_b: Array) -> _Pairs:
        turned_b = points_b @ T_a_b[:3, :3].T
        squared_a, squared_b = (np.sum(p**2, axis=1) for p in (points_a, points_b))
        return _Pairs(
            points_a - (turned_b + T_a_b[:3, 3]),
            points_a / np.sqrt(squared_a)[:, None],
            turned_b / np.sqrt(squared_b)[:, None],
            squared_a + squared_b,
            depth_a,
            depth_b,
        )

    def covariances(self) -> Array:
        """Of the distances, [n, 3, 3]."""
        angle_rad = self._angle_rad()
        factor = self._factor(angle_rad)
        across = angle_rad**2 * self.squared_m2[:, None, None] * np.eye(3)
        along = sum(
            ((factor * depth) ** 2)[:, None, None] * rays[:, :, None] * rays[:, None, :]
            for depth, rays in ((self.depth_a, self.rays_a), (self.depth_b, self.rays_b))
        )
        return np.asarray(across + along)

    def _angle_rad(self) -> float:
        """How well features are found: by the distances across both rays, which depth does not move."""
        across = np.cross(self.rays_a, self.rays_b)
        parallel = np.linalg.norm(across, axis=1) < 1e-3
        across[parallel] = np.cross(self.rays_a[parallel], (0.0, 1.0, 0.0))
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        squares = np.sum(self.distances * across, axis=1) ** 2 / self.squared_m2
        angle_rad = np.sqrt(median(squares) / MEDIAN_OF_SQUARES)
        return float(np.clip(angle_rad, LEAST_ANGLE_RAD, LARGEST_ANGLE_RAD))

    def _factor(self, angle_rad: float) -> float:
        """Scale of the noise of depth: by the distances along the rays of a."""
        along = np.sum(self.distances * self.rays_a, axis=1)
        cosine = np.sum(self.rays_a * self.rays_b, axis=1)
        expected = self.depth_a**2 + (self.depth_b * cosine) ** 2
        square = median((along**2 - angle_rad**2 * self.squared_m2) / expected) / MEDIAN_OF_SQUARES
        return float(np.sqrt(np.clip(square, LEAST_FACTOR**2, LARGEST_FACTOR**2)))


def information_of_fit(points_a: Array, points_b: Array, T_a_b: Array) -> Array:
    """Information [6, 6] of a motion fitted to points: of their distances, and few of them are independent.

    Neighboring features share errors of depth, of calibration and of the shutter.

    Args:
        points_a: [n, 3], camera frame a, meters.
        points_b: [n, 3], the same points in camera frame b.
        T_a_b: [4, 4], fitted to them.
    """
    distance = np.linalg.norm(points_a - se3.transform(T_a_b, points_b), axis=-1)
    variance = max(float(np.mean(distance**2)) / 3, 1e-6)
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(distance), 3, 3)), -so3.hat(points_b)], axis=-1)
    H = np.einsum("nka,nkb->ab", J, J) / variance
    return np.asarray(H * min(1.0, INDEPENDENT_FEATURES / len(distance)))
