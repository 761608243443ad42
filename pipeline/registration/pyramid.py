"""Image pyramids of an RGB-D frame: gray value, inverse depth, their gradients and surface normals.

Depth is kept as inverse depth (1/m, 0 = unknown) because the inverse depth of a plane is affine in the pixel
coordinates: averages over a block, bilinear interpolation and finite differences are then exact on planes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import masks
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.inverse_depth import chance_difference, inverse_depth_sigma
from duagc.pipeline.geometry.projection import back_project, largest_of_3x3
from duagc.pipeline.geometry.scattered_holes import without_scattered_holes
from duagc.pipeline.kernels import pyramid as compiled
from duagc.pipeline.registration.wide_surfaces import WideSurfaces

Image = NDArray[Any]

SAMPLED_PX = 40  # rows and columns, about, along which noise from pixel to pixel is measured


@dataclass(frozen=True)
class Level:
    """One resolution of a frame.

    Attributes:
        camera: intrinsics of this resolution.
        gray: float32 [h, w], 0..1.
        inverse_depth: float32 [h, w], 1/m, 0 where the depth is unknown.
        has_depth: False if there is no depth image, which is not the same as one that is empty.
        depth_sigma_m: float32 [h, w], standard deviation of the depth; None: not known pixel by pixel.
        mask: bool [h, w], pixels all parts of which may be used; None: all. Elsewhere the depth is unknown.
    """

    camera: PinholeCamera
    gray: Image
    inverse_depth: Image
    has_depth: bool = True
    depth_sigma_m: Image | None = None
    mask: masks.Mask | None = None

    @cached_property
    def gradients(self) -> tuple[Image, Image]:
        """Derivatives of the gray value by u and v, 1/px, [h, w] each; zero on the border."""
        gu, gv = np.zeros_like(self.gray), np.zeros_like(self.gray)
        gu[:, 1:-1] = 0.5 * (self.gray[:, 2:] - self.gray[:, :-2])
        gv[1:-1] = 0.5 * (self.gray[2:] - self.gray[:-2])
        return gu, gv

    @cached_property
    def usable_inverse_depth(self) -> Image:
        """Inverse depth [h, w] of the pixels that a sample may fall on, 0 elsewhere.

        A pixel whose gradient touches one that may not be used is none. Without a depth image all others have 1.
        """
        depths = self.inverse_depth if self.has_depth else np.ones_like(self.inverse_depth)
        if self.mask is None:
            return depths
        return np.where(masks.whole_windows(self.mask, 1), depths, np.float32(0))

    @cached_property
    def points(self) -> Array:
        """Points [n, 3] of the pixels of known depth, row by row; meters, camera frame."""
        v, u = np.nonzero(self.inverse_depth)
        return back_project(self.camera, u, v, 1 / self.inverse_depth[v, u].astype(np.float64))

    @cached_property
    def median_depth_m(self) -> float:
        """Median depth of the pixels of known depth, meters; infinite if there is none."""
        known = self.inverse_depth[self.inverse_depth > 0]
        return 1 / float(np.median(known)) if len(known) else np.inf

    @cached_property
    def nearest(self) -> Image:
        """Largest inverse depth [h, w] in the 3x3 pixels around every pixel, 1/m, 0 where none is known."""
        return largest_of_3x3(self.inverse_depth)

    @cached_property
    def inverse_depth_sigma(self) -> float:
        """Standard deviation of the inverse depth of what is far, 1/m."""
        return inverse_depth_sigma(self.inverse_depth, self.depth_sigma_m)

    @cached_property
    def sigma_of_neighbors(self) -> float:
        """Standard deviation of the inverse depth of what is far, as far as neighbors do not share it, 1/m."""
        return inverse_depth_sigma(self.inverse_depth, stride=max(1, self.camera.width // SAMPLED_PX))

    @cached_property
    def normals(self) -> Image:
        """Unit surface normals in the camera frame that face the camera, [h, w, 3]; zero where unknown.

        A plane n . X = rho has the inverse depth n . (x, y, 1) / rho at the ray (x, y, 1), so n follows from a
        plane fitted to the inverse depth in a square window. A window that holds an unknown depth or a step of
        more than 5 % of the depth gives no normal.
        """
        return self.normals_at(np.arange(self.camera.height), np.arange(self.camera.width))

    def normals_at(self, rows: NDArray[np.integer], columns: NDArray[np.integer]) -> Image:
        """`normals` of the pixels of a grid, [r, c, 3].

        Args:
            rows: of the grid, [r].
            columns: of the grid, [c].
        """
        return compiled.surface_normals(self.inverse_depth, self.camera, rows, columns)

    def halved(self) -> Level:
        """The next coarser level: blocks of 2x2 pixels become one.

        The gray value is the mean. The inverse depth is the mean over the nearest surface in the block (members
        within 5 % of the nearest pixel, or within what noise from pixel to pixel explains), unknown if fewer than two
        pixels show it; sigma is their mean too, as errors of neighbors are much the same. A block may be used if all
        its pixels may.
        """
        mask = None if self.mask is None else masks.halved(self.mask)
        chance = chance_difference(self.sigma_of_neighbors, self.sigma_of_neighbors)
        gray, inverse_depth, sigma = compiled.halved(
            self.gray, self.inverse_depth, self.depth_sigma_m, mask, chance=chance
        )
        return Level(
            self.camera.halved(),
            gray,
            inverse_depth,
            has_depth=self.has_depth,
            depth_sigma_m=sigma,
            mask=mask,
        )


@dataclass(frozen=True)
class RgbdPyramid:
    """A frame at several resolutions.

    Attributes:
        levels: the full one first, each next one has half the size.
    """

    levels: tuple[Level, ...]

    @property
    def inverse_depth_sigma(self) -> float:
        """Standard deviation of the inverse depth of what is far, 1/m.

        By the image that shows most of it: coarse ones average what neighbors do not share, fine ones hide the rest.
        """
        *finer, coarsest = self.levels
        return max([coarsest.inverse_depth_sigma, *(level.sigma_of_neighbors for level in finer)])

    @cached_property
    def wide_surfaces(self) -> WideSurfaces | None:
        """Surfaces where noise of depth hides them from the windows of `Level.normals`; None: nowhere."""
        finest, coarsest = self.levels[0], self.levels[-1]
        factor = 1 << (len(self.levels) - 1)
        return WideSurfaces.of(finest.inverse_depth, coarsest.inverse_depth, factor, self.inverse_depth_sigma)

    def without_depth(self) -> RgbdPyramid:
        """The gray values alone, of a frame without a depth image."""
        return self._changed(
            lambda level: Level(
                level.camera,
                level.gray,
                np.zeros_like(level.inverse_depth),
                has_depth=False,
                mask=level.mask,
            )
        )

    def with_exposure(self, gain: float, offset: float) -> RgbdPyramid:
        """The same with gray values gain * gray + offset.

        Args:
            gain: factor.
            offset: added.
        """
        g, o = np.float32(gain), np.float32(offset)
        return self._changed(lambda level: replace(level, gray=g * level.gray + o))

    def masked(self, mask: masks.Mask) -> RgbdPyramid:
        """The same without some more pixels.

        Args:
            mask: bool [h, w] of the finest level, pixels that may be used.
        """
        finest = self.levels[0]
        usable = mask if finest.mask is None else finest.mask & mask
        inverse_depth = np.where(usable, finest.inverse_depth, np.float32(0))
        built = [replace(finest, inverse_depth=inverse_depth, mask=usable)]
        while len(built) < len(self.levels):
            built.append(built[-1].halved())
        return RgbdPyramid(tuple(built))

    def _changed(self, change: Callable[[Level], Level]) -> RgbdPyramid:
        return RgbdPyramid(tuple(change(level) for level in self.levels))

    @staticmethod
    def build(
        image: Image,
        depth_m: Image,
        camera: PinholeCamera,
        levels: int = 3,
        *,
        depth_sigma_m: Image | None = None,
        mask: masks.Mask | None = None,
    ) -> RgbdPyramid:
        """Build the pyramid of a frame.

        Args:
            image: color [h, w, 3], float 0..1 or uint8, or gray [h, w], 0..1.
            depth_m: float32 [h, w], meters along z; 0, negative or not finite means unknown. Scattered holes are
                filled.
            camera: intrinsics of both images.
            levels: number of resolutions.
            depth_sigma_m: [h, w], meters; None: not known pixel by pixel.
            mask: bool [h, w], pixels that may be used; None: all.
        """
        gray = compiled.gray_of_color(image) if image.ndim == 3 else np.ascontiguousarray(image, np.float32)
        shape = (camera.height, camera.width)
        if gray.shape != shape or depth_m.shape != shape:
            raise ValueError(f"images of {gray.shape} and {depth_m.shape}, camera of {shape}")
        inverse_depth, sigma = compiled.inverse_depth_of(depth_m, mask, depth_sigma_m)
        if sigma is None:  # where it is known, holes are those of what was computed from images or sweeps
            inverse_depth = without_scattered_holes(inverse_depth, mask)
        built = [Level(camera, gray, inverse_depth, depth_sigma_m=sigma, mask=mask)]
        while len(built) < levels:
            built.append(built[-1].halved())
        return RgbdPyramid(tuple(built))
