"""How far a view sees: which of the Gaussians of a map may be seen in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import back_project

BLOCKS = 40
"""Blocks across an image in which the farthest depth is kept."""
BEHIND_M, BEHIND = 0.05, 0.02
"""How far behind the farthest depth of its block a Gaussian is still drawn: meters, and a share of that depth."""
SIGMAS = 3.0
"""Radius of a Gaussian, in its largest standard deviation."""
NEAR_M = 0.05
POINTS_APART = 5
"""Blocks between the points of a view that are kept."""


@dataclass(frozen=True)
class ViewExtent:
    """How far a view sees.

    Attributes:
        camera: of the view.
        farthest_m: float32 [h, w], the farthest depth around each block of its image; infinite where one is unknown.
        center_camera: [3], what it looks at: on its axis, at the median depth.
        points_camera: float32 [n, 3], some points of what it sees.
    """

    camera: PinholeCamera
    farthest_m: NDArray[np.float32]
    center_camera: Array
    points_camera: NDArray[np.float32]

    @staticmethod
    def of(depth_m: NDArray[np.float32], camera: PinholeCamera) -> ViewExtent:
        """Of a view.

        Args:
            depth_m: [H, W], 0 where it is unknown.
            camera: of the view.
        """
        from scipy import ndimage

        side = max(1, camera.width // BLOCKS)
        known = np.where(depth_m > 0, depth_m, np.float32(np.inf))
        beyond = [(0, -length % side) for length in known.shape]  # of the last blocks, beyond the image
        whole = np.pad(known, beyond, constant_values=np.float32(-np.inf))
        height, width = whole.shape[0] // side, whole.shape[1] // side
        blocks = whole.reshape(height, side, width, side).max(axis=(1, 3))
        near = depth_m[::8, ::8]
        median_m = float(np.median(near[near > 0])) if near.any() else 0.0
        center = np.array([0.0, 0.0, median_m])
        first, step = POINTS_APART * side // 2, POINTS_APART * side
        v, u = np.nonzero(depth_m[first::step, first::step])
        v, u = first + step * v, first + step * u
        points = back_project(camera, u, v, depth_m[v, u]).astype(np.float32)
        return ViewExtent(camera, ndimage.maximum_filter(blocks, 3), center, points)

    def sees(
        self, means_map: NDArray[np.float32], radii_m: NDArray[np.float32], T_map_camera: Array
    ) -> NDArray[np.bool_]:
        """Which balls may be seen, bool [n]: partly in the image, and not behind all that it shows there.

        Args:
            means_map: [n, 3], their centers.
            radii_m: [n].
            T_map_camera: [4, 4], pose of the view.
        """
        T, camera = np.asarray(T_map_camera, np.float32), self.camera
        d = means_map - T[:3, 3]
        # sums written out: those of a matrix product depend on the machine
        x, y, z = (d[:, 0] * T[0, k] + d[:, 1] * T[1, k] + d[:, 2] * T[2, k] for k in range(3))
        seen = np.zeros(len(z), np.bool_)
        rows = np.flatnonzero(z > NEAR_M - radii_m)
        x, y, z, reach = x[rows], y[rows], z[rows], radii_m[rows]
        depth = np.maximum(z, np.float32(NEAR_M))
        side = max(1, camera.width // BLOCKS)
        height, width = self.farthest_m.shape
        spread_u, spread_v = (focal * reach / depth + side for focal in (camera.fx, camera.fy))
        u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        inside = (u > -spread_u) & (u < camera.width + spread_u)
        inside &= (v > -spread_v) & (v < camera.height + spread_v)
        rows, u, v, z, reach = rows[inside], u[inside], v[inside], z[inside], reach[inside]
        column = np.clip(u / side, 0, width - 1).astype(np.int64)
        row = np.clip(v / side, 0, height - 1).astype(np.int64)
        farthest = self.farthest_m[row, column]
        seen[rows] = z - reach <= np.float32(1 + BEHIND) * farthest + np.float32(BEHIND_M)
        return seen


def radii_m(log_scales: NDArray[np.float32]) -> NDArray[np.float32]:
    """How far Gaussians reach, meters [n].

    Args:
        log_scales: [n, 3], log of meters.
    """
    return np.asarray(np.float32(SIGMAS) * np.exp(log_scales.max(axis=1, initial=-np.inf)))
