"""Depth of another sensor as a depth image of the colour camera. Arrays in, arrays out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import se3
from pipeline.geometry.camera import PinholeCamera

Array = NDArray[np.float64]
Image = NDArray[np.float32]
SAME_SURFACE = 0.03  # relative step of depth up to which neighbours are one surface
ONE_LAYER = 0.01  # relative depth behind the nearest sample of a pixel up to which samples are averaged
NEAREST_M = 0.05


def register_depth(
    depth_m: Image, depth_camera: PinholeCamera, T_camera_depth: Array, camera: PinholeCamera
) -> Image:
    """The depth image of one camera as another one would see it.

    Inverse depth is interpolated between the pixels of one surface (exact on planes), dense enough to leave no gaps,
    never across a step; every point falls on one pixel, where the nearest surface wins. What the depth camera did not
    see stays 0.

    Args:
        depth_m: [h, w], metres along z of the depth camera, 0 = unknown. T_camera_depth: [4, 4].
    Returns:
        float32 [camera.height, camera.width], metres along z of `camera`, 0 = unknown.
    """
    known = depth_m > 0
    inverse = np.where(known, 1 / np.where(known, depth_m, 1), 0).astype(np.float64)
    growth = max(camera.fx / depth_camera.fx, camera.fy / depth_camera.fy)
    steps = max(1, int(np.ceil(1.5 * growth)))
    points = []
    for b in range(steps):
        for a in range(steps):
            rho = inverse if a == b == 0 else _between(inverse, a / steps, b / steps)
            v, u = np.nonzero(rho)
            z = 1 / rho[v, u]
            x = (u + a / steps - depth_camera.cx) / depth_camera.fx * z
            y = (v + b / steps - depth_camera.cy) / depth_camera.fy * z
            points.append(np.stack([x, y, z], axis=-1))
    return draw_points(se3.transform(T_camera_depth, np.concatenate(points)), camera)


def _between(inverse: Array, a: float, b: float) -> Array:
    """Inverse depth a px right of and b px below every pixel, 0 where its four neighbours are not one surface."""
    corners = np.stack([inverse[:-1, :-1], inverse[:-1, 1:], inverse[1:, :-1], inverse[1:, 1:]])
    lowest, highest = corners.min(axis=0), corners.max(axis=0)
    weights = np.array([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    out = np.zeros_like(inverse)
    whole = (lowest > 0) & (highest <= (1 + SAME_SURFACE) * lowest)
    out[:-1, :-1] = np.where(whole, np.tensordot(weights, corners, axes=1), 0)
    return out


def draw_points(points_camera: Array, camera: PinholeCamera) -> Image:
    """Points [n, 3] of the camera frame as a depth image: the nearest of every pixel, 0 where there is none.

    The samples of the nearest surface in a pixel are averaged in inverse depth.
    """
    points = points_camera[points_camera[:, 2] > NEAREST_M]
    u, v = np.rint(camera.project(points)).T
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    pixel = (v[inside] * camera.width + u[inside]).astype(np.int64)
    z = points[inside, 2]
    size = camera.width * camera.height
    nearest = np.full(size, np.inf)
    np.minimum.at(nearest, pixel, z)
    front = z <= (1 + ONE_LAYER) * nearest[pixel]
    count = np.bincount(pixel[front], minlength=size)
    total = np.bincount(pixel[front], 1 / z[front], size)
    depth = np.where(count > 0, count / np.where(count > 0, total, 1), 0)
    return depth.reshape(camera.height, camera.width).astype(np.float32)
