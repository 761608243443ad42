"""Depth of sensors that measure disparity in coarse steps, as a surface instead of a staircase.

A disparity sensor measures inverse depth in equal steps. Across a slanted surface the depth image has plateaus: normals
point at the camera, and the edges between plateaus are where none are. A plane has an inverse depth that is linear in
the image, so between the edges of the plateaus, which lie where the surface is, it is interpolated. No pixel moves by
more than half a step: what was measured stays measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]

COARSE_PER_M = 5e-3
"""Steps of inverse depth from which depth is smoothed: 20 mm at 2 m. Of a first Kinect, 0.0029, noise exceeds them."""
RADII_PX = (32, 32, 16, 16, 8, 8, 4, 4, 2, 2, 1, 1)
SAME_SURFACE_STEPS = 1.3
"""Difference of neighboring pixels, in steps, up to which they are one surface."""
LEAST_UNITS = 3
"""Steps, in units of the image, from which they differ from its rounding."""
LEAST_GAPS = 8
ON_LATTICE = 0.2
"""Distance of a gap between two values from a whole number of steps, in steps, up to which it is one."""
MOST_OFF = 0.1
"""Share of gaps that may be none."""


def inverse_step_per_m(depths_m: Sequence[Image], unit_m: float) -> float:
    """The step of inverse depth, 1/m, in which a sensor measures; 0 where it shows none.

    Args:
        depths_m: [h, w] each, meters, 0 = unknown: some images of it.
        unit_m: meters per unit of the images.
    """
    units = [np.rint(depth[depth > 0] / np.float32(unit_m)).astype(np.int64) for depth in depths_m]
    values = unit_m * np.flatnonzero(np.bincount(np.concatenate([np.zeros(0, np.int64), *units])))
    if len(values) <= LEAST_GAPS:
        return 0.0
    gaps_m, inverse_gaps = np.diff(values), -np.diff(1 / values)
    inverse_gaps = inverse_gaps[gaps_m >= LEAST_UNITS * unit_m]
    if len(inverse_gaps) < max(LEAST_GAPS, len(gaps_m) // 2):
        return 0.0
    step = float(np.percentile(inverse_gaps, 25))
    step = float(np.median(inverse_gaps / np.maximum(np.rint(inverse_gaps / step), 1.0)))
    off = np.abs(inverse_gaps / step - np.rint(inverse_gaps / step)) > ON_LATTICE
    return 0.0 if off.mean() > MOST_OFF else step


def without_steps(depth_m: Image, step_per_m: float) -> Image:
    """Depth [h, w] with its plateaus made one surface.

    From far to near neighbors, every pixel becomes the mean of pairs on both sides of it, in its row and its column, as
    long as no edge of a surface lies between them; a plane stays as it is.

    Args:
        depth_m: [h, w], meters, 0 = unknown.
        step_per_m: of inverse depth.
    """
    known = depth_m > 0
    measured = np.zeros_like(depth_m)
    np.divide(np.float32(1), depth_m, out=measured, where=known)
    step = np.float32(step_per_m)
    low, high = measured - step / 2, measured + step / 2
    reaches = [_reach_px(measured, known, step, axis) for axis in (0, 1)]
    inverse = measured.copy()
    for radius in RADII_PX:
        total, pairs = np.zeros_like(inverse), np.zeros_like(inverse)
        for axis in (0, 1):
            if inverse.shape[axis] <= 2 * radius:
                continue
            along, inner = np.moveaxis(inverse, axis, 0), slice(radius, -radius)
            both = np.moveaxis(reaches[axis], axis, 0)[inner] >= radius
            mean = np.float32(0.5) * (along[2 * radius :] + along[: -2 * radius])
            np.moveaxis(total, axis, 0)[inner] += np.where(both, mean, np.float32(0))
            np.moveaxis(pairs, axis, 0)[inner] += both
        np.divide(total, pairs, out=inverse, where=pairs > 0)
        np.clip(inverse, low, high, out=inverse)
    out = np.zeros_like(depth_m)
    np.divide(np.float32(1), inverse, out=out, where=known & (inverse > 0))
    return out


def _reach_px(measured: Image, known: NDArray[np.bool_], step: np.float32, axis: int) -> NDArray[np.int32]:
    """How far [h, w] the surface of a pixel goes on in both directions of an axis; -1 where nothing is known."""
    values, there = np.moveaxis(measured, axis, 0), np.moveaxis(known, axis, 0)
    count = len(values)
    joined = np.abs(np.diff(values, axis=0)) <= np.float32(SAME_SURFACE_STEPS) * step
    joined &= there[1:] & there[:-1]
    position = np.arange(count, dtype=np.int32)[:, None]
    first = np.zeros(values.shape, np.int32)
    first[1:] = np.where(joined, 0, position[1:])
    last = np.full(values.shape, count - 1, np.int32)
    last[:-1] = np.where(joined, count - 1, position[:-1])
    first = np.maximum.accumulate(first, axis=0)
    last = np.minimum.accumulate(last[::-1], axis=0)[::-1]
    reach = np.minimum(position - first, last - position)
    return np.moveaxis(np.where(there, reach, -1), 0, axis)
