"""Robust scales and weights, and samples that are spread evenly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAD_TO_SIGMA = 1.4826  # median absolute deviation to standard deviation, of a normal distribution
CHI2_6_MEDIAN = 5.348  # of chi^2 with 6 degrees of freedom


def mad_sigma(deviations: NDArray[np.floating]) -> float:
    """Robust standard deviation of numbers: 1.4826 times the median absolute deviation.

    Args:
        deviations: from the center, of any sign, any shape.
    """
    return MAD_TO_SIGMA * median_in_place(np.abs(deviations).ravel())


def median(values: NDArray[np.floating]) -> float:
    """`np.median` of all values, to the bit, without what that function spends on axes and other types.

    Args:
        values: any shape, at least one value.
    """
    return median_in_place(values.flatten())


def median_in_place(values: NDArray[np.floating]) -> float:
    """The same of numbers that are needed no more: no second copy of them is made.

    Args:
        values: [n], at least one; left in another order.
    """
    middle, odd = divmod(values.size, 2)
    values.partition(middle)  # one place: several take five times as long
    above = values[middle:]
    if np.isnan(above.max()):  # NaN is the largest
        return float("nan")
    return float(above[0] if odd else (values[:middle].max() + above[0]) / values.dtype.type(2))


def mad_sigmas(deviations: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same of every row, [c, 1].

    Args:
        deviations: [c, n], from the center of each row.
    """
    return np.asarray(MAD_TO_SIGMA * np.median(np.abs(deviations), axis=1, keepdims=True))


def huber_divisor(
    residuals: NDArray[np.floating], limit: float | np.float32 | NDArray[np.floating]
) -> NDArray[np.floating]:
    """Divisor >= 1 of least-squares weights that makes residuals beyond a limit count linearly (Huber 1964).

    Args:
        residuals: of any sign.
        limit: in the unit of the residuals; one for all, or one each.
    """
    return np.maximum(residuals.dtype.type(1), np.abs(residuals) / limit)


def evenly_spaced(total: int, count: int) -> list[int]:
    """The middles of `count` equal parts of 0 .. total - 1, ascending.

    Args:
        total: number of things to choose from.
        count: number of things chosen.
    """
    return [(2 * k + 1) * total // (2 * count) for k in range(count)]


def evenly_spaced_to_ends(total: int, most: int) -> NDArray[np.int64]:
    """At most so many of 0 .. total - 1, ascending, the first and the last among them.

    Args:
        total: number of things to choose from.
        most: number of things chosen, if there are so many; two or more.
    """
    return np.unique(np.linspace(0, total - 1, min(total, most)).round().astype(np.int64))
