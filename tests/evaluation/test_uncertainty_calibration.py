import numpy as np
import pytest
from scipy import stats

from duagc.pipeline.evaluation import uncertainty_calibration


@pytest.fixture(scope="module")
def predicted() -> tuple[np.ndarray, np.ndarray]:
    """Uncertainties over a range of 50:1 and errors that were really drawn with them."""
    rng = np.random.default_rng(3)
    sigma = np.exp(rng.normal(-5.0, 1.0, 20000))
    return sigma, np.abs(rng.normal(0.0, sigma))


def test_a_right_prediction_scores_well(predicted):
    sigma, error = predicted
    assert uncertainty_calibration.coverage_95(sigma, error) == pytest.approx(
        0.95, abs=0.006
    )  # 4 standard errors
    assert uncertainty_calibration.fitted_scale(sigma, error) == pytest.approx(1.0, abs=0.02)
    for predicted_rms, observed_rms in uncertainty_calibration.reliability(sigma, error):
        assert observed_rms == pytest.approx(predicted_rms, rel=0.1)


def test_shuffled_uncertainty_scores_clearly_worse_on_every_metric(predicted):
    """Except the companion code's: that one does not notice, which is why it is for comparison only."""
    sigma, error = predicted
    dealt = uncertainty_calibration.shuffled(sigma, "test")
    assert np.array_equal(np.sort(dealt), np.sort(sigma))
    assert (
        uncertainty_calibration.spearman(sigma, error)
        > 0.6
        > 0.05
        > abs(uncertainty_calibration.spearman(dealt, error))
    )
    assert (
        uncertainty_calibration.ause(sigma, error) < 0.25 < 0.5 < uncertainty_calibration.ause(dealt, error)
    )
    assert uncertainty_calibration.nll(sigma, error) + 0.3 < uncertainty_calibration.nll(dealt, error)
    assert uncertainty_calibration.coverage_95(dealt, error) < 0.8
    assert uncertainty_calibration.ece_rank(sigma, error) < 0.12
    assert uncertainty_calibration.ece_rank(dealt, error) == pytest.approx(0.25, abs=0.02)
    assert uncertainty_calibration.ece_paper(dealt, error) < 0.05


def test_perfect_order_gives_the_ideal_values():
    error = np.linspace(0.001, 0.1, 1000)
    sigma = 3.0 * error
    assert uncertainty_calibration.spearman(sigma, error) == pytest.approx(1.0)
    assert uncertainty_calibration.ause(sigma, error) == pytest.approx(0.0, abs=1e-15)
    assert uncertainty_calibration.ece_rank(sigma, error) == pytest.approx(0.0, abs=1e-12)
    assert uncertainty_calibration.fitted_scale(sigma, error) == pytest.approx(1 / 3)
    assert uncertainty_calibration.spearman(sigma, error[::-1]) == pytest.approx(-1.0)


def test_ranks_do_not_depend_on_scale_and_nll_does(predicted):
    sigma, error = predicted
    assert uncertainty_calibration.ause(10 * sigma, error) == uncertainty_calibration.ause(sigma, error)
    assert uncertainty_calibration.ece_rank(10 * sigma, error) == uncertainty_calibration.ece_rank(
        sigma, error
    )
    assert uncertainty_calibration.nll(10 * sigma, error) > uncertainty_calibration.nll(sigma, error)


def test_spearman_shares_ranks_among_equals():
    assert uncertainty_calibration.spearman(
        np.array([1.0, 1.0, 2.0, 2.0]), np.array([1.0, 2.0, 3.0, 4.0])
    ) == pytest.approx(0.894427191, abs=1e-9)
    assert uncertainty_calibration.spearman(np.ones(5), np.arange(5.0)) == 0.0


def test_the_companion_codes_formula():
    uncertainty = np.array([0.0, 0.05, 1.0])
    error = np.array([0.0, 1.0, 0.5])
    # bins [0, 0.1): mean u 0.025, mean e 0.5, two values; [0.9, 1]: u 1, e 0.5
    assert uncertainty_calibration.ece_paper(uncertainty, error) == pytest.approx((2 * 0.475 + 0.5) / 3)


@pytest.mark.parametrize(("spread", "reached"), [(0.0, 0.25), (0.5, 0.14), (1.0, 0.08), (2.0, 0.035)])
def test_right_uncertainties_order_errors_only_as_far_as_they_differ(spread, reached):
    """By log-normal uncertainties of so much spread, in units of the natural logarithm."""
    sigma = np.exp(spread * np.random.default_rng(0).standard_normal(20_000))
    right = uncertainty_calibration.if_right(sigma, "test")
    assert np.sqrt(np.mean((right / sigma) ** 2)) == pytest.approx(1.0, abs=0.02)
    assert uncertainty_calibration.ece_rank(sigma, right) == pytest.approx(reached, abs=0.01)


def test_likelihoods_are_those_of_normal_distributions(predicted):
    sigma, error = predicted
    expected = -stats.norm.logpdf(error, scale=sigma).mean()
    assert uncertainty_calibration.nll(sigma, error) == pytest.approx(expected, rel=1e-12)
    best = uncertainty_calibration.fitted_scale(sigma, 1.7 * error)
    tried = [uncertainty_calibration.nll(s * best * sigma, 1.7 * error) for s in (0.99, 1.0, 1.01)]
    assert tried[1] < min(tried[0], tried[2])


def test_ranks_are_those_of_scipy(predicted):
    sigma, error = (values[:500].round(3) for values in predicted)  # many are equal
    expected = stats.spearmanr(sigma, error).statistic
    assert uncertainty_calibration.spearman(sigma, error) == pytest.approx(expected, rel=1e-12)
    order = np.argsort(sigma, kind="stable")
    ranks = (stats.rankdata(error)[order] - 0.5) / 500
    gaps = [abs((50 * b + 25) / 500 - ranks[50 * b : 50 * (b + 1)].mean()) for b in range(10)]
    assert uncertainty_calibration.ece_rank(sigma, error) == pytest.approx(np.mean(gaps), rel=1e-12)


def test_the_area_is_between_the_curves_of_sparsification():
    """Of 200 Gaussians, two go at every step."""
    rng = np.random.default_rng(8)
    sigma, error = rng.uniform(1, 2, 200), rng.uniform(0, 1, 200)
    by_sigma, by_error = error[np.argsort(-sigma)], np.sort(error)[::-1]
    apart = [by_sigma[2 * k :].mean() - by_error[2 * k :].mean() for k in range(100)]
    expected = np.mean(apart) / error.mean()
    assert uncertainty_calibration.ause(sigma, error) == pytest.approx(expected, rel=1e-12)
