"""How well the predicted uncertainty of Gaussians fits their errors (docs/reference/metrics.md, "Calibration").

Every function takes one value per Gaussian: `sigma_m`, the predicted standard deviation of the error, and `error_m`,
what was measured. Ties are broken by position in the array, so that the result depends on the input alone.
"""

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array

BINS = 10
Z_95 = 1.959963984540054


def spearman(sigma_m: Array, error_m: Array) -> float:
    """Rank correlation of predicted uncertainty and error, -1..1; 1 if the uncertainty orders the errors perfectly.

    Args:
        sigma_m: predicted standard deviations [n], meters.
        error_m: measured errors [n], meters.
    """
    a, b = _mean_ranks(sigma_m), _mean_ranks(error_m)
    a, b = a - a.mean(), b - b.mean()
    scale = np.sqrt(np.sum(a * a) * np.sum(b * b))
    return float(np.sum(a * b) / scale) if scale > 0 else 0.0


def ause(sigma_m: Array, error_m: Array) -> float:
    """Area under the sparsification error (Ilg et al. 2018), no unit; 0 if the uncertainty orders the errors perfectly.

    Take away the most uncertain share of the Gaussians and look at the mean error of the rest, relative to the mean
    error of all; the area between that curve and the one that takes away the largest errors first.

    Args:
        sigma_m: predicted standard deviations [n], meters.
        error_m: absolute errors [n], meters.
    """
    mean = error_m.mean()
    if mean == 0:
        return 0.0
    by_sigma = _mean_of_remaining(error_m[np.argsort(sigma_m, kind="stable")])
    by_error = _mean_of_remaining(np.sort(error_m))
    return float(np.mean(by_sigma - by_error) / mean)


def _mean_of_remaining(error_sorted_m: Array) -> Array:
    """Mean of the first n(1 - k/100) errors, k = 0..99: what is left when the last k percent are taken away."""
    sums = np.cumsum(error_sorted_m)
    kept = np.maximum(1, -(-len(error_sorted_m) * (100 - np.arange(100)) // 100))  # rounded up
    return sums[kept - 1] / kept


def nll(sigma_m: Array, error_m: Array) -> float:
    """Mean negative log-likelihood of the errors under N(0, sigma^2), in nats, errors in meters; lower is better.

    Args:
        sigma_m: predicted standard deviations [n] > 0, meters.
        error_m: measured errors [n], meters.
    """
    return float(np.mean(0.5 * np.log(2.0 * np.pi * sigma_m**2) + 0.5 * (error_m / sigma_m) ** 2))


def coverage_95(sigma_m: Array, error_m: Array) -> float:
    """Share of errors within 1.96 predicted standard deviations; 0.95 if the prediction is right.

    Args:
        sigma_m: predicted standard deviations [n], meters.
        error_m: measured errors [n], meters.
    """
    return float(np.mean(np.abs(error_m) <= Z_95 * sigma_m))


def fitted_scale(sigma_m: Array, error_m: Array) -> float:
    """The factor s on sigma with the greatest likelihood: the root mean square of error / sigma; 1 if well scaled.

    Args:
        sigma_m: predicted standard deviations [n] > 0, meters.
        error_m: measured errors [n], meters.
    """
    return float(np.sqrt(np.mean((error_m / sigma_m) ** 2)))


def ece_rank(sigma_m: Array, error_m: Array) -> float:
    """Ten bins of equal count by predicted uncertainty; mean |mean uncertainty rank - mean error rank|, ranks 0..1.

    0 if the order is right, 0.25 if the uncertainty says nothing; what right ones reach: `if_right`.

    Args:
        sigma_m: predicted standard deviations [n], meters.
        error_m: absolute errors [n], meters.
    """
    n = len(sigma_m)
    order = np.argsort(sigma_m, kind="stable")
    error_rank = (_mean_ranks(error_m)[order] + 0.5) / n
    sigma_rank = (np.arange(n) + 0.5) / n
    gaps = [abs(float(np.mean(sigma_rank[b]) - np.mean(error_rank[b]))) for b in _equal_count_bins(n)]
    return float(np.mean(gaps))


def shuffled(sigma_m: Array, name: str) -> Array:
    """The same uncertainties dealt out at random (seed 0): what a metric says when there is no information.

    Args:
        sigma_m: predicted standard deviations [n], meters.
        name: of the random stream.
    """
    return random_streams.generator(0, "calibration-shuffle", of=name).permutation(sigma_m)


def if_right(sigma_m: Array, name: str) -> Array:
    """Errors that the uncertainties themselves would make, were they exactly right (seed 0): what a metric can reach.

    An error is drawn once, so that even right uncertainties order errors only as far as they differ from each other.

    Args:
        sigma_m: predicted standard deviations [n].
        name: of the random stream.
    """
    draws = random_streams.generator(0, "calibration-right", of=name).standard_normal(len(sigma_m))
    return np.asarray(np.abs(draws) * sigma_m)


def ece_paper(uncertainty: Array, error_m: Array) -> float:
    """The paper's companion code, for comparison only: both min-max scaled to 0..1, ten bins of equal width,
    count-weighted |mean error - mean uncertainty|.

    It does not measure calibration: on heavy-tailed values that know nothing of each other it is near zero, too.

    Args:
        uncertainty: predicted [n], in any unit.
        error_m: absolute errors [n], meters.
    """
    u, e = _min_max(uncertainty), _min_max(error_m)
    bins = np.minimum((u * BINS).astype(np.int64), BINS - 1)
    total = 0.0
    for b in range(BINS):
        inside = bins == b
        if inside.any():
            total += np.count_nonzero(inside) * abs(float(e[inside].mean() - u[inside].mean()))
    return total / len(u)


def reliability(sigma_m: Array, error_m: Array) -> list[tuple[float, float]]:
    """(predicted, observed) root mean square error in meters of ten bins of equal count by predicted uncertainty.

    Args:
        sigma_m: predicted standard deviations [n], meters.
        error_m: measured errors [n], meters.
    """
    order = np.argsort(sigma_m, kind="stable")
    rms = [
        (float(np.sqrt(np.mean(sigma_m[order[b]] ** 2))), float(np.sqrt(np.mean(error_m[order[b]] ** 2))))
        for b in _equal_count_bins(len(order))
    ]
    return rms


def _equal_count_bins(n: int) -> list[slice]:
    edges = [n * b // BINS for b in range(BINS + 1)]
    return [slice(lo, hi) for lo, hi in pairwise(edges) if hi > lo]


def _mean_ranks(values: NDArray[Any]) -> Array:
    """Rank of every value from 0; equal values share their mean rank."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts) - 1
    return (last - (counts - 1) / 2.0)[inverse]


def _min_max(values: Array) -> Array:
    span = values.max() - values.min()
    return (values - values.min()) / span if span > 0 else np.zeros_like(values)
