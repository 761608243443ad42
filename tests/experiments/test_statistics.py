"""The tests of paired differences agree with scipy, with counting by hand, and with what they promise."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from duagc.pipeline.base.random_streams import generator
from duagc.pipeline.experiments.statistics import (
    bca_interval,
    holm,
    least_sign_flip_p,
    sign_flip_p,
    t_test_p,
    two_one_sided_p,
)

GAPS = [0.31, 0.12, 0.45, -0.08, 0.27, 0.02]


def test_the_sign_flip_test_is_the_exact_permutation_test_of_scipy() -> None:
    for margin in (-0.2, 0.0, 0.1, 0.3):
        expected = stats.permutation_test(
            (np.array(GAPS) - margin,),
            np.mean,
            permutation_type="samples",
            alternative="greater",
            n_resamples=np.inf,
        )
        assert sign_flip_p(GAPS, margin) == pytest.approx(expected.pvalue, abs=1e-12)


@pytest.mark.parametrize("pairs", [1, 4, 5, 8])
def test_five_seeds_reach_one_in_thirty_two_and_no_less(pairs: int) -> None:
    gaps = [1.0 + 0.1 * k for k in range(pairs)]
    assert sign_flip_p(gaps, 0.0) == least_sign_flip_p(pairs) == 0.5**pairs
    assert sign_flip_p([-gap for gap in gaps], 0.0) == 1.0
    assert sign_flip_p([*gaps[:-1], -0.01], 0.0) > least_sign_flip_p(pairs) or pairs == 1


def test_equal_sums_in_another_order_count_as_equal() -> None:
    """0.1 + 0.2 is not 0.3: without slack the p value would depend on rounding."""
    assert sign_flip_p([0.1, 0.2, -0.3], 0.0) == 5 / 8


def test_the_t_test_is_the_tail_of_student() -> None:
    n, m = len(GAPS), 0.05
    t = (np.mean(GAPS) - m) / (np.std(GAPS, ddof=1) / math.sqrt(n))
    assert t_test_p(GAPS, m) == pytest.approx(float(stats.t.sf(t, n - 1)), rel=1e-12)
    assert t_test_p([0.2] * 5, 0.1) == 0.0
    assert t_test_p([0.1] * 5, 0.1) == 1.0


def test_equivalence_needs_both_sides() -> None:
    near = [0.01, -0.02, 0.015, 0.0, -0.01]
    assert two_one_sided_p(near, 0.1) < 0.001
    assert two_one_sided_p([gap + 0.2 for gap in near], 0.1) > 0.99
    assert two_one_sided_p([gap - 0.2 for gap in near], 0.1) > 0.99
    t_low = stats.ttest_1samp(near, -0.02, alternative="greater").pvalue
    t_high = stats.ttest_1samp(near, 0.02, alternative="less").pvalue
    assert two_one_sided_p(near, 0.02) == pytest.approx(max(t_low, t_high), rel=1e-12)


def bca_by_hand(gaps: np.ndarray, stream: np.random.Generator, confidence: float) -> tuple[float, float]:
    """Efron's formulas, written out."""
    n = len(gaps)
    means = gaps[stream.integers(0, n, (40_000, n))].mean(axis=1)
    z0 = stats.norm.ppf((np.mean(means < gaps.mean()) + np.mean(means <= gaps.mean())) / 2)
    left_out = (gaps.sum() - gaps) / (n - 1)
    d = left_out.mean() - left_out
    a = np.sum(d**3) / (6 * np.sum(d**2) ** 1.5)
    z = stats.norm.ppf([(1 - confidence) / 2, (1 + confidence) / 2])
    low, high = np.quantile(means, stats.norm.cdf(z0 + (z0 + z) / (1 - a * (z0 + z))))
    return float(low), float(high)


def test_the_interval_is_efrons_and_repeats_to_the_last_bit() -> None:
    gaps = generator(3, "test").gamma(1.0, 1.0, 12)
    found = bca_interval(list(gaps), generator(0, "test", rule="a"))
    assert found == bca_interval(list(gaps), generator(0, "test", rule="a"))
    assert found == pytest.approx(bca_by_hand(gaps, generator(1, "test"), 0.95), abs=0.03)
    shift = np.mean(gaps) - np.mean(found)
    assert abs(shift) > 0.01, "the percentile interval of skewed values is not centered either way"
    assert bca_interval([0.5] * 5, generator(0, "test")) == (0.5, 0.5)


def closed_testing(p: list[float]) -> list[float]:
    """Holm as the closure of Bonferroni: a claim's p value is the worst of all families that contain it."""
    n = len(p)
    families = [f for size in range(1, n + 1) for f in itertools.combinations(range(n), size)]
    return [max(min(1.0, len(f) * min(p[j] for j in f)) for f in families if k in f) for k in range(n)]


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0, 1), min_size=1, max_size=6))
def test_holm_is_closed_testing_with_bonferroni(p: list[float]) -> None:
    assert holm(p) == pytest.approx(closed_testing(p), abs=1e-12)


def test_both_tests_keep_their_level_where_nothing_is_better() -> None:
    """Normal differences of mean zero: five in a hundred are called better, within what 400 draws scatter."""
    draws = generator(7, "level").normal(size=(400, 5))
    t = np.mean([t_test_p(list(row), 0.0) <= 0.05 for row in draws])
    flip = np.mean([sign_flip_p(list(row), 0.0) <= 0.05 for row in draws])
    assert abs(t - 0.05) < 0.035
    assert abs(flip - 1 / 32) < 0.03
