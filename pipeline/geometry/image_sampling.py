"""Values of an image between its pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array

STEPS = 32
"""Parts of a pixel that make a difference."""


def sampled(image: NDArray[np.uint8], u: Array, v: Array) -> NDArray[np.uint8]:
    """An image at pixels [h, w], bilinear; by whole numbers, so that it is the same on every processor.

    Args:
        image: uint8 [H, W] or [H, W, n]; black outside.
        u: columns [h, w].
        v: rows [h, w].
    """
    import cv2

    steps = [np.clip(np.rint(at * STEPS), -STEPS, 2**14 * STEPS).astype(np.int32) for at in (u, v)]
    whole = np.stack([at // STEPS for at in steps], axis=-1).astype(np.int16)
    rest = (steps[1] % STEPS * STEPS + steps[0] % STEPS).astype(np.uint16)
    return np.asarray(cv2.remap(image, whole, rest, cv2.INTER_LINEAR), dtype=np.uint8)
