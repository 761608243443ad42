"""Matching of Gaussians: mutual, symmetric under renaming, blind to what carries no meaning."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.config.consensus import ColorConfig
from duagc.pipeline.consensus import matching
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.matching import MapMatching, gaussian_distance, match, threshold
from duagc.pipeline.geometry import so3, spd
from duagc.pipeline.splat.information import COLOR, LOG_COVARIANCE, MEAN
from tests.fixtures.pose_worlds import random_poses

CONFIG = MapMatching()


def surface(owner, seed, n=400, jitter_m=0.004, first_id=0):
    """A textured wall of flat discs: every owner samples the same wall at its own places, in the world frame."""
    rng = np.random.default_rng(seed)
    side = int(np.sqrt(n))
    grid = 0.02 * np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    grid = grid + jitter_m * rng.normal(size=grid.shape)
    n = len(grid)
    theta = np.zeros((n, 13))
    theta[:, MEAN] = np.concatenate([grid, 0.001 * rng.normal(size=(n, 1))], axis=1)
    tilt = so3.quat_from_rotvec(0.03 * rng.normal(size=(n, 3)))
    scales = np.log(np.tile([0.011, 0.011, CONFIG.thickness_floor_m], (n, 1))) + [0.1, 0.1, 0] * rng.normal(
        size=(n, 3)
    )
    theta[:, LOG_COVARIANCE] = spd.log_covariance(tilt, scales)
    theta[:, COLOR] = 0.5 + 0.3 * np.sin(9 * grid @ [[1, 2, 0], [2, 0, 1]]) + 0.01 * rng.normal(size=(n, 3))
    theta[:, 12] = 1.5 + 0.1 * rng.normal(size=n)
    ids = first_id + rng.permutation(10 * n)[:n]
    return Evidence(owner, ids, np.zeros(n), theta, np.zeros((n, 31)))


def test_two_samplings_of_one_wall_match():
    a, b = surface("alpha", 0), surface("bravo", 1)
    pairs = match(a, b, CONFIG)
    assert len(pairs) > 0.5 * len(a)
    i = np.searchsorted(np.sort(a.ids), pairs[:, 0])
    row_a, row_b = np.argsort(a.ids)[i], np.argsort(b.ids)[np.searchsorted(np.sort(b.ids), pairs[:, 1])]
    assert np.linalg.norm(a.theta[row_a, MEAN] - b.theta[row_b, MEAN], axis=1).max() <= CONFIG.radius_m
    assert gaussian_distance(a, row_a, b, row_b, config=CONFIG).max() < threshold(a, CONFIG)


def test_every_gaussian_is_matched_at_most_once():
    pairs = match(surface("alpha", 2), surface("bravo", 3), CONFIG)
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)


def test_matches_do_not_depend_on_the_order_of_rows_or_on_the_world():
    a, b = surface("alpha", 4), surface("bravo", 5)
    pairs = match(a, b, CONFIG)
    rng = np.random.default_rng(6)
    shuffled = match(a.select(rng.permutation(len(a))), b.select(rng.permutation(len(b))), CONFIG)
    np.testing.assert_array_equal(shuffled, pairs)
    T = random_poses(rng, 1)
    np.testing.assert_array_equal(match(a.in_world(T), b.in_world(T), CONFIG), pairs)


def test_matches_do_not_depend_on_how_a_camera_sees_colors():
    """As a bravo whose every channel is darker and whose black is not black; compared as if alike, half is lost."""
    a, b = (
        replace(e, information=np.ones((len(e), 31))) for e in (surface("alpha", 9), surface("bravo", 10))
    )
    theta = b.theta.copy()
    theta[:, COLOR] = [0.7, 0.8, 0.6] * theta[:, COLOR] + [0.05, -0.03, 0.02]
    expected, tinted = match(a, b, CONFIG), replace(b, theta=theta)
    assert len(np.intersect1d(match(a, tinted, CONFIG), expected)) > 0.97 * len(np.unique(expected))
    alike = CONFIG.model_copy(update={"colors": ColorConfig(enabled=False)})
    assert len(match(a, tinted, alike)) < 0.5 * len(expected)


def test_matches_are_mutual_bests_of_all_candidates():
    """Against exhaustive search, with a threshold that both sides share."""
    a, b = surface("alpha", 7, n=100), surface("bravo", 8, n=100)
    config = CONFIG.model_copy(update={"candidates": 100})
    i, j = np.meshgrid(np.arange(len(a)), np.arange(len(b)), indexing="ij")
    d = gaussian_distance(a, i.ravel(), b, j.ravel(), config=config).reshape(i.shape)
    far = np.linalg.norm(a.theta[:, None, MEAN] - b.theta[None, :, MEAN], axis=-1) > config.radius_m
    d[far | (d >= threshold(a, config))] = np.inf
    expected = {
        (int(a.ids[r]), int(b.ids[np.argmin(d[r])]))
        for r in range(len(a))
        if np.isfinite(d[r].min()) and np.argmin(d[:, np.argmin(d[r])]) == r
    }
    assert {tuple(p) for p in match(a, b, config).tolist()} == expected


def test_a_far_wall_or_an_empty_map_matches_nothing():
    a = surface("alpha", 9)
    far = Evidence("bravo", a.ids, a.anchors, a.theta + np.eye(13)[2], a.information)
    assert match(a, far, CONFIG).shape == (0, 2)
    empty = a.select(slice(0, 0))
    assert match(a, empty, CONFIG).shape == match(empty, a, CONFIG).shape == (0, 2)
    assert threshold(a.select(slice(0, 1)), CONFIG) == 0.0


def test_thickness_at_the_floor_says_nothing():
    """Discs at the floor: how thin they are is not compared, nor is a thick one with a thin one across the surface."""
    scales = np.log([[0.02, 0.02, CONFIG.thickness_floor_m], [0.02, 0.02, 0.9 * CONFIG.thickness_floor_m]])
    theta = np.zeros((2, 13))
    theta[:, LOG_COVARIANCE] = spd.log_covariance(np.tile([1.0, 0, 0, 0], (2, 1)), scales)
    e = Evidence("alpha", np.arange(2), np.zeros(2), theta, np.zeros((2, 31)))
    zero, one = np.array([0]), np.array([1])
    assert gaussian_distance(e, zero, e, one, config=CONFIG)[0] == pytest.approx(0.0, abs=1e-12)
    thick = scales + np.log(2.0)
    theta[1, LOG_COVARIANCE] = spd.log_covariance(np.array([1.0, 0, 0, 0]), thick[0])
    thicker = Evidence("alpha", np.arange(2), np.zeros(2), theta, np.zeros((2, 31)))
    expected = np.sqrt(0.1 * 2 * (2 * np.log(2)) ** 2)  # two axes along the surface, not the third
    assert gaussian_distance(thicker, zero, thicker, one, config=CONFIG)[0] == pytest.approx(expected)


def test_a_tilt_counts_even_between_discs_at_the_floor():
    """Two walls that meet at an edge are not one surface."""
    scales = np.log([0.02, 0.02, CONFIG.thickness_floor_m])
    quats = so3.quat_from_rotvec(np.array([[0, 0, 0], [0, 0.1, 0], [0, np.pi / 2, 0]]))
    theta = np.zeros((3, 13))
    theta[:, LOG_COVARIANCE] = spd.log_covariance(quats, scales)
    e = Evidence("alpha", np.arange(3), np.zeros(3), theta, np.zeros((3, 31)))
    little, corner = gaussian_distance(e, np.array([0, 0]), e, np.array([1, 2]), config=CONFIG)
    assert little < 0.3
    assert corner > 1.0


@pytest.mark.parametrize("most", [3, 1 << 40])
def test_pairs_without_others_are_those_of_a_set(most):
    rng = np.random.default_rng(0)
    pairs, others = rng.integers(0, most, (40, 2)), rng.integers(0, most, (5, 2))
    others = np.concatenate([others, pairs[[3, 17]]])
    out = {tuple(pair) for pair in others.tolist()}
    expected = [pair for pair in pairs.tolist() if tuple(pair) not in out]
    assert matching.without(pairs, others).tolist() == expected
    assert matching.without(pairs, others[:0]).tolist() == pairs.tolist()
    assert not len(matching.without(pairs[:0], others))


def test_the_best_of_each_is_the_least_and_of_equal_ones_that_of_the_least_tie():
    group = np.array([0, 0, 2, 2, 2, 3])
    d = np.array([0.5, 0.5, 0.3, 0.2, 0.9, 1.0])
    tie = np.array([7, 4, 1, 2, 3, 9])
    assert matching._best_of_each(group, d, 1.0, lambda at: tie[at]).tolist() == [1, 3]
    assert not len(matching._best_of_each(group, d, 0.1, lambda at: tie[at]))


def random_splats(rng, owner, n):
    """Theta in every part, with scales [n, 3] of which some, in any place, are at or below the floor."""
    quats = rng.normal(size=(n, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    log_scales = np.log(CONFIG.thickness_floor_m) + rng.uniform(0.1, 2.0, size=(n, 3))
    thin = rng.random(n) < 0.5
    log_scales[thin, 2] = np.log(CONFIG.thickness_floor_m) - rng.uniform(0, 0.5, size=thin.sum())
    theta = rng.normal(size=(n, 13))
    theta[:, MEAN] *= 0.05
    theta[:, LOG_COVARIANCE] = spd.log_covariance(quats, log_scales)
    return Evidence(owner, np.arange(n), np.zeros(n), theta, np.zeros((n, 31))), quats, log_scales, thin


def test_the_distance_is_the_documented_one():
    """Pair by pair, from rotations and scales instead of eigenvectors of log-covariances."""
    rng = np.random.default_rng(8)
    (a, *shape_a), (b, *shape_b) = (random_splats(rng, name, 60) for name in ("alpha", "bravo"))
    floor = np.log(CONFIG.thickness_floor_m)
    expected = []
    for k in range(60):
        logs, axes, thin = [], [], []
        for quats, log_scales, is_thin in (shape_a, shape_b):
            R = so3.from_quat_wxyz(quats[k])
            logs.append(R @ np.diag(2 * np.maximum(log_scales[k], floor)) @ R.T)
            axes.append(R[:, 2])
            thin.append(is_thin[k])
        delta = logs[0] - logs[1]
        if thin[0] != thin[1]:
            axis = axes[0] if thin[0] else axes[1]
            delta = delta - (axis @ delta @ axis) * np.outer(axis, axis)
        apart = a.theta[k] - b.theta[k]
        expected.append(
            np.sum(apart[MEAN] ** 2) / CONFIG.position_scale_m**2
            + 0.1 * np.sum(delta**2)
            + np.sum((apart[COLOR] / (0.5 / np.sqrt(np.pi))) ** 2)
            + 0.5 * apart[12] ** 2
        )
    rows = np.arange(60)
    found = gaussian_distance(a, rows, b, rows, config=CONFIG)
    np.testing.assert_allclose(found, np.sqrt(expected), rtol=1e-9)
    np.testing.assert_allclose(gaussian_distance(b, rows, a, rows, config=CONFIG), found, rtol=1e-9)


def test_a_gaussian_is_no_neighbor_of_itself():
    """Two at one place, of another opacity: a search names either of them first."""
    single = surface("alpha", 9, n=100)
    theta = np.repeat(single.theta, 2, axis=0)
    theta[1::2, 12] += 4.0
    doubled = Evidence(
        "alpha", np.arange(len(theta)), np.zeros(len(theta)), theta, np.zeros((len(theta), 31))
    )
    assert threshold(doubled, CONFIG) == pytest.approx(np.sqrt(0.5) * 4.0)
    least = CONFIG.model_copy(update={"percentile": 1.0})
    assert threshold(doubled, least) == pytest.approx(np.sqrt(0.5) * 4.0)
