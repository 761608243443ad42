"""Where points are, as far as a view can judge it: a compiled pass behind checked numpy arrays.

`kernels.free_space_definition` defines what it computes, to the bit, on every instruction set.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import NEAR_M
from duagc.pipeline.kernels import _raster
from duagc.pipeline.kernels.arguments import floats_of
from duagc.pipeline.kernels.free_space_definition import NEAR_GATE


def free_space(
    points: Array,
    T_view_points: Array,
    nearest: NDArray[np.floating],
    camera: PinholeCamera,
    *,
    gate_m: float,
    gate_relative: float,
    gate_inverse: float,
    isa: str = "auto",
) -> NDArray[np.int8]:
    """`kernels.free_space_definition.free_space`.

    Args:
        points: [n, 3], meters, in any frame.
        T_view_points: [4, 4], from it to the frame of the view.
        nearest: [h, w], `largest_of_3x3` of the view's inverse depth, 1/m, 0 = unknown.
        camera: of the view.
        gate_m: by which a point must differ from the measured depth not to be on the surface.
        gate_relative: the same as a share of the measured depth.
        gate_inverse: the same of the inverse depth, 1/m.
        isa: instruction set, as of `Rasterizer`.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points have shape {points.shape}, expected (n, 3)")
    where = np.empty(len(points), dtype=np.int8)
    image = floats_of("nearest", nearest, (camera.height, camera.width))
    gates = [NEAR_GATE, gate_m, gate_relative, gate_inverse]
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, NEAR_M, *gates]
    _raster.free_space(
        isa,
        np.ascontiguousarray(points, dtype=np.float64),
        np.ascontiguousarray(T_view_points[:3], dtype=np.float64),
        image,
        np.array(numbers),
        where,
    )
    return where
