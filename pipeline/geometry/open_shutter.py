"""What a camera sees that moves while its shutter is open: the mean light of the moments in between.

A sensor adds up light, and an image stores about its square root (sRGB: power 1 / 2.2 with a straight piece at black).
The square is used here, because it and its root are the same bits on every machine, and a power is not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import projection, se3
from duagc.pipeline.geometry.camera import PinholeCamera

Image: TypeAlias = NDArray[Any]
BLACK = 0.02
"""Color below which light is a straight line of it, so that derivatives stay bounded; sRGB has 0.04 there."""
LEAST_PX = 1.5
"""Motion of the median pixel from which a view is drawn from several places: less looks like a sharp view."""
APART_PX, MOST = 5.0, 5
"""How far the median pixel moves from one place to the next in training, and the most places: three up to 15 px.
Places 3 px apart bring 0.3 dB more where it moves by 8 px, and take a quarter longer."""
STRIDE_PX = 16  # between the pixels whose motion is computed


class CameraMotion(Protocol):
    """Knows how a camera moved."""

    def at(self, color_ns: int, times_ns: NDArray[np.int64]) -> Array | None:
        """T_color_then [n, 4, 4], from the camera at some times to the camera when a color image was taken.

        Args:
            color_ns: time of a frame.
            times_ns: [n], near it.
        """


def light_of(color: Image) -> Image:
    """Light of colors of any shape, 0..1 both; continued as a straight line below `BLACK`.

    Args:
        color: as stored in images.
    """
    bright = np.maximum(color, color.dtype.type(BLACK))
    return np.asarray(bright * bright + color.dtype.type(2 * BLACK) * (color - bright))


def color_of(light: Image) -> Image:
    """The inverse of `light_of`.

    Args:
        light: of any shape.
    """
    kind = light.dtype.type
    bright = np.maximum(light, kind(BLACK * BLACK))
    return np.asarray(np.sqrt(bright) + kind(0.5 / BLACK) * (light - bright))


def mean_color(colors: Sequence[Image]) -> Image:
    """Color of the mean light of some images.

    Args:
        colors: of one shape.
    """
    total = light_of(colors[0])
    for color in colors[1:]:
        total = total + light_of(color)
    return color_of(total * total.dtype.type(1 / len(colors)))


def mean_color_slope(color: Image, mean: Image, moments: int) -> Image:
    """Derivative of `mean_color` by one of its images, pixel by pixel.

    Args:
        color: that image.
        mean: of all of them.
        moments: how many they are.
    """
    black = color.dtype.type(BLACK)
    return np.asarray(
        np.maximum(color, black) / (np.maximum(mean, black) * color.dtype.type(moments)), dtype=color.dtype
    )


@dataclass(frozen=True)
class OpenShutter:
    """How long a camera's shutter is open, and how the camera moves meanwhile.

    Attributes:
        shutter_s: seconds; the stamp of an image is in the middle.
        motion: of the camera.
    """

    shutter_s: float
    motion: CameraMotion

    def moments(
        self,
        stamp_ns: int,
        depth_m: Image,
        camera: PinholeCamera,
        *,
        apart_px: float = APART_PX,
        most: int = MOST,
    ) -> Array | None:
        """T_camera_moment [k, 4, 4], k odd: where the camera is, evenly spaced, seen from the middle one.

        Args:
            stamp_ns: of a frame.
            depth_m: its depth [H, W], 0 = unknown.
            camera: of the frame.
            apart_px: how far its median pixel moves from one to the next, unless there are too many of them.
            most: how many there are at most, an odd number.

        Returns:
            The poses; None where the image moves by less than `LEAST_PX`, or nothing says how.
        """
        if self.shutter_s <= 0:
            return None
        ends_ns = stamp_ns + np.rint(1e9 * self.shutter_s * np.array([-0.5, 0.5])).astype(np.int64)
        ends = self.motion.at(stamp_ns, ends_ns)
        if ends is None or (moved_px := motion_px(depth_m, camera, *ends)) < LEAST_PX:
            return None
        count = min(max(2 * math.ceil((moved_px / apart_px - 1) / 2) + 1, 3), most)
        shares = (np.arange(count) + 0.5) / count - 0.5
        return self.motion.at(stamp_ns, stamp_ns + np.rint(1e9 * self.shutter_s * shares).astype(np.int64))


def motion_px(depth_m: Image, camera: PinholeCamera, T_camera_first: Array, T_camera_last: Array) -> float:
    """How far the median pixel with depth moves between two places of the camera; 0 without depth.

    Args:
        depth_m: [H, W], of the camera between them, 0 = unknown.
        camera: of all three.
        T_camera_first: [4, 4], from the first place.
        T_camera_last: [4, 4], from the last one.
    """
    z = depth_m[::STRIDE_PX, ::STRIDE_PX].astype(np.float64)
    row, column = np.nonzero(z > 0)
    if not len(row):
        return 0.0
    points = projection.back_project(camera, STRIDE_PX * column, STRIDE_PX * row, z[row, column])
    pixels = []
    for T in (T_camera_first, T_camera_last):
        seen = se3.transform(se3.inverse(T), points)
        pixels.append(seen[:, :2] / np.maximum(seen[:, 2:], 1e-6) * np.array([camera.fx, camera.fy]))
    return float(np.median(np.linalg.norm(pixels[1] - pixels[0], axis=1)))
