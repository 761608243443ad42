"""A color and a depth camera: how they differ from those of a recording.

In a recording depth is registered to a pinhole color camera. Here the camera that took the color images has a lens,
is turned against the registered depth and took its images later; the depth has a smooth error in 1/z.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import depth_error, so3
from duagc.pipeline.geometry.camera import PinholeCamera

LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "k3")
ROTATION = ("rx", "ry", "rz")
DEPTH = ("c0", "c1", "c2", "c3", "c4", "c5")
NAMES = (*LENS, *ROTATION, "delay_s", *DEPTH)


@dataclass(frozen=True)
class CameraRig:
    """Both cameras.

    Attributes:
        camera: of the recording, to which depth is registered.
        lens: [7], focal lengths and principal point in pixels, radial distortion k1 k2 k3 as OpenCV defines it.
        R_color_depth: [3, 3].
        delay_s: how much later color was taken than the time stamps say.
        depth_error: [6], 1/m, see `geometry.depth_error`.
    """

    camera: PinholeCamera
    lens: Array
    R_color_depth: Array
    delay_s: float
    depth_error: Array

    @staticmethod
    def of(camera: PinholeCamera) -> CameraRig:
        """As in the recording: a pinhole, not turned, at the same time, exact depth.

        Args:
            camera: of the recording.
        """
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy, 0, 0, 0])
        return CameraRig(camera, lens, np.eye(3), 0.0, np.zeros(6))

    def values(self) -> Array:
        """The numbers of `NAMES`; the rotation as a rotation vector."""
        return np.concatenate([self.lens, so3.log(self.R_color_depth), [self.delay_s], self.depth_error])

    def moved(self, step: Array) -> CameraRig:
        """With a step of all numbers added; that of the rotation from the left.

        Args:
            step: [17], in the order of `NAMES`.
        """
        return replace(
            self,
            lens=self.lens + step[:7],
            R_color_depth=so3.exp(step[7:10]) @ self.R_color_depth,
            delay_s=float(self.delay_s + step[10]),
            depth_error=self.depth_error + step[11:],
        )

    def project(self, points_color: Array) -> tuple[Array, Array, Array]:
        """Pixels [n, 2] of points of the color camera; derivatives by point [n, 2, 3] and lens [n, 2, 7].

        Args:
            points_color: [n, 3], meters, z > 0.
        """
        fx, fy, cx, cy, k1, k2, k3 = self.lens
        z = points_color[:, 2]
        x, y = points_color[:, 0] / z, points_color[:, 1] / z
        r2 = x * x + y * y
        g, dg = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + r2 * 3 * k3)
        one, nought = np.ones_like(x), np.zeros_like(x)
        by_ray = np.stack(
            [
                np.stack([fx * (g + 2 * x * x * dg), fx * 2 * x * y * dg], axis=-1),
                np.stack([fy * 2 * x * y * dg, fy * (g + 2 * y * y * dg)], axis=-1),
            ],
            axis=1,
        )
        ray_by_point = np.stack(
            [
                np.stack([1 / z, nought, -x / z], axis=-1),
                np.stack([nought, 1 / z, -y / z], axis=-1),
            ],
            axis=1,
        )
        u_by = [x * g, nought, one, nought, fx * x * r2, fx * x * r2**2, fx * x * r2**3]
        v_by = [nought, y * g, nought, one, fy * y * r2, fy * y * r2**2, fy * y * r2**3]
        by_lens = np.stack([np.stack(u_by, axis=-1), np.stack(v_by, axis=-1)], axis=1)
        return np.stack([fx * x * g + cx, fy * y * g + cy], axis=-1), by_ray @ ray_by_point, by_lens

    def depth(self, inverse: Array, rays: Array) -> Array:
        """True depth [...], meters, of a measured inverse depth.

        Args:
            inverse: measured, [...], 1/m.
            rays: [..., 3], with z = 1.
        """
        terms = depth_error.terms(inverse, rays[..., 0], rays[..., 1])
        return np.asarray(1 / np.maximum(inverse + terms @ self.depth_error, 1 / depth_error.FARTHEST_M))

    def depth_by(self, depth_m: Array, rays: Array) -> Array:
        """Derivative [..., 6] of a depth [...] at rays [..., 3] by the coefficients of the error, to their first order.

        The depth's noise must not be that of the residual: the derivative grows with depth squared, and with the
        measured depth noise would bias all coefficients in one direction, the more the less they are determined.

        Args:
            depth_m: [...].
            rays: [..., 3], with z = 1.
        """
        terms = depth_error.terms(1 / depth_m, rays[..., 0], rays[..., 1])
        return np.asarray(-(depth_m**2)[..., None] * terms)
