"""Motions that matched features agree on where most of them have no depth."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.geometry import se3
from duagc.pipeline.registration.bearing_motion import BearingMatches, motion_from_bearings
from duagc.pipeline.registration.features import NO_BEARINGS, Bearings, Features

PIXEL = 1 / 180
T_FIRST_SECOND = se3.exp(np.array([0.07, -0.02, 0.05, 0.02, -0.06, 0.03]))


def two_views(
    depth_in: tuple[float, float],
    *,
    noise_px: float = 0.2,
    wrong: float = 0.0,
    seed: int = 0,
    few_depths: bool = True,
) -> tuple[Features, Features]:
    """Views of the same 160 points, each with the depth of some; some seen elsewhere by the second one."""
    rng = np.random.default_rng(seed)
    count = 160
    descriptors = rng.integers(0, 120, (count, 128), dtype=np.uint8)
    second = np.column_stack([rng.uniform(-0.8, 0.8, (count, 2)), np.ones(count)])
    second *= rng.uniform(0.8, 5.0, (count, 1))
    moved = rng.random(count) < wrong
    views = []
    for points, share in zip((se3.transform(T_FIRST_SECOND, second), second), depth_in, strict=True):
        rays = points / points[:, 2:]
        rays[:, :2] += noise_px * PIXEL * rng.normal(size=(count, 2))
        if len(views):
            rays[moved, :2] += rng.uniform(-0.3, 0.3, (int(moved.sum()), 2))
        known = rng.random(count) < share
        bearings = Bearings(descriptors[~known], rays[~known].astype(np.float32), PIXEL, few_depths)
        with_depth = (rays * points[:, 2:])[known].astype(np.float32)
        views.append(Features(descriptors[known], with_depth, bearings))
    return views[0], views[1]


def matched(views: tuple[Features, Features]) -> BearingMatches:
    found = BearingMatches.of(*views, 0.8)
    assert found is not None
    return found


@pytest.mark.parametrize("depth_in", [(0.3, 0.0), (0.0, 0.3), (0.2, 0.2), (0.6, 0.6)])
@pytest.mark.parametrize("wrong", [0.0, 0.25])
def test_depth_in_either_view_and_bearings_determine_the_motion(
    depth_in: tuple[float, float], wrong: float
) -> None:
    matches = matched(two_views(depth_in, wrong=wrong))
    assert len(matches) == 160
    motion = motion_from_bearings(matches, [np.eye(4)])
    assert motion.accepted
    moved_m, turned_rad = se3.distance(T_FIRST_SECOND, motion.T_first_second)
    assert moved_m < 0.006
    assert turned_rad < 0.002


def test_depth_whose_noise_grows_with_the_distance_counts_by_it() -> None:
    """As of a stereo pair: what is near says how far the camera went, and what is far says little."""

    def wrong_by_m(sigma: float, seed: int) -> float:
        rng, noisy = np.random.default_rng(seed), []
        for view in two_views((0.4, 0.4), seed=seed):
            points = view.points.astype(np.float64)
            depth_m = 1 / np.maximum(1 / points[:, 2] + 0.06 * rng.standard_normal(len(points)), 0.05)
            points = (points * (depth_m / points[:, 2])[:, None]).astype(np.float32)
            bearings = replace(view.bearings, inverse_depth_sigma=sigma)
            noisy.append(Features(view.descriptors, points, bearings))
        motion = motion_from_bearings(matched((noisy[0], noisy[1])), [np.eye(4)])
        return float(se3.distance(T_FIRST_SECOND, motion.T_first_second)[0])

    stated, unstated = ([wrong_by_m(sigma, seed) for seed in range(12)] for sigma in (0.06, 0.0))
    assert np.mean(stated) < 0.8 * np.mean(unstated)


def test_without_any_depth_the_way_is_as_long_as_it_was_taken_to_be() -> None:
    matches = matched(two_views((0.0, 0.0)))
    T = T_FIRST_SECOND.copy()
    T[:3, 3] *= 1.3
    motion = motion_from_bearings(matches, [T])
    apart_rad = float(se3.distance(T_FIRST_SECOND, motion.T_first_second)[1])
    assert apart_rad < 0.002
    way, true_way = motion.T_first_second[:3, 3], T_FIRST_SECOND[:3, 3]
    assert way @ true_way / np.linalg.norm(way) / np.linalg.norm(true_way) > 0.998
    assert np.linalg.norm(way) == pytest.approx(1.3 * np.linalg.norm(true_way), rel=0.05)
    ahead = np.zeros(6)
    ahead[:3] = motion.T_first_second[:3, :3].T @ way / np.linalg.norm(way)
    known_m = 1 / np.sqrt(max(ahead @ motion.information @ ahead, 1e-12))
    assert known_m > 0.05
    aside = np.cross(ahead[:3], [0.0, 0.0, 1.0])
    assert 1 / np.sqrt(aside @ motion.information[:3, :3] @ aside / (aside @ aside)) < 0.01


def test_the_stated_information_explains_the_errors() -> None:
    squares = []
    for seed in range(20):
        motion = motion_from_bearings(matched(two_views((0.3, 0.3), noise_px=0.5, seed=seed)), [np.eye(4)])
        away = se3.log(se3.inverse(T_FIRST_SECOND) @ motion.T_first_second)
        squares.append(float(away @ motion.information @ away))
    assert np.mean(squares) < 12  # six degrees of freedom, and weights that take a fifth of the information


@pytest.mark.parametrize("seed", range(6))
def test_of_the_motions_that_a_wall_leaves_open_the_true_one_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3.exp(np.array([0.053, -0.02, 0.071, 0.0, 0.0, 0.0]))
    second = np.column_stack([rng.uniform(-3, 3, (150, 2)), np.full(150, 3.5)])
    second[:, 2] += 0.1 * second[:, 0]
    second[:20] *= rng.uniform(0.4, 0.8, (20, 1))  # things in front of the wall
    first = se3.transform(T, second)
    given, sought = first / first[:, 2:], second[:, :2] / second[:, 2:]
    sought = sought + 0.2 * PIXEL * rng.normal(size=sought.shape)
    matches = BearingMatches(given, sought, np.full(150, np.nan), np.full(150, np.nan), 150, PIXEL)
    starts = [se3.exp(0.05 * rng.normal(size=6) + np.array([0, 0, 0.03, 0, 0, 0])) for _ in range(2)]
    found = motion_from_bearings(matches, starts)
    assert se3.distance(T, found.T_first_second)[1] < 0.002


def test_matches_by_chance_are_no_motion() -> None:
    first, second = two_views((0.3, 0.3), wrong=0.0)
    rng = np.random.default_rng(7)
    shuffled = Bearings(
        second.bearings.descriptors, rng.permutation(second.bearings.rays), PIXEL, few_depths=True
    )
    other = Features(second.descriptors, rng.permutation(second.points), shuffled)
    assert not motion_from_bearings(matched((first, other)), [np.eye(4)]).accepted


def test_views_that_were_not_looked_at_for_bearings_say_nothing() -> None:
    first, second = two_views((0.5, 0.5))
    assert BearingMatches.of(first, Features(second.descriptors, second.points, NO_BEARINGS), 0.8) is None


def test_matches_with_depth_in_both_views_decide_by_themselves() -> None:
    assert BearingMatches.of(*two_views((0.9, 0.9), few_depths=False), 0.8) is None
    assert BearingMatches.of(*two_views((0.9, 0.3), few_depths=False), 0.8) is not None


def test_where_few_pixels_have_depth_all_matches_count() -> None:
    """Of a street above a hood most features have depth, but dense registration few samples."""
    motion = motion_from_bearings(matched(two_views((0.9, 0.9))), [np.eye(4)])
    assert motion.matches == 160
    assert se3.distance(T_FIRST_SECOND, motion.T_first_second)[0] < 0.006


def test_a_blob_of_several_orientations_counts_once() -> None:
    """One that was taken for another decides where the camera is if it counts as often as it has orientations."""
    rng, orientations = np.random.default_rng(8), 60
    first, second = two_views((0.0, 0.0))
    blob = np.tile(np.float32([0.4, 0.3, 1.0]), (orientations, 1))
    descriptors = rng.integers(120, 250, (orientations, 128), dtype=np.uint8)

    def with_blob(view: Features, rays: np.ndarray) -> Features:
        own = view.bearings
        more = np.concatenate([own.descriptors, descriptors]), np.concatenate([own.rays, rays])
        return Features(view.descriptors, view.points, Bearings(*more, PIXEL, few_depths=True))

    elsewhere = blob + np.float32([0.1, 0.05, 0.0])
    assert len(matched((with_blob(first, blob), with_blob(second, elsewhere)))) == 161


def test_few_matches_and_wrong_ones_alone_are_no_motion() -> None:
    first, second = two_views((0.0, 0.0))
    few = Bearings(second.bearings.descriptors[:15], second.bearings.rays[:15], PIXEL, True)
    assert BearingMatches.of(first, Features(second.descriptors, second.points, few), 0.8) is None
    behind = BearingMatches(np.ones((40, 3)), np.full((40, 2), -1e6), *[np.full(40, np.nan)] * 2, 40, PIXEL)
    assert not motion_from_bearings(behind, [np.eye(4)]).accepted


@pytest.mark.parametrize("body", [100, 300])
def test_a_body_that_moves_with_the_camera_does_not_count(body: int) -> None:
    """Of a cabin that fills most of the image; where all stays at its pixel, dense registration decides."""
    rng = np.random.default_rng(5)
    rays = np.column_stack([rng.uniform(-0.8, 0.8, (body, 2)), np.ones(body)]).astype(np.float32)
    descriptors = rng.integers(120, 250, (body, 128), dtype=np.uint8)

    def with_body(view: Features) -> Features:
        own = Bearings(
            np.concatenate([view.bearings.descriptors, descriptors]),
            np.concatenate([view.bearings.rays, rays]),
            PIXEL,
            few_depths=view.bearings.few_depths,
        )
        return Features(view.descriptors, view.points, own)

    first, second = (with_body(view) for view in two_views((0.3, 0.3)))
    motion = motion_from_bearings(matched((first, second)), [np.eye(4)])
    assert motion.matches <= 160
    others = (with_body(view) for view in two_views((0.9, 0.9), few_depths=False))
    assert BearingMatches.of(*others, 0.8) is None, "the body has no depth, most of what moves has it"
    assert se3.distance(T_FIRST_SECOND, motion.T_first_second)[0] < 0.006
    assert BearingMatches.of(first, first, 0.8) is None
