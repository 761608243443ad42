"""Scattered holes of depth: single unknown pixels between known ones of one surface, which interpolation fills.

One unknown pixel takes the normals of its neighbors, and every value between them. Depth that was registered to a finer
image without filling, or of which a sensor leaves pixels out, would have none. Larger holes stay: nothing is
extrapolated.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry import masks

Image: TypeAlias = NDArray[np.float32]

LEAST_WHOLE = 0.7
"""Share of the known pixels with eight known neighbors below which holes are scattered: dense depth has 0.95 and more,
with holes of many pixels in half of the image 0.8; with every twentieth pixel missing 0.66."""
ROUNDS = 5
SAME_SURFACE = np.float32(0.05)  # relative difference of depth up to which neighbors count as one surface


def without_scattered_holes(inverse_depth: Image, mask: masks.Mask | None) -> Image:
    """The inverse depth with scattered holes filled; itself where holes are not scattered.

    An unknown pixel takes the mean over its pairs of opposite neighbors that are known and of one surface, which is
    exact on planes. Pixels that were filled count as known in the next round.

    Args:
        inverse_depth: [h, w], 1/m, 0 where unknown.
        mask: bool [h, w], pixels that may be used; None: all.
    """
    if not holes_are_scattered(inverse_depth):
        return inverse_depth
    filled = inverse_depth.copy()
    values, width = filled.reshape(-1), filled.shape[1]
    holes = np.zeros(filled.shape, dtype=bool)
    holes[1:-1, 1:-1] = filled[1:-1, 1:-1] == 0
    left = np.flatnonzero(holes if mask is None else holes & mask)
    for _ in range(ROUNDS):
        found = _between(values, left, width)
        values[left] = found
        left = left[found == 0]
    return filled


def holes_are_scattered(inverse_depth: Image) -> bool:
    """Whether few of the known pixels of an image have only known neighbors.

    Args:
        inverse_depth: [h, w], 1/m, 0 where unknown.
    """
    import cv2

    known = (inverse_depth > 0).view(np.uint8)
    whole = cv2.erode(known, np.ones((3, 3), np.uint8))[1:-1, 1:-1]
    return bool(np.count_nonzero(whole) < LEAST_WHOLE * np.count_nonzero(known[1:-1, 1:-1]))


def _between(values: NDArray[np.float32], at: NDArray[np.intp], width: int) -> NDArray[np.float32]:
    """Values between opposite neighbors of some pixels, in the order of sums that every machine has; 0: none.

    Args:
        values: of the image, row by row.
        at: places of the pixels, none at the border.
        width: of the image.
    """
    total, count = np.zeros(len(at), dtype=np.float32), np.zeros(len(at), dtype=np.float32)
    for step in (1, width - 1, width, width + 1):
        a, b = values[at - step], values[at + step]
        low, high = np.minimum(a, b), np.maximum(a, b)
        same = (low > 0) & (high - low < SAME_SURFACE * high)
        total += np.where(same, a + b, np.float32(0))
        count += same
    return np.where(count > 0, np.float32(0.5) * total / np.maximum(count, np.float32(1)), np.float32(0))
