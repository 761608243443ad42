"""Surfaces where noise of depth is more than the windows of normals allow for: planes in wide windows.

A stereo camera measures what is far with errors of a tenth of it, which neighbors share. In windows of a few pixels
these are steps and slopes. And with the depth of single pixels a motion comes out too short: what they differ by passes
for parallax that the images do not show (errors in variables).

Windows of 5x5 pixels of the coarsest image average both out. They hold what may be on the surface of their middle, and
count if a plane fits it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.inverse_depth import CHANCE_SIGMAS, chance_difference

Image = NDArray[Any]

REACH = 2  # pixels of the coarsest image, of a window to all sides
SLOPE = 0.05
"""Change of the inverse depth on one surface from pixel to pixel of the coarsest image, as a share of it, at most."""
LEAST_MEMBERS = 13  # of the 25 pixels of a window: then they are on no line
TELLS_STEPS = 0.125
"""Range of the inverse depth in a window of normals that is no step, as a share of it: more noise hides steps."""


@dataclass(frozen=True)
class WideSurfaces:
    """Planes around the pixels of the coarsest image of a view.

    Attributes:
        planes: [h, w, 3], inverse depth in the middle (1/m) and its slopes along u and v (1/m per pixel); zero: none.
        below: 1/m, inverse depth below which noise hides surfaces from small windows.
        chance: 1/m, by which two inverse depths of one surface differ at most.
    """

    planes: Array
    below: float
    chance: float

    @staticmethod
    def of(finest: Image, coarsest: Image, factor: int, sigma: float) -> WideSurfaces | None:
        """Of a view; None: noise hides nothing.

        Args:
            finest: inverse depth [h, w], 1/m, 0 = unknown.
            coarsest: the same of the coarsest image, [h // factor, w // factor].
            factor: between their sizes.
            sigma: standard deviation of the inverse depth of single pixels, 1/m.
        """
        chance = chance_difference(sigma, sigma)
        below = chance / TELLS_STEPS
        if not np.any((coarsest > 0) & (coarsest < below)):
            return None
        planes = _planes(_means_of_blocks(finest, coarsest, factor, chance), chance, CHANCE_SIGMAS * sigma)
        return WideSurfaces(planes, below, chance)

    def instead(
        self,
        normals: Image,
        inverse_depth: Image,
        *,
        pixels: tuple[NDArray[np.intp], NDArray[np.intp]],
        camera: PinholeCamera,
        factor: int,
    ) -> tuple[Image, Image]:
        """Normals and inverse depth at the pixels of a grid; those of the planes where noise hides surfaces.

        Args:
            normals: by small windows, [r, c, 3], camera frame.
            inverse_depth: as measured, [r, c], 1/m, 0 = unknown.
            pixels: rows [r] and columns [c] of the grid.
            camera: of the image.
            factor: between its size and that of the coarsest image.
        """
        rows, columns = pixels
        height, width = self.planes.shape[:2]
        v, u = np.minimum(rows // factor, height - 1), np.minimum(columns // factor, width - 1)
        middle, by_u, by_v = np.moveaxis(self.planes[np.ix_(v, u)], -1, 0)
        right, down = (columns + 0.5) / factor - 0.5 - u, (rows + 0.5) / factor - 0.5 - v
        smooth = middle + by_u * right + by_v * down[:, None]
        take = (inverse_depth > 0) & (inverse_depth < self.below) & (middle > 0) & (smooth > 0)
        take &= np.abs(smooth - inverse_depth) < self.chance
        # as of `Level.normals`
        nx, ny = by_u * (camera.fx / factor), by_v * (camera.fy / factor)
        x, y = (columns - camera.cx) / camera.fx, ((rows - camera.cy) / camera.fy)[:, None]
        nz = smooth - nx * x - ny * y
        length = np.maximum(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
        wide = -np.stack([nx, ny, nz], axis=-1) / length[..., None]
        return (
            np.where(take[..., None], wide, normals).astype(np.float32),
            np.where(take, smooth, inverse_depth).astype(np.float32),
        )


def _means_of_blocks(finest: Image, coarsest: Image, factor: int, chance: float) -> Array:
    """Means [h, w] of what may be on the surface that the coarsest image shows: that one takes the nearest of it."""
    h, w = coarsest.shape
    blocks = finest[: h * factor, : w * factor].reshape(h, factor, w, factor).swapaxes(1, 2).reshape(h, w, -1)
    off = np.abs(blocks - coarsest[..., None])
    member = (blocks > 0) & (off < np.maximum(SLOPE * coarsest, np.float32(chance))[..., None])
    total = np.where(member, blocks, np.float32(0)).sum(axis=-1, dtype=np.float64)
    return np.where(coarsest > 0, total / np.maximum(member.sum(axis=-1), 1), 0.0)


def _planes(values: Array, chance: float, most_off: float) -> Array:
    """`WideSurfaces.planes` of values [h, w]; members differ by chance and slope at most, from the plane by less."""
    h, w = values.shape
    padded, steps = np.pad(values, REACH), range(-REACH, REACH + 1)
    at = [(np.array([1.0, j, i]), padded[REACH + i :, REACH + j :][:h, :w]) for i in steps for j in steps]
    gate = chance + SLOPE * REACH * values
    members = [(z > 0) & (np.abs(z - values) < gate) for _, z in at]
    H, right = np.zeros((h, w, 3, 3)), np.zeros((h, w, 3))
    for (place, z), member in zip(at, members, strict=True):
        H += member[..., None, None] * np.outer(place, place)
        right += np.where(member, z, 0.0)[..., None] * place
    fits = (values > 0) & (H[..., 0, 0] >= LEAST_MEMBERS)
    planes = np.linalg.solve(np.where(fits[..., None, None], H, np.eye(3)), right[..., None])[..., 0]
    for (place, z), member in zip(at, members, strict=True):
        fits &= ~member | (np.abs(z - (planes * place).sum(axis=-1)) < most_off)
    return np.where((fits & (planes[..., 0] > 0))[..., None], planes, 0.0)
