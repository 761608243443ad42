"""Whether two views that registration laid onto each other also look alike: where both have texture, does it match?

One poster that hangs in two rooms has features enough for a motion, and flat walls fit flat walls. What is around it
distinguishes the rooms. Gray values are compared part by part of the image, so that light and exposure do not count.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.projection import SAME_SURFACE, visible
from duagc.pipeline.registration.pyramid import RgbdPyramid
from duagc.pipeline.registration.reference import Reference, bilinear

PARTS = (6, 8)  # rows and columns of parts of the image
MIN_SAMPLES = 12  # of a part
MIN_CONTRAST = 0.04  # standard deviation of gray values (0..1) in either view from which a part has texture
MIN_CORRELATION = 0.5  # of a part that looks alike
MIN_PARTS = 4  # with texture; fewer decide nothing
NOISE = 0.01  # of gray values at the coarsest level


def share_alike(reference: Reference, target: RgbdPyramid, T_reference_target: Array) -> float:
    """Share of the samples in textured parts of the target's image whose parts look alike in both views.

    Args:
        reference: samples of one view.
        target: the other view.
        T_reference_target: [4, 4], where registration has the target.

    Returns:
        0 to 1; 1 where too little texture is seen by both to decide.
    """
    level, samples = target.levels[-1], reference.levels[len(target.levels) - 1]
    points = se3.transform(se3.inverse(T_reference_target), samples.points.astype(np.float64))
    index, column, row = visible(level.camera, points, margin_px=1)
    inverse = level.usable_inverse_depth[row, column].astype(np.float64)
    same = inverse > 0
    if level.has_depth:
        same &= np.abs(points[index, 2] * inverse - 1) < SAME_SURFACE
    index, column, row = index[same], column[same], row[same]
    seen = bilinear(level.gray, *level.camera.project(points[index]).T).astype(np.float64)
    given = samples.intensities[index].astype(np.float64)
    rows, columns = PARTS
    part = (row * rows // level.camera.height) * columns + column * columns // level.camera.width
    return _share(part, given, seen)


def _share(part: NDArray[np.int64], given: Array, seen: Array) -> float:
    """Share of the samples of textured parts that correlate, by the part [n] of each and its gray values [n]."""
    count = np.bincount(part, minlength=PARTS[0] * PARTS[1])
    some = np.maximum(count, 1)

    def mean(values: Array) -> Array:
        return np.bincount(part, values, minlength=len(count)) / some

    a, b = given - mean(given)[part], seen - mean(seen)[part]
    deviations = np.sqrt(mean(a * a)), np.sqrt(mean(b * b))
    textured = (count >= MIN_SAMPLES) & (np.maximum(*deviations) >= MIN_CONTRAST)
    if np.count_nonzero(textured) < MIN_PARTS:
        return 1.0
    correlation = mean(a * b) / (deviations[0] * deviations[1] + NOISE**2)
    return float(count[textured & (correlation > MIN_CORRELATION)].sum() / count[textured].sum())
