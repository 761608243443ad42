"""A color camera with a lens, turned against its depth camera, and a depth camera whose disparity is warped.

What they give is what `seven_scenes.Registration` wants: color as a pinhole camera sees it that is turned as the depth
camera is, and depth without its smooth error. Directions of the depth camera are (x, y, 1), x right, y down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.files import encode_png
from duagc.pipeline.geometry import depth_error, se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera

Numbers = tuple[float, ...]


def numbers(text: str, counts: tuple[int, ...]) -> Numbers:
    """Numbers apart by commas or spaces; none in an empty text.

    Raises:
        ValueError: they are no finite numbers, or not as many as one of `counts`.
    """
    found = tuple(float(part) for part in text.replace(",", " ").split())
    if found and (len(found) not in counts or not np.isfinite(found).all()):
        expected = " or ".join(str(count) for count in counts)
        raise ValueError(f"found {len(found)} numbers, expected {expected}, all finite")
    return found


@dataclass(frozen=True)
class ColorLens:
    """The color camera as it is.

    Attributes:
        source: its focal lengths and principal point.
        distortion: (k1, k2, p1, p2[, k3]) in OpenCV's order, or empty.
        rotation_rad: rotation vector [3] that takes directions of the depth camera to those of the color
            camera.
    """

    source: PinholeCamera
    distortion: Numbers
    rotation_rad: Numbers

    @property
    def is_pinhole(self) -> bool:
        """Whether its images are those of `camera` already."""
        s = self.source
        return s.fx == s.fy and not any(self.distortion) and not any(self.rotation_rad)

    @property
    def camera(self) -> PinholeCamera:
        """The camera of the resampled images: square pixels, no lens, turned as the depth camera is.

        Its principal point is where the images show the depth camera's axis, so little is lost at their borders.
        """
        s = self.source
        if self.is_pinhole:
            return s
        x, y, z = so3.exp(np.array(self.rotation_rad or (0.0, 0.0, 0.0)))[:, 2].tolist()
        return PinholeCamera(s.width, s.height, s.fx, s.fx, s.cx + s.fx * x / z, s.cy + s.fy * y / z)

    def turned(self) -> Array:
        """T_color_camera [4, 4], from `camera` to the color camera as it is: they are at one place."""
        R = so3.exp(np.array(self.rotation_rad or (0.0, 0.0, 0.0)))
        return se3.from_rotation_translation(R, np.zeros(3))

    def maps(self, camera: PinholeCamera | None = None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Where in the camera's images every pixel of resampled ones lies, columns and rows [h, w].

        Args:
            camera: of the resampled images, turned as the depth camera is; None: `camera` of this lens.
        """
        import cv2

        s, seen_by = self.source, camera or self.camera
        rays = seen_by.rays().reshape(-1, 3)
        turned = np.array(self.rotation_rad or (0.0, 0.0, 0.0))
        lens = np.array(self.distortion or (0.0, 0.0, 0.0, 0.0))
        pixels, _ = cv2.projectPoints(rays, turned, np.zeros(3), s.matrix(), lens)
        u, v = pixels.reshape(seen_by.height, seen_by.width, 2).astype(np.float32).transpose(2, 0, 1)
        return np.ascontiguousarray(u), np.ascontiguousarray(v)


def resampled(image: NDArray[np.uint8], maps: tuple[NDArray[np.float32], NDArray[np.float32]]) -> bytes:
    """A color image [h, w, 3] at the pixels of `ColorLens.maps`, as PNG; beyond its border the border is repeated."""
    import cv2

    moved = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return encode_png(np.asarray(moved))


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
