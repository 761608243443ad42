"""The update of one robot's own keyframes while those of its neighbors are held."""

import numpy as np
import pytest

from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus import own_block
from duagc.pipeline.consensus.own_block import minimized
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.least_squares import difference
from duagc.pipeline.posegraph.relative_poses import RelativePoses
from tests.fixtures.pose_worlds import random_information, random_poses

CONFIG = PoseConsensusConfig()


def contradicting(seed):
    """Relative poses that nothing fits, among three own keyframes and two held ones, and random places of them."""
    rng = np.random.default_rng(seed)
    i, j = np.array([0, 1, 2, 0, 2, 1]), np.array([1, 2, 3, 3, 4, 4])
    factors = RelativePoses(i, j, random_poses(rng, 6), random_information(rng, 6))
    poses = random_poses(rng, 5)
    return factors, poses[:3], poses[3:]


@pytest.mark.parametrize("seed", range(6))
def test_no_step_raises_the_cost_however_far_the_minimum_is(seed):
    factors, x, held = contradicting(seed)
    weights = np.ones(len(factors))
    costs = [least_squares.cost(factors, np.concatenate([x, held]), weights)]
    for _ in range(8):
        x = own_block._step(factors, weights, x, held, limit_rad=10.0)
        costs.append(least_squares.cost(factors, np.concatenate([x, held]), weights))
    assert np.all(np.diff(costs) <= 1e-12 * costs[0])
    assert costs[-1] < costs[0]


def test_no_step_turns_a_keyframe_farther_than_it_may():
    factors, x, held = contradicting(0)
    turned_rad = []
    for limit_rad in (10.0, 0.05):
        moved = own_block._step(factors, np.ones(len(factors)), x, held, limit_rad=limit_rad)
        turned_rad.append(np.linalg.norm(difference(moved, x)[:, 3:], axis=1).max())
    assert turned_rad[0] > 0.1
    assert turned_rad[1] <= 0.05 * (1 + 1e-9)


def test_factors_without_weight_move_nothing():
    factors, x, held = contradicting(1)
    weights = np.array([1.0, 1.0, 1.0, 0.0, 1.0, 0.0])
    counted = factors.select(weights > 0)
    found = minimized(factors, weights, x, held, config=CONFIG)
    np.testing.assert_array_equal(found, minimized(counted, np.ones(4), x, held, config=CONFIG))
