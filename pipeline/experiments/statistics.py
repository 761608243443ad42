"""Statistics of paired differences, one for each seed: tests against a margin, intervals, a family of claims.

Five seeds are few. The least p value that the exact sign-flip test can give to n differences is 2^-n, and the interval
of the bootstrap is too narrow for so few: it is shown, and decides nothing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 9999
MOST_EXACT = 20
"""Differences up to which all signs are tried; more would take more than a million patterns."""


def t_test_p(gaps: Sequence[float], margin: float) -> float:
    """One-sided p value of Student's paired t test that the mean difference is not above a margin.

    Args:
        gaps: differences, at least two.
        margin: that the mean must exceed.
    """
    from scipy import stats

    values = np.asarray(gaps, dtype=np.float64)
    if _all_equal(values):  # the test has no spread to divide by; its limit is a step
        return 0.0 if values[0] > margin else 1.0
    return float(stats.ttest_1samp(values, margin, alternative="greater").pvalue)


def sign_flip_p(gaps: Sequence[float], margin: float) -> float:
    """One-sided p value of the exact permutation test of the same: every difference may change its sign.

    It assumes that the differences lie symmetrically about their mean, and no other shape.

    Args:
        gaps: differences, at most `MOST_EXACT`.
        margin: that the mean must exceed.
    """
    above = np.asarray(gaps, dtype=np.float64) - margin
    if not 0 < len(above) <= MOST_EXACT:
        raise ValueError(f"{len(above)} differences, expected 1 to {MOST_EXACT}")
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=len(above))))
    sums = signs @ above
    slack = 1e-12 * float(np.abs(above).sum())  # sums of the same numbers in another order differ by rounding
    return float(np.mean(sums >= above.sum() - slack))


def least_sign_flip_p(pairs: int) -> float:
    """The least p value that the one-sided sign-flip test can give.

    Args:
        pairs: number of differences.
    """
    return 2.0**-pairs


def bca_interval(
    gaps: Sequence[float], stream: np.random.Generator, confidence: float = 0.95
) -> tuple[float, float]:
    """Bias-corrected and accelerated bootstrap interval of the mean difference.

    Args:
        gaps: differences, at least two.
        stream: random stream of the resamples.
        confidence: of the interval.
    """
    from scipy import stats

    values = np.asarray(gaps, dtype=np.float64)
    if _all_equal(values):
        return float(values[0]), float(values[0])
    found = stats.bootstrap(
        (values,),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=confidence,
        method="BCa",
        rng=stream,
    ).confidence_interval
    return float(found.low), float(found.high)


def two_one_sided_p(gaps: Sequence[float], margin: float) -> float:
    """p value of equivalence by two one-sided t tests (Schuirmann 1987): the mean lies within +- margin.

    Args:
        gaps: differences, at least two.
        margin: half the width of what counts as equal.
    """
    return max(t_test_p(gaps, -margin), t_test_p([-gap for gap in gaps], -margin))


def holm(p_values: Sequence[float]) -> list[float]:
    """p values of a family of claims, adjusted by Holm (1979): together they err with the level of one.

    Args:
        p_values: one for each claim.
    """
    order = sorted(range(len(p_values)), key=lambda k: p_values[k])
    adjusted, least = [0.0] * len(p_values), 0.0
    for rank, k in enumerate(order):
        least = max(least, min(1.0, (len(p_values) - rank) * p_values[k]))
        adjusted[k] = least
    return adjusted


def mean(values: Sequence[float]) -> float:
    """Mean, the same for every order of the values.

    Args:
        values: at least one.
    """
    return math.fsum(values) / len(values)


def _all_equal(values: NDArray[np.float64]) -> bool:
    return bool(np.ptp(values) <= 1e-12 * np.max(np.abs(values)))
