"""Depth of another sensor as a depth image of the color camera. Arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import back_project, visible

Image = NDArray[np.float32]
SAME_SURFACE = 0.03  # relative step of depth up to which neighbors are one surface
ONE_LAYER = 0.01  # relative depth behind the nearest sample of a pixel up to which samples are averaged
NEAREST_M = 0.05
MOST_SAMPLES = 64_000_000  # of a depth image that is registered; each takes twelve bytes


def sample_steps(depth_camera: PinholeCamera, camera: PinholeCamera) -> int:
    """Samples per pixel of the depth camera, along either axis, that leave no gaps in the other camera."""
    growth = max(camera.fx / depth_camera.fx, camera.fy / depth_camera.fy)
    return max(1, int(np.ceil(1.5 * growth)))


def register_depth(
    depth_m: Image, depth_camera: PinholeCamera, T_camera_depth: Array, camera: PinholeCamera
) -> Image:
    """The depth image of one camera as another one would see it.

    Inverse depth is interpolated between the pixels of one surface (exact on planes), dense enough to leave no gaps,
    never across a step; every point falls on one pixel, where the nearest surface wins. What the depth camera did not
    see stays 0.

    Args:
        depth_m: [h, w], meters along z of the depth camera, 0 = unknown.
        depth_camera: that measured it.
        T_camera_depth: [4, 4], pose of the depth camera in the other one.
        camera: the other one.

    Returns:
        float32 [camera.height, camera.width], meters along z of `camera`, 0 = unknown.
    """
    known = depth_m > 0
    inverse = np.where(known, 1 / np.where(known, depth_m, 1), 0).astype(np.float64)
    steps = sample_steps(depth_camera, camera)
    drawn = []
    for b in range(steps):
        for a in range(steps):
            rho = inverse if a == b == 0 else _between(inverse, a / steps, b / steps)
            v, u = np.nonzero(rho)
            points = back_project(depth_camera, u + a / steps, v + b / steps, 1 / rho[v, u])
            drawn.append(_pixels(se3.transform(T_camera_depth, points), camera))
    return _nearest(drawn, camera)


def _between(inverse: Array, a: float, b: float) -> Array:
    """Inverse depth a px right of and b px below every pixel, 0 where its four neighbors are not one surface."""
    corners = np.stack([inverse[:-1, :-1], inverse[:-1, 1:], inverse[1:, :-1], inverse[1:, 1:]])
    lowest, highest = corners.min(axis=0), corners.max(axis=0)
    weights = np.array([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    out = np.zeros_like(inverse)
    whole = (lowest > 0) & (highest <= (1 + SAME_SURFACE) * lowest)
    out[:-1, :-1] = np.where(whole, np.tensordot(weights, corners, axes=1), 0)
    return out


def _pixels(points_camera: Array, camera: PinholeCamera) -> tuple[NDArray[np.int32], Array]:
    """Pixel (row by row) and depth of the points that fall into the image."""
    index, u, v = visible(camera, points_camera, NEAREST_M)
    return (v * camera.width + u).astype(np.int32), points_camera[index, 2]


def _nearest(drawn: Sequence[tuple[NDArray[np.int32], Array]], camera: PinholeCamera) -> Image:
    """The nearest surface in every pixel, of samples in several lots; its samples are averaged in inverse depth."""
    size = camera.width * camera.height
    nearest = np.full(size, np.inf)
    for pixel, z in drawn:
        np.minimum.at(nearest, pixel, z)
    count, total = np.zeros(size), np.zeros(size)
    for pixel, z in drawn:
        front = z <= (1 + ONE_LAYER) * nearest[pixel]
        np.add.at(count, pixel[front], 1)
        np.add.at(total, pixel[front], 1 / z[front])
    depth = np.where(count > 0, count / np.where(count > 0, total, 1), 0)
    return depth.reshape(camera.height, camera.width).astype(np.float32)
