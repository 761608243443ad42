"""A color camera with a lens, turned against its depth camera, and a depth camera whose disparity is warped.

What they give is what `seven_scenes.Registration` wants: color as a pinhole camera sees it that is turned as the depth
camera is, and depth without its smooth error. Directions of the depth camera are (x, y, 1), x right, y down.
"""

from __future__ import annotations

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import depth_error
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens

Numbers = tuple[float, ...]


def numbers(text: str, counts: tuple[int, ...]) -> Numbers:
    """Numbers apart by commas or spaces; none in an empty text.

    Args:
        text: of an option.
        counts: how many numbers there may be, besides none.

    Raises:
        ValueError: they are no finite numbers, or not as many as one of `counts`.
    """
    found = tuple(float(part) for part in text.replace(",", " ").split())
    if found and (len(found) not in counts or not np.isfinite(found).all()):
        expected = " or ".join(str(count) for count in counts)
        raise ValueError(f"found {len(found)} numbers, expected {expected}, all finite")
    return found


def is_pinhole(lens: Lens) -> bool:
    """Whether the images of a color camera are those of `square_camera` already.

    Args:
        lens: the color camera.
    """
    is_bent = lens.fisheye or any(lens.distortion) or any(lens.rotation_rad)
    return lens.source.fx == lens.source.fy and not is_bent


def square_camera(lens: Lens) -> PinholeCamera:
    """A pinhole camera with square pixels at the place of a color camera, turned as the depth camera is.

    Its principal point is where the color images show the depth camera's axis, so little is lost at their borders.

    Args:
        lens: the color camera; its `rotation_rad` takes directions of the depth camera to its own.
    """
    s = lens.source
    if is_pinhole(lens):
        return s
    x, y, z = lens.rotation()[:, 2].tolist()
    return PinholeCamera(s.width, s.height, s.fx, s.fx, s.cx + s.fx * x / z, s.cy + s.fy * y / z)


def correct(depth_m: Array, camera: PinholeCamera, coefficients: Numbers) -> Array:
    """Depth without its smooth error (`duagc.pipeline.geometry.depth_error`); what that puts too far away is unknown.

    Args:
        depth_m: [h, w] of `camera`, 0 = none.
        camera: of the depth images.
        coefficients: c0 .. c5, 1/m; empty: nothing is changed.
    """
    if not any(coefficients):
        return depth_m
    x, y = camera.rays()[..., 0], camera.rays()[..., 1]
    known = depth_m > 0
    w = 1 / np.where(known, depth_m, 1)
    terms = depth_error.terms(w, x, y)
    for k, coefficient in enumerate(coefficients):
        w = w + coefficient * terms[..., k]
    near = w > 1 / depth_error.FARTHEST_M
    return np.where(known & near, 1 / np.where(near, w, 1), 0.0)
