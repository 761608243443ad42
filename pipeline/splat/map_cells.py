"""A map in cells, so that what a view may see of it is found in a moment, however large the map is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.view_extent import BLOCKS, NEAR_M, ViewExtent, radii_m
from duagc.pipeline.splat.gaussians import Gaussians

REACHES = (1, 2, 4, 8, 16, 1 << 30)
"""How many blocks of an image a ball reaches: within as many, the farthest depth counts."""
EDGE_M = 0.25
"""Edge of a cell."""
SPARE_M = 0.05
"""How far Gaussians may move, or grow, while the cells are used."""


@dataclass(frozen=True)
class MapCells:
    """Gaussians by the cell of a grid that they are in, each cell with a ball around all that it draws.

    Attributes:
        cell: int64 [n], of every Gaussian.
        centers_m: float32 [c, 3], of the balls.
        radii_m: float32 [c].
    """

    cell: NDArray[np.int64]
    centers_m: NDArray[np.float32]
    radii_m: NDArray[np.float32]

    @staticmethod
    def of(gaussians: Gaussians) -> MapCells:
        """The cells of a map.

        Args:
            gaussians: of the map.
        """
        places = np.floor(gaussians.means / np.float32(EDGE_M)).astype(np.int64)
        _, cell = np.unique(places, axis=0, return_inverse=True)
        cell = cell.reshape(-1)
        order = np.argsort(cell, kind="stable")
        first = np.flatnonzero(np.diff(cell[order], prepend=-1))
        means = gaussians.means[order]
        low, high = np.minimum.reduceat(means, first), np.maximum.reduceat(means, first)
        centers = ((low + high) / 2).astype(np.float32)
        reach = radii_m(gaussians.log_scales) + np.linalg.norm(gaussians.means - centers[cell], axis=1)
        radii = np.maximum.reduceat(reach[order], first) + np.float32(SPARE_M)
        return MapCells(cell, centers, radii.astype(np.float32))

    def seen(
        self, depth_m: NDArray[np.float32], T_map_camera: Array, camera: PinholeCamera
    ) -> NDArray[np.int64]:
        """Rows of the Gaussians that a view may see, ascending.

        Args:
            depth_m: [H, W], 0 where it is unknown.
            T_map_camera: [4, 4], pose of the camera in the frame of the map.
            camera: of the view.
        """
        return self._seen(ViewExtent.of(depth_m, camera), T_map_camera)

    def in_image(self, T_map_camera: Array, camera: PinholeCamera) -> NDArray[np.int64]:
        """Rows of the Gaussians that may be in an image, whatever hides them, ascending.

        Args:
            T_map_camera: [4, 4], pose of the camera.
            camera: that would see them.
        """
        nothing = np.zeros((camera.height, camera.width), np.float32)
        return self._seen(ViewExtent.of(nothing, camera), T_map_camera)

    def _seen(self, sight: ViewExtent, T_map_camera: Array) -> NDArray[np.int64]:
        from scipy import ndimage

        camera = sight.camera
        T_camera_map = se3.inverse(T_map_camera)
        depth_m = self.centers_m @ T_camera_map[2, :3] + T_camera_map[2, 3] - self.radii_m
        blocks = (
            BLOCKS * max(camera.fx, camera.fy) / camera.width * self.radii_m / np.maximum(depth_m, NEAR_M)
        )
        seen = np.zeros(len(self.centers_m), bool)
        below = 0
        for reach in REACHES:
            rows = np.flatnonzero((blocks > below) & (blocks <= reach))
            farthest_m = ndimage.maximum_filter(sight.farthest_m, 2 * min(reach, BLOCKS) + 1)
            around = replace(sight, farthest_m=farthest_m)
            seen[rows] = around.sees(self.centers_m[rows], self.radii_m[rows], T_map_camera)
            below = reach
        return np.flatnonzero(seen[self.cell])
