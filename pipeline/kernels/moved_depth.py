"""Which points of a depth image a camera sees from another place: a compiled search behind checked numpy arrays.

`kernels.moved_depth_definition` defines what it computes, to the bit, on every instruction set.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import _raster
from duagc.pipeline.kernels.moved_depth_definition import MOST_OFF_PX, ROUNDS, SAME_SURFACE, Image, rays


def found_points(
    inverse_depth: Image,
    nearest: Image,
    camera: PinholeCamera,
    T_color_depth: NDArray[np.float64],
    *,
    middle: float,
    isa: str = "auto",
) -> tuple[Image, Image, Image]:
    """`kernels.moved_depth_definition.found_points`.

    Args:
        inverse_depth: [h, w] of a depth image, 1/m, 0 where unknown.
        nearest: [h, w], 1/m, of the nearest surface around each pixel, with which the search begins; 0: none.
        camera: of both.
        T_color_depth: [4, 4], from the camera when depth was taken to the camera that looks for points.
        middle: 1/m, positive, with which it begins where there is none.
        isa: instruction set, as of `Rasterizer`.
    """
    shape = camera.height, camera.width
    for name, image in (("inverse_depth", inverse_depth), ("nearest", nearest)):
        if image.shape != shape or image.dtype != np.float32:
            raise ValueError(f"{name} is {image.dtype} {image.shape}, expected float32 {shape}")
    if not middle > 0:
        raise ValueError(f"middle is {middle}, expected more than 0")
    found = tuple(np.empty(shape, dtype=np.float32) for _ in range(3))
    numbers = [middle, camera.fx, camera.fy, camera.cx, camera.cy, np.float32(MOST_OFF_PX) ** 2, SAME_SURFACE]
    motions = [T[:3].astype(np.float32) for T in (se3.inverse(T_color_depth), T_color_depth)]
    images = (np.ascontiguousarray(image) for image in (inverse_depth, nearest))
    arguments = (*images, *rays(camera), *motions, np.array(numbers, dtype=np.float32))
    _raster.move_depth(isa, *arguments, ROUNDS, *found)
    return found[0], found[1], found[2]
