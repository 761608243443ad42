"""Image pyramids of an RGB-D frame: gray value, inverse depth, their gradients and surface normals.

Depth is kept as inverse depth (1/m, 0 = unknown) because the inverse depth of a plane is affine in the pixel
coordinates: averages over a block, bilinear interpolation and finite differences are then exact on planes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry import masks
from duagc.pipeline.geometry.camera import PinholeCamera

Image = NDArray[np.floating]

GRAY_OF_RGB = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601 luma
SAME_SURFACE = np.float32(0.05)  # relative difference of depth up to which neighbors count as one surface
NORMAL_WINDOWS = (5, 3)  # pixels; the smaller one is used where the larger touches an edge or a hole


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
    def channels(self) -> Image:
        """(gray, d/du, d/dv, inverse depth or NaN, and sigma where known) for interpolation, [h * w, 4 or 5].

        NaN makes every value that touches an unknown depth unknown, and fails every gate. So does a pixel whose
        gradient touches one that may not be used. Without a depth image the inverse depth is 1 at all others.
        """
        gu, gv = self.gradients
        known = self.inverse_depth > 0 if self.has_depth else np.ones(self.gray.shape, dtype=bool)
        if self.mask is not None:
            known &= masks.whole_windows(self.mask, 1)
        depths = self.inverse_depth if self.has_depth else np.ones_like(self.inverse_depth)
        inverse_depth = np.where(known, depths, np.float32(np.nan))
        sigma = [] if self.depth_sigma_m is None else [self.depth_sigma_m]
        return np.stack([self.gray, gu, gv, inverse_depth, *sigma], axis=-1).reshape(-1, 4 + len(sigma))

    @cached_property
    def normals(self) -> Image:
        """Unit surface normals in the camera frame that face the camera, [h, w, 3]; zero where unknown.

        A plane n . X = rho has the inverse depth n . (x, y, 1) / rho at the ray (x, y, 1), so n follows from a
        plane fitted to the inverse depth in a square window. A window that holds an unknown depth or a step of
        more than 5 % of the depth gives no normal.
        """
        normals = np.zeros((*self.gray.shape, 3), dtype=np.float32)
        missing = np.ones(self.gray.shape, dtype=bool)
        for window in NORMAL_WINDOWS:
            du, dv, mean, smooth = _fit_planes(self.inverse_depth, window)
            take = missing & smooth
            rays = self.camera.rays().astype(np.float32)[take]
            nx, ny = du[take] * np.float32(self.camera.fx), dv[take] * np.float32(self.camera.fy)
            nz = mean[take] - nx * rays[:, 0] - ny * rays[:, 1]
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            normals[take] = -np.stack([nx, ny, nz], axis=-1) / length[:, None]
            missing &= ~smooth
        return normals

    def halved(self) -> Level:
        """The next coarser level: blocks of 2x2 pixels become one.

        The gray value is the mean. The inverse depth is the mean over the nearest surface in the block (members
        within 5 % of the nearest pixel), unknown if fewer than two pixels show it; sigma is their mean too, as errors
        of neighbors are much the same. A block may be used if all its pixels may.
        """
        camera = self.camera.halved()
        mask = None if self.mask is None else masks.halved(self.mask)
        blocks = _blocks(self.inverse_depth, camera)
        members = blocks > blocks.max(axis=0) * (1 - SAME_SURFACE)
        count = members.sum(axis=0, dtype=np.float32)
        total = np.where(members, blocks, np.float32(0)).sum(axis=0)
        known = (total > 0) & (count >= 2)
        if mask is not None:
            known &= mask
        inverse_depth = np.where(known, total / np.maximum(count, 1), np.float32(0))
        sigma = None
        if self.depth_sigma_m is not None:
            of_members = np.where(members, _blocks(self.depth_sigma_m, camera), np.float32(0)).sum(axis=0)
            sigma = np.where(known, of_members / np.maximum(count, 1), np.float32(0))
        gray = _blocks(self.gray, camera).sum(axis=0) * np.float32(0.25)
        return Level(camera, gray, inverse_depth, depth_sigma_m=sigma, mask=mask)


@dataclass(frozen=True)
class RgbdPyramid:
    """A frame at several resolutions.

    Attributes:
        levels: the full one first, each next one has half the size.
    """

    levels: tuple[Level, ...]

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
            image: color float32 [h, w, 3] or gray [h, w], 0..1.
            depth_m: float32 [h, w], meters along z; 0, negative or not finite means unknown.
            camera: intrinsics of both images.
            levels: number of resolutions.
            depth_sigma_m: [h, w], meters; None: not known pixel by pixel.
            mask: bool [h, w], pixels that may be used; None: all.
        """
        gray = image @ GRAY_OF_RGB if image.ndim == 3 else np.asarray(image, dtype=np.float32)
        shape = (camera.height, camera.width)
        if gray.shape != shape or depth_m.shape != shape:
            raise ValueError(f"images of {gray.shape} and {depth_m.shape}, camera of {shape}")
        known = np.isfinite(depth_m) & (depth_m > 0)
        if mask is not None:
            known &= mask
        inverse_depth = np.where(known, 1 / np.where(known, depth_m, 1), 0).astype(np.float32)
        if depth_sigma_m is not None:
            depth_sigma_m = np.where(known, depth_sigma_m, 0).astype(np.float32)
        built = [
            Level(camera, np.ascontiguousarray(gray), inverse_depth, depth_sigma_m=depth_sigma_m, mask=mask)
        ]
        while len(built) < levels:
            built.append(built[-1].halved())
        return RgbdPyramid(tuple(built))


def _blocks(image: Image, half: PinholeCamera) -> Image:
    """The four pixels of every 2x2 block, [4, half.height, half.width]."""
    cut = image[: 2 * half.height, : 2 * half.width]
    return np.stack([cut[::2, ::2], cut[::2, 1::2], cut[1::2, ::2], cut[1::2, 1::2]])


def _fit_planes(values: Image, window: int) -> tuple[NDArray, NDArray, NDArray, NDArray[np.bool_]]:
    """Least-squares plane of `values` in a square window around every pixel.

    Returns:
        Slopes along u and v (per px), value at the center, and where the window has no unknown value and no step.
    """
    import cv2

    reach = window // 2
    offsets = np.arange(-reach, reach + 1, dtype=np.float32)
    slope, box = offsets / np.float32((offsets**2).sum()), np.full(window, 1 / window, dtype=np.float32)
    du = cv2.sepFilter2D(values, cv2.CV_32F, slope, box, borderType=cv2.BORDER_CONSTANT)
    dv = cv2.sepFilter2D(values, cv2.CV_32F, box, slope, borderType=cv2.BORDER_CONSTANT)
    mean = cv2.sepFilter2D(values, cv2.CV_32F, box, box, borderType=cv2.BORDER_CONSTANT)
    element = np.ones((window, window), dtype=np.uint8)
    lowest, highest = cv2.erode(values, element), cv2.dilate(values, element)
    smooth = (lowest > 0) & (highest - lowest < SAME_SURFACE * window / 2 * values)
    smooth[:reach] = smooth[-reach:] = False
    smooth[:, :reach] = smooth[:, -reach:] = False
    return du, dv, mean, smooth
