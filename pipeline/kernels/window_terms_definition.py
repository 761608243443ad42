"""What the compiled passes of `kernels.window_terms` compute, in numpy, to be read and to test against."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
WINDOW_RADIUS = 5
WINDOW_SIGMA_PX = 1.5
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
"""Of Wang et al. 2004, for colors 0..1."""
STRIP, LANES = 512, 16
"""Values of a row at a time, and partial sums: the order of sums."""


@dataclass(frozen=True)
class SeenWindows:
    """An image that others are compared with, and its windows.

    Attributes:
        image: [h, w, c].
        mean: [h - 10, w - 10, c], `window_means` of it.
        variance: [h - 10, w - 10, c], of its windows.
        weight: [h - 10, w - 10, c], of what is said of a window; None: 1.
    """

    image: Image
    mean: Image
    variance: Image
    weight: Image | None = None


@cache
def half_window() -> Image:
    """Weights [6] of a row of the window, from its end to the middle; those of the whole row sum up to one."""
    ends = [math.exp(-0.5 * ((k - WINDOW_RADIUS) / WINDOW_SIGMA_PX) ** 2) for k in range(WINDOW_RADIUS)]
    return (np.array([*ends, 1.0]) / (2 * sum(ends) + 1)).astype(np.float32)


def window_means(image: Image) -> Image:
    """Gaussian-weighted means [h - 10, w - 10, c] of the 11x11 windows that lie inside an image.

    Args:
        image: [h, w, c].
    """
    return _means_along(_means_along(image, 1), 0)


def window_terms(drawn: Image, seen: SeenWindows) -> tuple[float, float]:
    """Sums over windows of their contrast-structure terms and of SSIM.

    (2 cov + C2) / (vx + vy + C2), and this times (2 mx my + C1) / (mx^2 + my^2 + C1).

    Args:
        drawn: [h, w, c] in 0..1.
        seen: the image that it is compared with.
    """
    drawn_mean, two = window_means(drawn), np.float32(2)
    squared, product = drawn_mean * drawn_mean, drawn_mean * seen.mean
    below = window_means(drawn * drawn) - squared + seen.variance + C2
    structure = (two * (window_means(drawn * seen.image) - product) + C2) / below
    similarity = (two * product + C1) / (squared + seen.mean * seen.mean + C1) * structure
    return _total(structure, seen.weight), _total(similarity, seen.weight)


def _means_along(image: Image, axis: int) -> Image:
    inside = image.shape[axis] - 2 * WINDOW_RADIUS
    at = [np.take(image, range(k, k + inside), axis) for k in range(2 * WINDOW_RADIUS + 1)]
    weights = half_window()
    total = weights[WINDOW_RADIUS] * at[WINDOW_RADIUS]
    for k in reversed(range(WINDOW_RADIUS)):
        total += weights[k] * (at[k] + at[-1 - k])
    return np.asarray(total)


def _total(values: NDArray[np.floating], weight: Image | None) -> float:
    """Sum of the values, each times its weight, in the order of the compiled pass."""
    weighted = (values if weight is None else values * weight).reshape(len(values), -1).astype(np.float64)
    lanes = np.zeros((1, LANES))
    for left in range(0, weighted.shape[1], STRIP):
        strip = weighted[:, left : left + STRIP]
        whole = np.pad(strip, ((0, 0), (0, -strip.shape[1] % LANES)))
        lanes = np.cumsum(np.concatenate([lanes, whole.reshape(-1, LANES)]), axis=0)[-1:]
    return float(np.cumsum(lanes[0])[-1])
