"""Whether an image shows what another shows, block by block.

Two images of one place correlate in most blocks, whatever some large wrong parts do to their mean squared difference;
those of different places, or of one place a few centimeters apart, correlate in few. What counts is what a block shows
besides a slope.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.registration.definition import GRAY_WEIGHTS

BLOCK_PX = 16
LEAST_KNOWN = 0.75  # share of the pixels of a block
LEAST_DEVIATION = 0.02  # of gray values 0..1 from a plane: blocks without texture tell nothing
CORRELATED = 0.5


class CorrelatedBlocks:
    """Counts blocks over pairs of images.

    Attributes:
        blocks: that are compared.
        correlated: of them, those whose gray values correlate.
    """

    def __init__(self) -> None:
        self.blocks = self.correlated = 0

    def add(self, seen: NDArray[np.float32], shown: NDArray[np.float32], where: NDArray[np.bool_]) -> None:
        """Compare two images.

        Args:
            seen: colors 0..1, [h, w, 3]; those that must vary.
            shown: likewise.
            where: pixels [h, w] that are compared.
        """
        known = where.astype(np.float64)
        count = _sums(known)
        a, b = (
            _without_plane((image @ GRAY_WEIGHTS).astype(np.float64), known, count) for image in (seen, shown)
        )
        n = np.maximum(count, 1.0)
        variance_a, variance_b, covariance = _sums(a * a) / n, _sums(b * b) / n, _sums(a * b) / n
        compared = (count >= LEAST_KNOWN * BLOCK_PX**2) & (variance_a > LEAST_DEVIATION**2)
        alike = covariance > CORRELATED * np.sqrt(variance_a * variance_b)
        self.blocks += int(np.sum(compared))
        self.correlated += int(np.sum(compared & alike))

    @property
    def share(self) -> float:
        """Of the blocks, the share that correlates."""
        return self.correlated / max(self.blocks, 1)


def _without_plane(gray: Array, known: Array, count: Array) -> Array:
    """Gray values less mean and slope of their block, 0 where unknown: two slopes correlate by chance."""
    ramp = (np.arange(BLOCK_PX) - (BLOCK_PX - 1) / 2) / BLOCK_PX
    rows, columns = count.shape
    across, down = np.tile(ramp, columns), np.tile(ramp, rows)[:, None]
    cut, known = gray[: len(down), : len(across)], known[: len(down), : len(across)]
    left = (cut - _spread(_sums(cut * known) / np.maximum(count, 1.0))) * known
    for slope in (across, down):
        left -= _spread(_sums(left * slope) / (BLOCK_PX * np.sum(ramp**2))) * slope * known
    return left


def _spread(values: Array) -> Array:
    """An image that has in every block the value of the block."""
    return np.asarray(np.repeat(np.repeat(values, BLOCK_PX, axis=0), BLOCK_PX, axis=1))


def _sums(image: Array) -> Array:
    """Sums over blocks; what is left at the right and at the bottom is not in one."""
    rows, columns = (size // BLOCK_PX for size in image.shape)
    cut = image[: rows * BLOCK_PX, : columns * BLOCK_PX]
    return np.asarray(cut.reshape(rows, BLOCK_PX, columns, BLOCK_PX).sum(axis=(1, 3)))
