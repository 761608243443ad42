"""Motions from matched points: false matches do not count, and errors along the rays count less than those across."""

import numpy as np
import pytest

from duagc.pipeline.base import random_streams
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration.matched_points import DEPTH_NOISE, fit, ransac, weighted_fit

T_A_B = se3.exp(np.array([0.8, -0.1, 0.3, 0.05, -0.4, 0.1]))
"""Wide enough apart that the rays of the two views differ by 20 degrees."""


def seen_twice(rng: np.random.Generator, factor: float, angle_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """60 points at 1 to 6 m as both cameras measure them, [60, 3] each.

    Args:
        rng: draws them.
        factor: on the noise of depth.
        angle_rad: standard deviation of the directions.
    """
    points_b = rng.uniform([-0.8, -0.6, 1], [0.8, 0.6, 1], (60, 3)) * rng.uniform(1, 6, (60, 1))
    return tuple(
        measured(points, rng, factor, angle_rad) for points in (se3.transform(T_A_B, points_b), points_b)
    )


def measured(points: np.ndarray, rng: np.random.Generator, factor: float, angle_rad: float) -> np.ndarray:
    ray = points / points[:, 2:]
    ray[:, :2] += angle_rad * rng.standard_normal((len(points), 2))
    depth_m = points[:, 2]
    return ray * (depth_m + factor * DEPTH_NOISE.sigma_m(depth_m) * rng.standard_normal(len(points)))[:, None]


@pytest.mark.parametrize("weighted", [True, False])
def test_ransac_finds_the_motion_among_false_matches(weighted: bool) -> None:
    rng = np.random.default_rng(2)
    T = se3.exp([0.3, -0.2, 0.4, 0.5, -0.1, 0.2])
    points_b = rng.uniform([-1, -1, 1], [1, 1, 3], (60, 3))
    points_a = se3.transform(T, points_b) + rng.normal(0, 0.003, (60, 3))
    points_a[:35] = rng.uniform([-1, -1, 1], [1, 1, 3], (35, 3))
    found, inliers = ransac(
        points_a,
        points_b,
        inlier_m=0.03,
        hypotheses=500,
        rng=random_streams.generator(0, "test"),
        weighted=weighted,
    )
    if not weighted:
        np.testing.assert_array_equal(found, fit(points_a[inliers], points_b[inliers]))
    assert inliers[35:].all()
    assert inliers[:35].sum() <= 2
    assert max(float(d) for d in se3.distance(found, T)) < 0.01


def test_exact_points_give_the_exact_motion() -> None:
    points_a, points_b = seen_twice(np.random.default_rng(0), 0.0, 0.0)
    for T in (fit(points_a, points_b), weighted_fit(points_a, points_b, fit(points_a, points_b))):
        np.testing.assert_allclose(T, T_A_B, atol=1e-12)


@pytest.mark.parametrize(("factor", "angle_rad"), [(1.0, 1e-3), (4.0, 2e-3), (0.3, 5e-4)])
def test_errors_along_the_rays_count_less(factor: float, angle_rad: float) -> None:
    """Twice as near to the truth as with distances that count alike, whatever the camera: its noise is estimated."""
    rng, alike, weighted = np.random.default_rng(1), [], []
    for _ in range(40):
        points_a, points_b = seen_twice(rng, factor, angle_rad)
        T = fit(points_a, points_b)
        alike.append(se3.distance(T, T_A_B)[0])
        weighted.append(se3.distance(weighted_fit(points_a, points_b, T), T_A_B)[0])
    assert np.median(weighted) < 0.5 * np.median(alike)


def test_a_few_false_matches_move_it_little() -> None:
    rng = np.random.default_rng(3)
    points_a, points_b = seen_twice(rng, 1.0, 1e-3)
    T = weighted_fit(points_a, points_b, fit(points_a, points_b))
    points_a[:4] += rng.normal(0, 0.15, (4, 3))
    moved_m, _ = se3.distance(weighted_fit(points_a, points_b, fit(points_a, points_b)), T)
    assert moved_m < 0.01
    assert moved_m < 0.5 * se3.distance(fit(points_a, points_b), T)[0]
