"""What the compiled passes over images compute: pyramids and normals, in numpy, to be read and to test against.

The residuals of a registration are defined in `residuals`, the search for their minimum in `search`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry import masks
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.color_comparison import GRAY_OF_RGB

Image = NDArray[Any]

GRAY_WEIGHTS = GRAY_OF_RGB.astype(np.float32)
SAME_SURFACE = np.float32(0.05)  # relative difference of depth up to which neighbors count as one surface
NORMAL_WINDOWS = (5, 3)  # pixels; the smaller one is used where the larger touches an edge or a hole


def gray_of_color(color: Image) -> Image:
    """Gray values [h, w] of a color image.

    Args:
        color: [h, w, 3], RGB, uint8 0..255 or float 0..1.
    """
    if color.dtype == np.uint8:
        color = color.astype(np.float32) * np.float32(1 / 255)
    red, green, blue = (GRAY_WEIGHTS[k] * color[..., k] for k in range(3))
    return red + green + blue


def inverse_depth_of(
    depth_m: Image, mask: masks.Mask | None = None, sigma_m: Image | None = None
) -> tuple[Image, Image | None]:
    """Inverse depth [h, w], 1/m, 0 where the depth is unknown or may not be used; and sigma there.

    Args:
        depth_m: [h, w], meters; 0, negative or not finite means unknown.
        mask: bool [h, w], pixels that may be used; None: all.
        sigma_m: [h, w], meters; None: not known.
    """
    known = np.isfinite(depth_m) & (depth_m > 0)
    if mask is not None:
        known &= mask
    inverse_depth = np.where(known, 1 / np.where(known, depth_m, np.float32(1)), np.float32(0))
    return inverse_depth, None if sigma_m is None else np.where(known, sigma_m, np.float32(0))


def halved(
    gray: Image,
    inverse_depth: Image,
    sigma_m: Image | None = None,
    half_mask: masks.Mask | None = None,
    *,
    chance: float = 0.0,
) -> tuple[Image, Image, Image | None]:
    """The images of `Level.halved`: gray, inverse depth, sigma.

    Args:
        gray: [h, w].
        inverse_depth: [h, w], 1/m, 0 where unknown.
        sigma_m: [h, w], meters; None: not known.
        half_mask: bool [h // 2, w // 2], pixels that may be used; None: all.
        chance: by which two inverse depths of one surface differ at most by their noise, 1/m.
    """
    blocks = _blocks(inverse_depth)
    nearest = blocks.max(axis=0)
    least = np.minimum(nearest * (1 - SAME_SURFACE), nearest - np.float32(chance))
    members = blocks > np.maximum(least, np.float32(0))
    count = members.sum(axis=0, dtype=np.float32)
    total = np.where(members, blocks, np.float32(0)).sum(axis=0)
    known = (total > 0) & (count >= 2)
    if half_mask is not None:
        known &= half_mask
    halved_depth = np.where(known, total / np.maximum(count, 1), np.float32(0))
    halved_gray = _blocks(gray).sum(axis=0) * np.float32(0.25)
    if sigma_m is None:
        return halved_gray, halved_depth, None
    of_members = np.where(members, _blocks(sigma_m), np.float32(0)).sum(axis=0)
    return halved_gray, halved_depth, np.where(known, of_members / np.maximum(count, 1), np.float32(0))


def _blocks(image: Image) -> Image:
    """The four pixels of every 2x2 block, [4, h // 2, w // 2]."""
    cut = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
    return np.stack([cut[::2, ::2], cut[::2, 1::2], cut[1::2, ::2], cut[1::2, 1::2]])


def surface_normals(inverse_depth: Image, camera: PinholeCamera) -> Image:
    """`Level.normals` [h, w, 3].

    Args:
        inverse_depth: [h, w], 1/m, 0 where unknown.
        camera: of the image.
    """
    normals = np.zeros((*inverse_depth.shape, 3), dtype=np.float32)
    missing = np.ones(inverse_depth.shape, dtype=bool)
    for window in NORMAL_WINDOWS:
        du, dv, mean, smooth = _fit_planes(inverse_depth, window)
        take = missing & smooth
        rays = camera.rays().astype(np.float32)[take]
        nx, ny = du[take] * np.float32(camera.fx), dv[take] * np.float32(camera.fy)
        nz = mean[take] - nx * rays[:, 0] - ny * rays[:, 1]
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        normals[take] = -np.stack([nx, ny, nz], axis=-1) / length[:, None]
        missing &= ~smooth
    return normals


def _fit_planes(values: Image, window: int) -> tuple[NDArray, NDArray, NDArray, NDArray[np.bool_]]:
    """Least-squares plane of `values` in a square window around every pixel.

    Returns:
        Slopes along u and v (per px), value at the center, and where the window has no unknown value and no step.
    """
    import cv2

    reach = window // 2
    offsets = np.arange(-reach, reach + 1, dtype=np.float32)
    slope, box = offsets / np.float32((offsets**2).sum()), np.full(window, 1 / window, dtype=np.float32)
    du = cv2.sepFilter2D(values, cv2.CV_32F, slope, box, borderType=cv2.BORDER_CONSTANT)
    dv = cv2.sepFilter2D(values, cv2.CV_32F, box, slope, borderType=cv2.BORDER_CONSTANT)
    mean = cv2.sepFilter2D(values, cv2.CV_32F, box, box, borderType=cv2.BORDER_CONSTANT)
    element = np.ones((window, window), dtype=np.uint8)
    lowest, highest = cv2.erode(values, element), cv2.dilate(values, element)
    smooth = (lowest > 0) & (highest - lowest < SAME_SURFACE * window / 2 * values)
    smooth[:reach] = smooth[-reach:] = False
    smooth[:, :reach] = smooth[:, -reach:] = False
    return du, dv, mean, smooth
