"""A lens with radial distortion, and the undistorted images that a converter makes of its images.

Brown's model: r' = r (1 + k1 r^2 + k2 r^4), r in units of the focal length. k2 = k1^2, about as in wide cameras of
robots (EuRoC: k1 = -0.283, k2 = 0.074; k1^2 = 0.080): so r' grows with r everywhere, and every ray has its own pixel.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera

NEWTON_STEPS = 30


@dataclass(frozen=True)
class RadialLens:
    """A camera with a lens.

    Attributes:
        camera: focal lengths, principal point and size of its distorted images.
        k1: first coefficient of the radial distortion.
    """

    camera: PinholeCamera
    k1: float

    @property
    def k2(self) -> float:
        """Second coefficient."""
        return self.k1**2

    def distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Where rays (x, y, 1) end up in the plane at focal length 1.

        Args:
            x: to the right.
            y: down, of the same shape.
        """
        r2 = x**2 + y**2
        factor = 1 + self.k1 * r2 + self.k2 * r2**2
        return factor * x, factor * y

    def undistort(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Rays (x, y, 1) that end up at points of the plane at focal length 1: the inverse of `distort`.

        Args:
            x: to the right.
            y: down, of the same shape.
        """
        seen = np.hypot(x, y)
        r = seen.copy()
        for _ in range(NEWTON_STEPS):
            excess = r * (1 + self.k1 * r**2 + self.k2 * r**4) - seen
            r = np.maximum(r - excess / (1 + 3 * self.k1 * r**2 + 5 * self.k2 * r**4), 0.0)
        factor = np.divide(r, seen, out=np.ones_like(r), where=seen > 1e-12)
        return factor * x, factor * y

    def rays(self, du: float, dv: float) -> tuple[Array, Array]:
        """Rays (x, y, 1), [h, w] each, next to the centers of the pixels.

        Args:
            du: to the right, pixels.
            dv: down, pixels.
        """
        c = self.camera
        x = (np.arange(c.width) + du - c.cx) / c.fx
        y = (np.arange(c.height) + dv - c.cy) / c.fy
        return self.undistort(*np.broadcast_arrays(x[None, :], y[:, None]))

    @property
    def pinhole(self) -> PinholeCamera:
        """The camera of the undistorted images: as large, and it sees everything that the lens sees."""
        c = self.camera
        u, v = np.meshgrid(np.arange(c.width), np.arange(c.height))
        border = (u == 0) | (u == c.width - 1) | (v == 0) | (v == c.height - 1)
        u, v = u[border], v[border]
        seen = np.stack([(u - c.cx) / c.fx, (v - c.cy) / c.fy])
        straight = np.stack(self.undistort(seen[0], seen[1]))
        share = float((np.abs(straight).max(axis=1) / np.abs(seen).max(axis=1)).max())
        return PinholeCamera(c.width, c.height, c.fx / share, c.fy / share, c.cx, c.cy)

    def maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        """Where in the distorted image every pixel of `pinhole` lies, columns and rows; and whether it does, [h, w]."""
        c, rays = self.camera, self.pinhole.rays()
        x, y = self.distort(rays[..., 0], rays[..., 1])
        u, v = c.fx * x + c.cx, c.fy * y + c.cy
        inside = (u >= 0) & (u <= c.width - 1) & (v >= 0) & (v <= c.height - 1)
        return u.astype(np.float32), v.astype(np.float32), inside

    @property
    def rows_per_row(self) -> float:
        """How many rows of the distorted image a row of `pinhole` is, along the middle column, by least squares."""
        _, v, inside = self.maps()
        column = self.camera.width // 2
        rows = np.flatnonzero(inside[:, column])
        seen, middle = v[rows, column].astype(np.float64), rows - rows.mean()
        return float((middle * seen).sum() / (middle**2).sum())
