"""What the compiled pass of `kernels.free_space` computes, in numpy, to be read and to test against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import visible

NEAR_GATE = 0.25
"""Of the depth: gates in meters of near surfaces are no larger."""
FREE, ON_SURFACE, HIDDEN, UNKNOWN = 1, 0, -1, -2
"""Where a point is as a view saw it: see `free_space`."""


def free_space(
    points: Array,
    T_view_points: Array,
    nearest: NDArray[np.floating],
    camera: PinholeCamera,
    *,
    gate_m: float,
    gate_relative: float,
    gate_inverse: float,
) -> NDArray[np.int8]:
    """Where points are, as far as a view can judge it: in space that it saw to be free, on a surface, or hidden.

    In a rigid world a surface inside a view is never nearer than what the view measured there.

    Args:
        points: [n, 3], meters, in any frame.
        T_view_points: [4, 4], from it to the frame of the view.
        nearest: [h, w], `largest_of_3x3` of the view's inverse depth, 1/m, 0 = unknown.
        camera: of the view.
        gate_m: a point must differ by this from the measured depth not to be on the surface; less of surfaces that
            are so near that it is more than a quarter of their depth.
        gate_relative: the same as a share of the measured depth.
        gate_inverse: the same of the inverse depth, 1/m; the largest of the three holds.

    Returns:
        For each point FREE, ON_SURFACE or HIDDEN; UNKNOWN where the view measured nothing.
    """
    R, t = T_view_points[:3, :3], T_view_points[:3, 3]
    rows = (R[k, 0] * points[:, 0] + R[k, 1] * points[:, 1] + R[k, 2] * points[:, 2] + t[k] for k in range(3))
    points_view = np.stack(list(rows), axis=1)
    index, u, v = visible(camera, points_view)
    inverse = nearest[v, u]
    index, inverse = index[inverse > 0], inverse[inverse > 0]
    z_view, z_point = 1 / inverse.astype(np.float64), points_view[index, 2]
    gate = np.maximum(np.minimum(gate_m, NEAR_GATE * z_view), gate_relative * z_view)
    known = inverse.astype(np.float64)
    nearest_m = np.minimum(z_view - gate, 1 / (known + gate_inverse))
    farther = known > gate_inverse
    farthest_m = np.maximum(
        z_view + gate, np.where(farther, 1 / np.where(farther, known - gate_inverse, 1), np.inf)
    )
    where = np.full(len(points), UNKNOWN, np.int8)
    where[index] = np.where(z_point < nearest_m, FREE, np.where(z_point > farthest_m, HIDDEN, ON_SURFACE))
    return where
