"""One Gauss-Newton step of a robot: where it leads, and how far it may turn."""

import numpy as np
import pytest

from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.admm_edge import AdmmEdge, SharedKeyframes
from duagc.pipeline.consensus.local_problem import LocalProblem
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.least_squares import retract
from duagc.pipeline.posegraph.relative_poses import RelativePoses
from tests.fixtures.pose_worlds import random_information, random_poses

CONFIG = PoseConsensusConfig()


def link_of(keyframes, config):
    shared = SharedKeyframes(np.array(keyframes, np.int32), np.full((len(keyframes), 6), 50.0, np.float32))
    return AdmmEdge.begin("bravo", shared, (), np.zeros(0, bool), decides=True, config=config)


def test_a_step_goes_down_the_cost_and_the_pull_of_the_link():
    """The slope of f + 1/2 |x - y|_W^2 along a Gauss-Newton step, by finite differences, is -step' H step."""
    rng = np.random.default_rng(0)
    x = random_poses(rng, 3)
    i, j = np.array([0, 1, 0]), np.array([1, 2, 2])
    measured = se3.inverse(x[i]) @ x[j] @ se3.exp(0.02 * rng.normal(size=(3, 6)))
    factors = RelativePoses(i, j, measured, random_information(rng, 3))
    weights = np.array([1.0, 0.4, 2.0])
    link = link_of([0, 2], CONFIG)
    link.offset = 0.01 * rng.normal(size=(2, 6))
    problem = LocalProblem(factors, CONFIG)
    problem.weigh(weights)
    step = problem.newton_step(x, [link], [link.force()])
    _, jacobians = least_squares.gradient(factors, weights, x)
    diagonal = np.zeros((3, 6))
    diagonal[link.slots] = link.penalty()
    H = least_squares.curvature_matrix(factors, jacobians, diagonal).toarray()

    def total(share):
        moved = link.offset + share * step[link.slots]
        pull = 0.5 * np.sum(link.penalty() * moved**2)
        return 0.5 * least_squares.cost(factors, retract(x, share * step), weights) + pull

    slope = (total(1e-5) - total(-1e-5)) / 2e-5
    assert slope == pytest.approx(-step.ravel() @ H @ step.ravel(), rel=1e-5)
    assert slope < 0


def test_a_step_turns_no_farther_than_it_may_and_keeps_its_direction():
    T = se3.exp(np.array([0.3, 0, 0.1, 0.0, 0.2, 1.5]))
    factors = RelativePoses(np.array([0]), np.array([1]), T[None], 1e3 * np.eye(6)[None])
    x = np.tile(np.eye(4), (2, 1, 1))
    steps = []
    for limit_rad in (10.0, 0.1):
        config = CONFIG.model_copy(update={"step_limit_rad": limit_rad})
        link = link_of([0], config)
        steps.append(LocalProblem(factors, config).newton_step(x, [link], [link.force()]))
    free, limited = steps
    turn_rad = np.linalg.norm(free[:, 3:], axis=1).max()
    assert turn_rad > 1.0
    np.testing.assert_allclose(limited, free * 0.1 / turn_rad, atol=1e-12)
