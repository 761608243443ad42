"""Depth of one sensor as an image of another camera: compiled passes behind checked numpy arrays.

`kernels.drawn_depth_definition` defines what they compute, to the bit, on every instruction set.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import _raster
from duagc.pipeline.kernels.drawn_depth_definition import NEAREST_M, ONE_LAYER, SAME_SURFACE, Indices


def drawn_triangles(
    corners: Array, inverse: Array, triangles: Indices, camera: PinholeCamera, *, isa: str = "auto"
) -> tuple[Array, Array]:
    """`kernels.drawn_depth_definition.drawn_triangles`.

    Args:
        corners: [m, 2], columns and rows of points, pixels, finite.
        inverse: [m], their inverse depth, 1/m, positive.
        triangles: [t, 3], of which points each one is.
        camera: of the image.
        isa: instruction set, as of `Rasterizer`.
    """
    points = len(inverse)
    if corners.shape != (points, 2) or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(
            f"found {corners.shape} corners, {points} depths and {triangles.shape} triangles, "
            "expected [m, 2], [m], [t, 3]"
        )
    if len(triangles) and not (triangles.min() >= 0 and triangles.max() < points):
        raise ValueError(f"a triangle has a point that is none of {points}")
    if not (np.isfinite(corners).all() and (inverse > 0).all()):
        raise ValueError("found corners or inverse depths that no point before a camera has")
    nearest, change = (np.zeros((camera.height, camera.width)) for _ in range(2))
    _raster.draw_triangles(
        isa,
        np.ascontiguousarray(corners, dtype=np.float64),
        np.ascontiguousarray(inverse, dtype=np.float64),
        np.ascontiguousarray(triangles, dtype=np.int64),
        nearest,
        change,
    )
    return nearest, change


def registered_depth(
    inverse: Array,
    depth_camera: PinholeCamera,
    T_camera_depth: Array,
    camera: PinholeCamera,
    *,
    steps: int,
    isa: str = "auto",
) -> NDArray[np.float32]:
    """`kernels.drawn_depth_definition.registered_depth`.

    Args:
        inverse: [h, w], inverse depth along z of the depth camera, 1/m, 0 = unknown.
        depth_camera: that measured it.
        T_camera_depth: [4, 4], pose of the depth camera in the other one.
        camera: the other one.
        steps: samples per pixel along either axis.
        isa: instruction set, as of `Rasterizer`.
    """
    if inverse.shape != (depth_camera.height, depth_camera.width) or steps < 1:
        raise ValueError(f"an image is {inverse.shape} with {steps} samples, expected that of {depth_camera}")
    numbers = [NEAREST_M, SAME_SURFACE, ONE_LAYER, *_pinhole(depth_camera), *_pinhole(camera)]
    depth = np.empty((camera.height, camera.width), dtype=np.float32)
    given = (inverse, T_camera_depth[:3], np.array(numbers))
    inputs = [np.ascontiguousarray(array, dtype=np.float64) for array in given]
    most = inverse.size * steps**2
    memory = np.empty(most, dtype=np.int32), np.empty(most), np.empty((3, depth.size))
    _raster.register_depth(isa, *inputs, steps, *memory, depth)
    return depth


def displaced_depth(
    depth: Array, depth_camera: PinholeCamera, camera: PinholeCamera, baseline_m: float, *, isa: str = "auto"
) -> Array:
    """`kernels.drawn_depth_definition.displaced_depth`.

    Args:
        depth: [h, w], meters along z of the depth camera, 0 = unknown.
        depth_camera: that measured it.
        camera: the other one.
        baseline_m: its place along x of the depth camera.
        isa: instruction set, as of `Rasterizer`.
    """
    if depth.shape != (depth_camera.height, depth_camera.width) or depth_camera.height < 2:
        raise ValueError(f"an image is {depth.shape}, expected that of {depth_camera}, two rows or more")
    numbers = np.array([baseline_m, SAME_SURFACE, *_pinhole(depth_camera), *_pinhole(camera)])
    displaced = np.empty((camera.height, camera.width))
    memory = np.empty((2, depth_camera.width))
    _raster.displace_depth(isa, np.ascontiguousarray(depth, dtype=np.float64), numbers, memory, displaced)
    return displaced


def _pinhole(camera: PinholeCamera) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx, camera.cy
