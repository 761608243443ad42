"""Inverse depth, and depth by it: 0 stands for unknown in both."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry.statistics import mad_sigma, median

CHANCE_SIGMAS = 4.0  # by which two depths of one surface differ at most


def inverse_or_zero(values: NDArray[Any]) -> NDArray[Any]:
    """One over each value, 0 where it is unknown; of the same type.

    Args:
        values: of any shape, floats; 0 or less = unknown.
    """
    known, one = values > 0, values.dtype.type(1)
    return np.where(known, one / np.where(known, values, one), values.dtype.type(0))


def inverse_depth_sigma(
    inverse_depth: NDArray[Any], sigma_m: NDArray[Any] | None = None, *, stride: int = 1
) -> float:
    """Standard deviation of the inverse depth of the farther half of the known pixels, 1/m; 0 where too few are known.

    By its second differences along rows and columns, which are 0 on planes, or as stated, whichever is larger. It is
    the farther half where noise is more than a few percent of the depth: by stereo it is the same in inverse depth
    everywhere, of a time-of-flight camera it falls there.

    Args:
        inverse_depth: [h, w], 1/m, 0 = unknown.
        sigma_m: [h, w], standard deviation of the depth where it is known, meters; None: not stated.
        stride: pixels from one row, and from one column, along which differences are taken to the next.
    """
    sampled = inverse_depth[::stride, ::stride]
    known = sampled[sampled > 0]
    if not len(known):
        return 0.0
    half = median(known)
    lines = inverse_depth[::stride], np.ascontiguousarray(inverse_depth[:, ::stride].T)
    differences = np.concatenate([_second_differences(each, half) for each in lines])
    noise = mad_sigma(differences) / np.sqrt(6) if len(differences) else 0.0
    if sigma_m is None:
        return float(noise)
    far = (inverse_depth > 0) & (inverse_depth <= half)
    return float(max(noise, median((sigma_m * np.square(inverse_depth))[far])))


def _second_differences(inverse_depth: NDArray[Any], half: float) -> NDArray[Any]:
    """Second differences [n] along rows, around pixels at most this near (1/m) that have known neighbors."""
    before, at, after = inverse_depth[:, :-2], inverse_depth[:, 1:-1], inverse_depth[:, 2:]
    usable = (at > 0) & (at <= half) & (before > 0) & (after > 0)
    return np.asarray((before - 2 * at + after)[usable])


def chance_difference(*inverse_depth_sigmas: float) -> float:
    """By how much inverse depths of one surface differ at most by their noise, 1/m.

    Args:
        inverse_depth_sigmas: standard deviation of each, 1/m.
    """
    return CHANCE_SIGMAS * float(np.sqrt(sum(sigma * sigma for sigma in inverse_depth_sigmas)))
