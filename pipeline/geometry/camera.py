"""Pinhole cameras. The center of the first pixel is (0, 0); x right, y down, z forward."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

MAX_SIDE_PX = 16_384
"""Of the images of any camera."""
MIN_SIDE_PX = 4
"""Of color images: a pixel is left at a quarter of their size, at which registration begins."""


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of an undistorted camera.

    Attributes:
        width: of the image, pixels.
        height: of the image, pixels.
        fx: focal length, pixels.
        fy: focal length, pixels.
        cx: principal point, pixels from the center of the first one.
        cy: principal point, pixels from the center of the first one.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def matrix(self) -> NDArray[np.float64]:
        """K [3, 3]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def halved(self) -> "PinholeCamera":
        """The camera of the image in which each 2x2 block became one pixel (a last odd row or column is cut)."""
        return PinholeCamera(
            self.width // 2,
            self.height // 2,
            self.fx / 2,
            self.fy / 2,
            (self.cx + 0.5) / 2 - 0.5,
            (self.cy + 0.5) / 2 - 0.5,
        )

    def scaled(self, width: int, height: int) -> "PinholeCamera":
        """The camera of the same view resampled to another size in pixels.

        Args:
            width: of the new image, pixels.
            height: of the new image, pixels.
        """
        sx, sy = width / self.width, height / self.height
        return PinholeCamera(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
        )

    def rays(self) -> NDArray[np.float64]:
        """Ray of every pixel with z = 1, camera frame, [height, width, 3]."""
        return self.rays_at(*np.meshgrid(np.arange(self.width), np.arange(self.height)))

    def rays_at(self, u: ArrayLike, v: ArrayLike) -> NDArray[np.float64]:
        """Rays [..., 3] with z = 1, camera frame, of pixels, also between their centers.

        Args:
            u: columns [...].
            v: rows [...].
        """
        x, y = (np.asarray(u) - self.cx) / self.fx, (np.asarray(v) - self.cy) / self.fy
        return np.stack([x, y, np.ones(np.shape(x))], axis=-1)

    def ray_lengths(self) -> NDArray[np.float64]:
        """Length of the ray of every pixel with z = 1, [height, width]: distances divided by it are depths along z."""
        return np.linalg.norm(self.rays(), axis=-1)

    def project(self, points_camera: ArrayLike) -> NDArray[np.float64]:
        """Pixels [..., 2] of points.

        Args:
            points_camera: [..., 3] with z > 0, meters, camera frame.
        """
        p = np.asarray(points_camera, dtype=np.float64)
        return np.stack(
            [self.fx * p[..., 0] / p[..., 2] + self.cx, self.fy * p[..., 1] / p[..., 2] + self.cy], axis=-1
        )

    def back_project(self, depth_m: ArrayLike) -> NDArray[np.float64]:
        """Points [height, width, 3] in the camera frame of a depth image.

        Args:
            depth_m: [height, width], meters along z (not range).
        """
        return self.rays() * np.asarray(depth_m, dtype=np.float64)[..., None]
