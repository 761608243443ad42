"""Cameras with a lens, and how a pinhole camera at the same place sees what they saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry import so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.masks import Mask

Maps = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Column and row in a source at which every pixel of an image lies, [h, w] each, as `cv2.remap` takes them."""
FISHEYE_NUMBERS = (4,)
POLYNOMIAL_NUMBERS = (4, 5, 8, 12, 14)
OUTSIDE = np.float32(-1)  # column and row of what no pixel of the source shows
TURN_STEPS = 4096  # of the radius, by which it is found where a distortion turns back
ROUNDING_STEPS = 2  # of float32 at the far border, by which maps may be off


@dataclass(frozen=True)
class Lens:
    """A camera as it is.

    Attributes:
        source: its focal lengths, its principal point, and the size of its images.
        distortion: as OpenCV has it: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]], of a fisheye k1 k2 k3 k4;
            empty: none.
        fisheye: whether the distortion is that of the equidistant model (Kannala and Brandt, PAMI 2006).
        rotation_rad: rotation vector [3] that takes directions of the pinhole camera to those of this one.
    """

    source: PinholeCamera
    distortion: tuple[float, ...] = ()
    fisheye: bool = False
    rotation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def rotation(self) -> NDArray[np.float64]:
        """R_source_pinhole [3, 3]."""
        return so3.exp(np.array(self.rotation_rad))

    def maps(self, camera: PinholeCamera) -> Maps:
        """Where in the images of this camera every pixel of a pinhole camera at the same place lies.

        Args:
            camera: the pinhole camera.
        """
        import cv2

        rays, turned, lens = camera.rays().reshape(-1, 1, 3), np.array(self.rotation_rad), self.distortion
        if self.fisheye:
            pixels, _ = cv2.fisheye.projectPoints(
                rays, turned, np.zeros(3), self.source.matrix(), np.array(lens)
            )
        else:
            pixels, _ = cv2.projectPoints(
                rays, turned, np.zeros(3), self.source.matrix(), np.array(lens or np.zeros(4))
            )
        u, v = pixels.reshape(camera.height, camera.width, 2).astype(np.float32).transpose(2, 0, 1)
        beyond = self._beyond_the_turn(rays.reshape(-1, 3) @ self.rotation().T).reshape(u.shape)
        return np.where(beyond, OUTSIDE, u), np.where(beyond, OUTSIDE, v)

    def _beyond_the_turn(self, rays: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Rays [n, 3] so far from the axis that the distortion leads back toward it: no pixel shows them."""
        across, ahead = np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]
        behind = ahead <= 0  # there OpenCV draws a fisheye as if it were in front
        radius = np.arctan2(across, ahead) if self.fisheye else across / np.where(behind, 1.0, ahead)
        farthest = float(radius[~behind].max(initial=0.0))
        k = np.zeros(8)
        k[: min(8, len(self.distortion))] = self.distortion[:8]
        r = np.linspace(0.0, farthest, TURN_STEPS)
        s = r * r
        if self.fisheye:
            distorted = r * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
        else:  # the tangential and the prism terms are small
            above, below = ((1 + s * (a + s * (b + s * c))) for a, b, c in (k[[0, 1, 4]], k[5:8]))
            with np.errstate(divide="ignore", invalid="ignore"):
                distorted = r * above / below
        with np.errstate(invalid="ignore"):
            back = np.flatnonzero(np.diff(distorted) <= 0)
        return behind | (radius > (r[back[0]] if len(back) else np.inf))


def rectified(image: NDArray[np.uint8], maps: Maps) -> NDArray[np.uint8]:
    """A color image at the pixels of `Lens.maps`; beyond its border the border is repeated.

    Args:
        image: uint8 [H, W, 3], of the lens.
        maps: of the pinhole camera.

    Returns:
        uint8 [h, w, 3].
    """
    import cv2

    moved = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, dtype=np.uint8)


def seen_by_source(maps: Maps, width: int, height: int) -> Mask:
    """Pixels of a resampled image that bilinear interpolation makes of pixels of its source alone.

    At a whole pixel the next one has no weight; one that is beyond by rounding only counts as whole.

    Args:
        maps: columns and rows of the source.
        width: of the source, pixels.
        height: of the source, pixels.
    """
    inside = np.ones(maps[0].shape, dtype=bool)
    for part, side in zip(maps, (width, height), strict=True):
        at, last = part.astype(np.float64), side - 1
        rounding_px = ROUNDING_STEPS * float(np.spacing(np.float32(last)))
        inside &= (at >= -rounding_px) & (at <= last + rounding_px)
    return inside
