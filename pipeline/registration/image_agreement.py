"""Whether two views that registration laid onto each other also look alike: where both have texture, does it match?

One poster that hangs in two rooms has features enough for a motion, and flat walls fit flat walls. What is around it
distinguishes the rooms. Gray values are compared part by part of the image, so that light and exposure do not count.
"""

from __future__ import annotations

from dataclasses import dataclass

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
NEAR_PX = 5  # side of the squares within which light hardly differs, at the next to coarsest level


@dataclass(frozen=True)
class TexturedParts:
    """Parts of an image that show a texture, in it or in another view that it was laid onto.

    Attributes:
        centers: [p, 3], of what they show, meters, in the frame of the other view.
        samples: int [p], how many of the other view they hold.
        alike: bool [p], whether both views look alike there.
    """

    centers: Array
    samples: NDArray[np.int64]
    alike: NDArray[np.bool_]

    @property
    def share_alike(self) -> float:
        """Share of the samples in parts that look alike; 1 where too little texture is seen by both to decide."""
        if len(self.samples) < MIN_PARTS:
            return 1.0
        return float(self.samples[self.alike].sum() / self.samples.sum())


def textured_parts(reference: Reference, target: RgbdPyramid, T_reference_target: Array) -> TexturedParts:
    """The parts of the target's image that show texture, and whether it looks alike in both views.

    Args:
        reference: samples of one view.
        target: the other view.
        T_reference_target: [4, 4], where registration has the target.
    """
    index = len(target.levels) - 1
    level, samples = target.levels[index], reference.levels[index]
    at, seen, row, column = _shared(reference, target, T_reference_target, index)
    given, points = samples.intensities[at].astype(np.float64), samples.points[at].astype(np.float64)
    rows, columns = PARTS
    part = (row * rows // level.camera.height) * columns + column * columns // level.camera.width
    count = np.bincount(part, minlength=rows * columns)
    some = np.maximum(count, 1)

    def mean(values: Array) -> Array:
        return np.bincount(part, values, minlength=len(count)) / some

    a, b = given - mean(given)[part], seen - mean(seen)[part]
    deviations = np.sqrt(mean(a * a)), np.sqrt(mean(b * b))
    textured = (count >= MIN_SAMPLES) & (np.maximum(*deviations) >= MIN_CONTRAST)
    correlation = mean(a * b) / (deviations[0] * deviations[1] + NOISE**2)
    centers = np.stack([mean(axis) for axis in points.T], axis=1)
    return TexturedParts(centers[textured], count[textured], correlation[textured] > MIN_CORRELATION)


def same_under_other_light(
    reference: Reference, target: RgbdPyramid, T_reference_target: Array, *, min_samples: int
) -> bool:
    """Whether what both views show differs from place to place alike, however light and noise are.

    Under a lamp on the camera, or where the image is dark, one gain does not relate two views: the lamp's pattern moves
    with the camera, and noise of the reference makes the gain too small. The correlation of gray values less their
    means over small squares keeps the texture. A covered lens has none, and that of another place does not correlate.

    Args:
        reference: samples of one view.
        target: the other view.
        T_reference_target: [4, 4], where registration has the target.
        min_samples: fewer that both see decide against it.
    """
    index = max(len(target.levels) - 2, 0)
    at, seen, row, column = _shared(reference, target, T_reference_target, index)
    if len(at) < min_samples:
        return False
    given = reference.levels[index].intensities[at].astype(np.float64)
    columns = target.levels[index].camera.width // NEAR_PX + 1
    part = (row // NEAR_PX) * columns + column // NEAR_PX
    count = np.maximum(np.bincount(part), 1)
    a, b = (values - (np.bincount(part, values) / count)[part] for values in (given, seen))
    return bool(a @ b >= MIN_CORRELATION * np.sqrt((a @ a) * (b @ b)) > 0)


def _shared(
    reference: Reference, target: RgbdPyramid, T_reference_target: Array, index: int
) -> tuple[NDArray[np.int64], Array, NDArray[np.int64], NDArray[np.int64]]:
    """Samples [n] that a target sees on the same surface, its gray values there, and rows and columns."""
    level, samples = target.levels[index], reference.levels[index]
    points = se3.transform(se3.inverse(T_reference_target), samples.points.astype(np.float64))
    seen, column, row = visible(level.camera, points, margin_px=1)
    inverse = level.usable_inverse_depth[row, column].astype(np.float64)
    same = inverse > 0
    if level.has_depth:
        same &= np.abs(points[seen, 2] * inverse - 1) < SAME_SURFACE
    seen, column, row = seen[same], column[same], row[same]
    gray = bilinear(level.gray, *level.camera.project(points[seen]).T).astype(np.float64)
    return seen, gray, row, column
