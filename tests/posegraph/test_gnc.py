"""The schedule of robust weights: where it begins, when it goes on, when weights are final."""

import numpy as np
import pytest

from duagc.pipeline.config.consensus import PoseConsensusConfig, TeamSchedule
from duagc.pipeline.posegraph.gnc import RobustWeights, convex_control, first_control, graduated_weights

CONFIG = PoseConsensusConfig()
C2 = CONFIG.truncation**2


def surrogate(r2: np.ndarray, mu: float) -> np.ndarray:
    """rho_mu(r), eq. (6) of Yang, Antonante, Tzoumas, Carlone 2020, of truncated least squares."""
    low, high = mu / (mu + 1) * C2, (mu + 1) / mu * C2
    between = 2 * np.sqrt(C2 * r2 * mu * (mu + 1)) - mu * (C2 + r2)
    return np.where(r2 <= low, r2, np.where(r2 >= high, C2, between))


@pytest.mark.parametrize("mu", [0.01, 0.3, 5.0])
def test_weights_are_those_that_make_the_surrogate_least_squares(mu):
    """w = d rho / d r^2 (Black and Rangarajan 1996), by finite differences."""
    r2 = np.linspace(0.1, 2.5 * (mu + 1) / mu * C2, 400)
    step = 1e-6 * r2
    slope = (surrogate(r2 + step, mu) - surrogate(r2 - step, mu)) / (2 * step)
    edges = np.array([mu / (mu + 1) * C2, (mu + 1) / mu * C2])
    smooth = np.abs(r2[:, None] / edges - 1).min(axis=1) > 1e-3
    np.testing.assert_allclose(graduated_weights(r2, C2, mu)[smooth], slope[smooth], atol=1e-6)


@pytest.mark.parametrize("worst", [1.0, 4.0, 50.0])
def test_the_schedule_begins_where_the_worst_residual_is_just_convex(worst):
    """mu = c^2 / (2 r^2 - c^2), remark 5 of the same paper; a residual that is always convex needs no schedule."""
    squared = np.array([0.1, worst, 0.7]) * C2
    mu = convex_control(squared, CONFIG)
    assert mu == pytest.approx(1 / (2 * worst - 1))
    assert first_control(squared, CONFIG) == pytest.approx(CONFIG.robust_convexity * mu)
    assert first_control(squared, CONFIG, first_mu=7.0) == 7.0
    assert convex_control(0.4 * squared / worst, CONFIG) == CONFIG.robust_mu[1]


class Residuals:
    """Two small ones and a large one; how often they were asked for."""

    def __init__(self, worst: float) -> None:
        self.asked, self.squared = 0, np.array([0.1, 0.2, worst]) * C2

    def __call__(self):
        self.asked += 1
        return self.squared


def test_without_a_suspicious_residual_all_count_after_the_warm_up():
    weights, residuals = RobustWeights(np.array([1.0, 0.0, 1.0]), CONFIG), Residuals(0.9)
    assert not weights.advance(CONFIG.robust_warm_up - 0.5, False, residuals)
    assert residuals.asked == 0
    np.testing.assert_array_equal(weights.weights, [1, 0, 1])
    assert weights.advance(CONFIG.robust_warm_up, False, residuals)
    np.testing.assert_array_equal(weights.weights, 1)
    assert weights.scheduled
    assert not weights.graduated
    always = RobustWeights(np.ones(3), CONFIG.model_copy(update={"robust_skip": False}))
    assert always.advance(CONFIG.robust_warm_up, False, residuals)
    assert always.graduated


@pytest.mark.parametrize(("steady", "least"), [(False, CONFIG.robust_packets), (True, 2)])
def test_a_step_waits_for_packets_and_where_little_moves_for_an_answer(steady, least):
    weights, residuals = RobustWeights(np.ones(3), CONFIG), Residuals(40.0)
    now = 0.0 if steady else float(CONFIG.robust_warm_up)
    assert weights.advance(now, steady, residuals)
    mu = first_control(residuals.squared, CONFIG)
    np.testing.assert_allclose(weights.weights, graduated_weights(residuals.squared, C2, mu))
    assert not weights.advance(now + least - 0.5, steady, residuals)
    assert weights.advance(now + least, steady, residuals)
    mu *= CONFIG.robust_growth
    np.testing.assert_allclose(weights.weights, graduated_weights(residuals.squared, C2, mu))
    for _ in range(60):
        now += least
        weights.advance(now, steady, residuals)
    np.testing.assert_array_equal(weights.weights, [1, 1, 0])
    assert weights.scheduled
    assert weights.graduated


def test_truncated_weights_are_looked_at_again_until_they_stay(monkeypatch):
    schedule = TeamSchedule(checks=4, check_packets=3)
    monkeypatch.setattr(PoseConsensusConfig, "team_schedule", lambda _: schedule)
    weights, residuals = RobustWeights(np.ones(3), CONFIG), Residuals(0.5)
    assert weights.advance(40.0, False, residuals)
    assert not weights.done
    residuals.squared = np.array([0.1, 0.2, 1.5]) * C2
    assert weights.advance(43.0, True, residuals)
    assert not weights.advance(45.0, True, residuals)
    np.testing.assert_array_equal(weights.weights, [1, 1, 0])
    assert not weights.done  # it has just changed
    assert not weights.advance(46.0, False, residuals)
    assert not weights.done  # what they join still moves
    assert not weights.advance(49.0, True, residuals)
    assert weights.done
    fickle = RobustWeights(np.ones(3), CONFIG)
    fickle.advance(40.0, False, residuals)
    for k in range(schedule.checks + 60):
        residuals.squared = np.array([0.1, 0.2, 0.5 + k % 2]) * C2
        fickle.advance(100.0 + 5 * k, False, residuals)
    assert fickle.done
