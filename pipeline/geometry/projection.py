"""What one view shows of another: projection, visibility, overlap.

Everywhere: a pixel's center has integer coordinates, columns u and rows v; z is the depth along the optical axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera

Indices = NDArray[np.int64]
Image = NDArray[np.floating]

NEAR_M = 0.05  # points nearer to the image plane are not projected: their pixels mean little
SAME_SURFACE = 0.1  # relative difference of depth up to which two views show the same surface
PARTS = (4, 5)  # rows and columns of parts that `covered` counts
BEHIND_COSINE = 0.2  # between ray and normal; beyond, a surface is seen from behind: noisy normals scatter


def inside(u: NDArray, v: NDArray, shape: tuple[int, ...], margin_px: int = 0) -> NDArray[np.bool_]:
    """Whether pixels lie in an image.

    Args:
        u: columns [...].
        v: rows [...].
        shape: (height, width) of the image.
        margin_px: pixels at every border that do not count.
    """
    height, width = shape[:2]
    of_columns = (u >= margin_px) & (u < width - margin_px)
    return np.asarray(of_columns & (v >= margin_px) & (v < height - margin_px))


def back_project(camera: PinholeCamera, u: ArrayLike, v: ArrayLike, z: ArrayLike) -> Array:
    """Points [..., 3] in the camera frame of pixels with known depth.

    Args:
        camera: of the image.
        u: columns [...].
        v: rows [...].
        z: depth [...], meters.
    """
    return camera.rays_at(u, v) * np.asarray(z)[..., None]


def visible(
    camera: PinholeCamera, points_camera: Array, near_m: float = NEAR_M, margin_px: int = 0
) -> tuple[Indices, Indices, Indices]:
    """The points before a camera that fall into its image, whatever may hide them.

    Args:
        camera: of the image.
        points_camera: [n, 3], meters, camera frame.
        near_m: points must lie farther away than this along the optical axis.
        margin_px: pixels at every border of the image that do not count.

    Returns:
        Rows of these points, and the columns u and rows v of their nearest pixels, each int64 [k].
    """
    index = np.flatnonzero(points_camera[:, 2] > near_m)
    u, v = np.rint(camera.project(points_camera[index])).T
    seen = inside(u, v, (camera.height, camera.width), margin_px)
    return index[seen], u[seen].astype(np.int64), v[seen].astype(np.int64)


def overlap(
    points_camera: Array,
    camera: PinholeCamera,
    *,
    depth_m: Image | None = None,
    inverse_depth: Image | None = None,
    normals: Array | None = None,
) -> float:
    """Share of the points that a view sees on the same surface; 0 without points.

    Args:
        points_camera: [n, 3], meters, samples of another view in the frame of this one.
        camera: of this view.
        depth_m: [h, w], what this view measured, 0 = unknown; it may differ by SAME_SURFACE of a point's own
            depth.
        inverse_depth: instead of it, 1/m, 0 = unknown; a point may differ by SAME_SURFACE of the measured
            depth.
        normals: [n, 3], unit length, of the points, in the frame of this view: points seen `from_behind` are not on the
            same surface. None: not known.
    """
    if len(points_camera) == 0:
        return 0.0
    index, u, v = visible(camera, points_camera)
    z = points_camera[index, 2]
    if inverse_depth is not None:
        same = _meets(z, inverse_depth[v, u])
    elif depth_m is not None:
        same = np.abs(depth_m[v, u] - z) < SAME_SURFACE * z
    else:
        raise TypeError("overlap needs depth_m or inverse_depth")
    if normals is not None:
        same &= ~from_behind(points_camera[index], normals[index])
    return float(np.count_nonzero(same)) / len(points_camera)


def covered(points_camera: Array, camera: PinholeCamera, inverse_depth: Image, normals: Array) -> float:
    """Share of a view's image, by `PARTS`, in which it sees points of another one on the same surface.

    A camera that stands nearer than another sees little of what that one saw, but of its own image all is in it.

    Args:
        points_camera: [n, 3], meters, samples of the other view in the frame of this one.
        camera: of this view.
        inverse_depth: [h, w], what this view measured, 1/m, 0 = unknown.
        normals: [n, 3], unit length, of the points, in the frame of this view.
    """
    index, u, v = visible(camera, points_camera)
    same = _meets(points_camera[index, 2], inverse_depth[v, u])
    same &= ~from_behind(points_camera[index], normals[index])
    rows, columns = PARTS
    here = np.zeros(PARTS, dtype=bool)
    here[v[same] * rows // camera.height, u[same] * columns // camera.width] = True
    return float(here.mean())


def _meets(z: NDArray[np.floating], inverse_depth: Image) -> NDArray[np.bool_]:
    """Whether points at these depths lie on what was measured there, 1/m, 0 = unknown."""
    return np.asarray((inverse_depth > 0) & (np.abs(z * inverse_depth - 1) < SAME_SURFACE))


def from_behind(points_camera: NDArray[np.floating], normals: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which surfaces a view would see from behind: what it sees there is another one, such as a wall's other side.

    Args:
        points_camera: [..., 3], meters, of surfaces that another view saw, in the frame of this one.
        normals: [..., 3], unit length, same frame; they face the view that saw the surfaces.
    """
    away = np.sum(points_camera * normals, axis=-1)
    squares = np.sum(points_camera * points_camera, axis=-1)
    return np.asarray((away > 0) & (away * away > BEHIND_COSINE**2 * squares))


def largest_of_3x3(image: Image) -> Image:
    """Maximum over every pixel's 3x3 neighborhood.

    Args:
        image: [h, w].
    """
    padded = np.pad(image, 1)
    rows = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    return np.maximum(np.maximum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])
