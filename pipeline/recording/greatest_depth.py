"""Depth that is exactly the greatest of a sensor: what some give where they measure nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

APART = 0.1
"""Relative step below the greatest depth from which no surface leads to it."""
STEPS_APART = 10
"""Times the usual step between depths of a sensor that counts in coarse ones, likewise."""
PILED = 10
"""Times as many pixels as any other of the farther depths has, where surfaces lead up to the greatest."""
LEAST_CHANGED = 0.5
"""Of the other depth between the first image and the last: a wall that a standing camera faces has one depth, too."""
LEAST_SHARE = 0.005
"""Of the known depth of each image that this distance has."""
SATURATED = 65535
"""The largest number of a 16-bit depth image: whatever its unit, it is no distance."""


def without_saturated(image: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """A depth image with 0, unknown, where it has the largest number.

    Args:
        image: [h, w], units of depth.
    """
    return np.where(image == SATURATED, np.uint16(0), image)


def units_of_depth(depth_m: NDArray[np.floating], unit_m: float) -> tuple[NDArray[np.uint16], int]:
    """A depth image as a recording holds it.

    Args:
        depth_m: [h, w], meters, 0 = unknown.
        unit_m: meters per unit.

    Returns:
        [h, w] in units, 0 also where it is farther than 16 bits can say, and how many pixels that are.
    """
    units = np.rint(depth_m / unit_m)
    return np.where(units < SATURATED, units, 0).astype(np.uint16), int(np.count_nonzero(units >= SATURATED))


def unmeasured(images: Sequence[NDArray[Any]]) -> tuple[float, float]:
    """The distance that a sensor gives where it measures nothing, and its share of the depth; zeros: it gives none.

    Args:
        images: depth of some images, 0 where it is unknown.
    """
    known = [image[image > 0] for image in images if (image > 0).any()]
    if not known:
        return 0.0, 0.0
    together = np.concatenate(known)
    greatest = greatest_apart(together)
    if not greatest and (piled := greatest_piled(together)):
        greatest = piled if _others_change(images[0], images[-1], piled) else 0.0
    shares = [float(np.mean(depth == greatest)) for depth in known]
    if not greatest or min(shares) < LEAST_SHARE:
        return 0.0, 0.0
    return greatest, float(np.mean(shares))


def greatest_apart(depth: NDArray[Any]) -> float:
    """The greatest depth, if it comes more than once and no other comes near it; else 0.

    Args:
        depth: known depths of some images together, positive.
    """
    values, counts = np.unique(depth, return_counts=True)
    if len(values) < 3 or counts[-1] < 2:
        return 0.0
    steps = np.diff(np.log(values.astype(np.float64)))
    upper = values[:-2] >= values[-2] / 2
    usual = float(np.median(steps[:-1][upper])) if upper.any() else APART
    return float(values[-1]) if steps[-1] > max(APART, STEPS_APART * usual) else 0.0


def greatest_piled(depth: NDArray[Any]) -> float:
    """The greatest depth, if far more pixels have it than have any other in the farther half of the range; else 0.

    What is beyond the range of a sensor may be given its end: surfaces lead up to it, but none lies at one number of a
    sensor in the images of a camera that moves.

    Args:
        depth: known depths of some images together, positive.
    """
    values, counts = np.unique(depth, return_counts=True)
    others = counts[:-1][values[:-1] >= values[-1] / 2]
    return float(values[-1]) if len(others) > 1 and counts[-1] > PILED * others.max() else 0.0


def _others_change(first: NDArray[Any], last: NDArray[Any], greatest: float) -> bool:
    """Whether most of the depth of two images that is not the greatest changes between them."""
    both = (first > 0) & (last > 0) & (first != greatest) & (last != greatest)
    return bool(both.any()) and float(np.mean(first[both] != last[both])) > LEAST_CHANGED
