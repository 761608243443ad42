"""What the compiled search of `kernels.moved_depth` computes, in numpy, to be read and to test against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera

Image = NDArray[np.float32]

ROUNDS = 3  # of looking up where in the depth image a pixel was; each brings it nearer by the share that depth changes
MOST_OFF_PX = 0.7  # of a found point from its pixel
SAME_SURFACE = np.float32(0.03)  # relative step of depth up to which neighbors are one surface
FARTHEST_PX = np.float32(1e5)
NEAREST_PLANE_M, NEAREST_FRONT_M = np.float32(1e-3), np.float32(0.05)


def found_points(
    inverse_depth: Image,
    nearest: Image,
    camera: PinholeCamera,
    T_color_depth: NDArray[np.float64],
    *,
    middle: float,
) -> tuple[Image, Image, Image]:
    """Inverse depth [h, w] at the pixels of a camera (0: unknown), and the columns and rows where it was looked up.

    For each pixel the point is looked up that projects there: from the inverse depth of the last round to the pixel of
    the depth image, inverse depth there (interpolated within a surface, exact on planes), and back.

    Args:
        inverse_depth: [h, w] of a depth image, 1/m, 0 where unknown.
        nearest: [h, w], 1/m, of the nearest surface around each pixel, with which the search begins; 0: none.
        camera: of both.
        T_color_depth: [4, 4], from the camera when depth was taken to the camera that looks for points.
        middle: 1/m, positive, with which it begins where there is none.
    """
    x, y = np.meshgrid(*rays(camera))
    start = np.float32(middle)
    found = _rounds(inverse_depth, np.where(nearest > 0, nearest, start), (x, y), camera, T=T_color_depth)
    missing = found[0] == 0
    again = np.where(inverse_depth > 0, inverse_depth, start)[missing]
    others = _rounds(inverse_depth, again, (x[missing], y[missing]), camera, T=T_color_depth)
    for whole, part in zip(found, others, strict=True):
        whole[missing] = part
    return found


def rays(camera: PinholeCamera) -> tuple[Image, Image]:
    """x [w] and y [h] of the rays (x, y, 1) of the pixels.

    Args:
        camera: of the pixels.
    """
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    return x.astype(np.float32), y.astype(np.float32)


def _rounds(
    inverse_depth: Image,
    start: Image,
    ray: tuple[Image, Image],
    camera: PinholeCamera,
    *,
    T: NDArray[np.float64],
) -> tuple[Image, Image, Image]:
    """Inverse depth, columns and rows of the pixels of some rays. T: T_color_depth."""
    fx, fy, cx, cy = (np.float32(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    smooth, T_depth_color = _smooth(inverse_depth), se3.inverse(T)
    found, one = start, np.float32(1)
    off = u = v = np.zeros_like(start)
    for _ in range(ROUNDS):
        x, y, z = _transformed(T_depth_color, ray[0] / found, ray[1] / found, one / found)
        front_m = np.where(z > NEAREST_PLANE_M, z, NEAREST_PLANE_M)
        u = np.clip(fx * x / front_m + cx, -FARTHEST_PX, FARTHEST_PX)
        v = np.clip(fy * y / front_m + cy, -FARTHEST_PX, FARTHEST_PX)
        there = _look_up(inverse_depth, smooth, u, v)
        seen = there > 0
        depth_m = one / np.where(seen, there, one)
        x, y, z = _transformed(T, (u - cx) / fx * depth_m, (v - cy) / fy * depth_m, depth_m)
        front = seen & (z > NEAREST_FRONT_M)
        z = np.where(front, z, one)
        off_u, off_v = (x / z - ray[0]) * fx, (y / z - ray[1]) * fy
        off = np.where(front, off_u * off_u + off_v * off_v, np.finfo(np.float32).max)
        found = np.where(front, one / z, found)
    return np.where(off < np.float32(MOST_OFF_PX) ** 2, found, np.float32(0)), u, v


def _smooth(inverse: Image) -> NDArray[np.bool_]:
    """Pixels whose right, lower and lower right neighbors are on their surface."""
    corners = np.stack([inverse[:-1, :-1], inverse[:-1, 1:], inverse[1:, :-1], inverse[1:, 1:]])
    lowest = corners.min(axis=0)
    smooth = np.zeros(inverse.shape, dtype=bool)
    smooth[:-1, :-1] = (lowest > 0) & (corners.max(axis=0) <= (1 + SAME_SURFACE) * lowest)
    return smooth


def _look_up(inverse: Image, smooth: NDArray[np.bool_], u: Image, v: Image) -> Image:
    """Inverse depth at pixels: interpolated within a surface, else that of the nearest pixel; 0 where unknown."""
    within = _at(smooth, u, v)
    left, top = (np.where(within, at, np.float32(0)).astype(np.int64) for at in (u, v))
    right, low = np.minimum(left + 1, inverse.shape[1] - 1), np.minimum(top + 1, inverse.shape[0] - 1)
    s, t = u - left.astype(np.float32), v - top.astype(np.float32)
    above = inverse[top, left] + s * (inverse[top, right] - inverse[top, left])
    below = inverse[low, left] + s * (inverse[low, right] - inverse[low, left])
    half = np.float32(0.5)
    return np.where(within, above + t * (below - above), _at(inverse, u + half, v + half))


def _at(image: NDArray, u: Image, v: Image) -> NDArray:
    """Values at the pixels that have these points between their upper left corner and the next; 0 outside."""
    inside = (u >= 0) & (u < image.shape[1]) & (v >= 0) & (v < image.shape[0])
    column, row = (np.where(inside, at, np.float32(0)).astype(np.int64) for at in (u, v))
    return np.where(inside, image[row, column], np.zeros((), dtype=image.dtype))


def _transformed(
    T: NDArray[np.float64], x: NDArray[np.floating], y: NDArray[np.floating], z: NDArray[np.floating]
) -> tuple[Image, Image, Image]:
    """Coordinates of points in another frame, float32."""
    R, t = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
    found = [R[k, 0] * x + R[k, 1] * y + R[k, 2] * z + t[k] for k in range(3)]
    return found[0], found[1], found[2]
