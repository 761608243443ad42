"""The smooth error of a depth camera that measures disparity, as structured light does: lens and projector warp it.

With coefficients c0 .. c5 in 1/m, of a measured depth z at the ray (x, y, 1),

    1/z + c0 (1 - 2 m / z) + c1 x + c2 y + c3 x^2 + c4 x y + c5 y^2

is the true 1/z. c0 changes nothing at 2 m: no image shows a common factor of all lengths.
"""

from __future__ import annotations

import numpy as np

from duagc.pipeline.base.arrays import Array

COEFFICIENTS = 6
NO_ERROR_M = 2.0
FARTHEST_M = 100.0  # a correction that puts a depth farther away, or behind the camera, means nothing


def terms(inverse: Array, x: Array, y: Array) -> Array:
    """The terms [..., 6] that the coefficients multiply.

    Args:
        inverse: measured 1/z, [...].
        x: of the ray (x, y, 1), [...].
        y: of the ray, [...].
    """
    return np.stack([1 - NO_ERROR_M * inverse, x, y, x * x, x * y, y * y], axis=-1)
