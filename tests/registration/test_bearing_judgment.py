"""What matches without depth say of a motion."""

import numpy as np
import pytest

from duagc.pipeline.geometry import se3
from duagc.pipeline.registration.bearing_judgment import bearings_contradict
from duagc.pipeline.registration.bearing_motion import (
    RELATIVE_DEPTH_SIGMA,
    BearingMatches,
    motion_from_bearings,
)

PIXEL, STEP_M, TILE_M = 1 / 228, 0.8, 0.8
T_FIRST_SECOND = se3.exp(np.array([0.0, 0.0, STEP_M, 0.0, 0.0, 0.0]))


def street(far: int, *, passing: int = 0, seed: int = 0) -> BearingMatches:
    """Ground of equal tiles, each taken for the next one, between houses without depth; some things pass."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-4, 4, 140), np.full(140, 1.5), rng.uniform(4, 14, 140)])
    sides = rng.choice([-1.0, 1.0], far)
    houses = np.column_stack([9 * sides, rng.uniform(-6, 1, far), rng.uniform(17, 40, far)])
    first = np.concatenate([ground, houses])
    second = se3.transform(se3.inverse(T_FIRST_SECOND), first)
    second[: len(ground), 2] += TILE_M
    second[len(ground) : len(ground) + passing] += (0.9, 0.0, 0.5)
    sought = second[:, :2] / second[:, 2:] + 0.3 * PIXEL * rng.normal(size=(len(second), 2))
    inverse_depth = np.concatenate([1 / ground[:, 2], np.full(far, np.nan)])
    sigma = np.where(np.isnan(inverse_depth), np.nan, RELATIVE_DEPTH_SIGMA)
    return BearingMatches(first / first[:, 2:], sought, inverse_depth, sigma, len(first), PIXEL)


def test_houses_without_depth_contradict_a_camera_that_stands_on_equal_tiles() -> None:
    matched = street(120)
    found = motion_from_bearings(matched, [np.eye(4)])
    assert found.accepted, "most agree with it"
    assert se3.distance(T_FIRST_SECOND, found.T_first_second)[0] > 0.5
    assert bearings_contradict(matched, found.T_first_second)


def test_they_do_not_contradict_the_true_motion() -> None:
    assert not bearings_contradict(street(120), T_FIRST_SECOND)


def test_few_of_them_contradict_nothing() -> None:
    assert not bearings_contradict(street(18), np.eye(4))


@pytest.mark.parametrize("passing", [20, 40])
def test_things_that_pass_do_not_contradict_what_others_confirm(passing: int) -> None:
    assert not bearings_contradict(street(120, passing=passing), T_FIRST_SECOND)
