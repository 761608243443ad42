"""What is drawn over all images of a camera: text, a logo, a cross; or dirt on its lens."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.own_body import MOVED
from duagc.pipeline.geometry.masks import Mask

STEP = 20  # of 255, from a pixel to the next: an edge
OFTEN = 0.8
"""Share of the images in which a pixel has the same edge.

Drawn text has it in nearly all. Of six recordings of moving cameras no pixel has it in 0.7 of the images, and at most
3 of 10,000 in half of them.
"""
LEAST_IMAGES = 8  # that are compared
CLOSE_PX = 8  # gaps between edges that are closed: within a letter, and between letters
GROW_PX = 4  # compression smears edges
LEAST_PIXELS = 8  # of such edges, within `CLOSE_PX` of each other


class ConstantEdges:
    """Finds edges that stay where they are in the images while the camera moves, and what they enclose.

    So do the edges of a corridor that a robot drives along; but there, depth stays, too.
    """

    def __init__(self) -> None:
        """No image yet."""
        self._often: NDArray[np.uint16] | None = None  # images with a step up or down to the pixel, in x or y
        self._images = 0

    def add(self, value: NDArray[np.uint8]) -> None:
        """Take an image of the recording.

        Args:
            value: [h, w], brightest of the three colors; all of one size, others are left out.
        """
        import cv2

        if self._often is None:
            self._often = np.zeros((4, *value.shape), dtype=np.uint16)
        if value.shape != self._often.shape[1:] or self._images == np.iinfo(np.uint16).max:
            return
        self._images += 1
        right, left, lower, upper = value[:, 1:], value[:, :-1], value[1:], value[:-1]
        for count, high, low in (
            (self._often[0, :, 1:], right, left),
            (self._often[1, :, 1:], left, right),
            (self._often[2, 1:], lower, upper),
            (self._often[3, 1:], upper, lower),
        ):
            count += cv2.subtract(high, low) > STEP  # of bytes: 0 where the other is brighter

    def result(self, outside: Mask | None, spread: NDArray[np.floating]) -> Mask | None:
        """Pixels that show the scene, bool [h, w]; None where nothing else is found, or too few images could tell.

        Args:
            outside: bool [h, w], pixels that are known to show no scene, whose outline stays, too; None: none.
            spread: [h, w], spread of every pixel's depth over its median, NaN where it has none.
        """
        from scipy import ndimage

        if self._often is None or self._images < LEAST_IMAGES:
            return None
        square = np.ones((3, 3))
        found = self._often.max(axis=0) >= OFTEN * self._images
        if outside is not None:
            found &= ~ndimage.binary_dilation(outside, square, GROW_PX)
        near = ndimage.binary_dilation(found, square, CLOSE_PX // 2)
        labels, _ = ndimage.label(near, square)
        enough = np.bincount(labels[found], minlength=labels.max() + 1) >= LEAST_PIXELS
        enough[0] = False
        for label in np.nonzero(enough)[0]:
            of_scene = spread[found & (labels == label) & np.isfinite(spread)]
            enough[label] = of_scene.size > 0 and np.median(of_scene) >= MOVED
        if not enough.any():
            return None
        closed = ndimage.binary_erosion(near, square, CLOSE_PX // 2, border_value=1) & enough[labels]
        return ~np.asarray(ndimage.binary_dilation(closed, square, GROW_PX))
