"""Robust scales, Huber's weights, even samples."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from duagc.pipeline.geometry.statistics import (
    evenly_spaced,
    evenly_spaced_to_ends,
    huber_divisor,
    mad_sigma,
    mad_sigmas,
    median,
    median_in_place,
)


def test_the_scale_of_a_normal_distribution_is_its_standard_deviation_and_outliers_hardly_count() -> None:
    draws = np.random.default_rng(0).normal(0, 0.3, 100_001)
    assert mad_sigma(draws) == pytest.approx(0.3, rel=0.01)
    draws[:1000] = 1e6
    assert mad_sigma(draws) == pytest.approx(0.3, rel=0.03)
    assert mad_sigmas(np.stack([draws, 2 * draws])).tolist() == [[mad_sigma(draws)], [mad_sigma(2 * draws)]]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [1, 2, 3, 10, 999, 1000])
def test_the_median_is_numpy_s_to_the_bit(dtype: type[np.floating], count: int) -> None:
    values = np.random.default_rng(count).standard_normal(count).astype(dtype)
    assert median(values) == median_in_place(values.copy()) == float(np.median(values))
    values[count // 2] = np.nan
    assert np.isnan(median(values))


def test_residuals_beyond_the_limit_count_linearly() -> None:
    residuals = np.array([0.0, -0.5, 1.0, -2.0, 10.0])
    np.testing.assert_allclose(huber_divisor(residuals, 1.0), [1, 1, 1, 2, 10])
    assert huber_divisor(residuals.astype(np.float32), np.float32(1)).dtype == np.float32


@given(total=st.integers(1, 1000), share=st.floats(0.001, 1))
def test_even_samples_are_distinct_and_symmetric_parts(total: int, share: float) -> None:
    count = max(1, int(share * total))
    chosen = evenly_spaced(total, count)
    assert len(set(chosen)) == count
    assert chosen == sorted(chosen)
    assert chosen[0] >= 0
    assert chosen[-1] < total
    gaps = np.diff(chosen)
    assert len(gaps) == 0 or gaps.max() - gaps.min() <= 1


@given(total=st.integers(2, 1000), most=st.integers(2, 1100))
def test_even_samples_to_the_ends_are_distinct_and_have_both(total: int, most: int) -> None:
    chosen = evenly_spaced_to_ends(total, most).tolist()
    assert len(set(chosen)) == len(chosen) == min(total, most)
    assert (chosen[0], chosen[-1]) == (0, total - 1)
    gaps = np.diff(chosen)
    assert gaps.max() - gaps.min() <= 1


def test_no_samples_of_nothing() -> None:
    assert evenly_spaced(0, 0) == []
    assert evenly_spaced_to_ends(0, 5).tolist() == []
    assert evenly_spaced_to_ends(1, 5).tolist() == [0]
