"""Samples that a view is registered to: a point, a normal and an intensity each, at every pyramid level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry import masks
from duagc.pipeline.geometry.projection import back_project
from duagc.pipeline.registration.pyramid import Level, RgbdPyramid

Samples = NDArray[np.floating]

DEFAULT_STRIDES = (4, 2, 1)
GRADIENT_SHARE = 2 / 3  # of a sparse reference's samples; the rest is spread evenly for the geometry
USUAL_CONTRAST = 0.1  # least standard deviation of gray values (0..1) of a well exposed view of a room
MARGIN = 2  # pixels at the border that are not sampled


def sampled_grid(width: int, height: int, stride: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the pixels that a reference samples where normals are known.

    Args:
        width: of the image, pixels.
        height: of the image, pixels.
        stride: pixels between samples.
    """
    return np.arange(MARGIN, height - MARGIN, stride), np.arange(MARGIN, width - MARGIN, stride)


@dataclass(frozen=True)
class ReferenceLevel:
    """Samples for one pyramid level.

    Attributes:
        points: float32 [n, 3], meters, reference camera frame.
        normals: float32 [n, 3], unit length, same frame.
        intensities: float32 [n], gray value 0..1 of that level's image at the sample.
        depth_sigmas: float32 [n], meters; None: not known sample by sample.
    """

    points: Samples
    normals: Samples
    intensities: Samples
    depth_sigmas: Samples | None = None

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class Reference:
    """Samples of one view: plain arrays, so that it can be sent and rebuilt.

    Attributes:
        levels: one entry per pyramid level, the finest first.
        inverse_depth_sigma: standard deviation of the inverse depth of what is far, 1/m; None: not known.
    """

    levels: tuple[ReferenceLevel, ...]
    inverse_depth_sigma: float | None = None

    @property
    def contrast(self) -> float:
        """Share of the usual contrast, 0..1, by the coarsest level, where noise of pixels is averaged out."""
        intensities = self.levels[-1].intensities
        return min(float(intensities.std()) / USUAL_CONTRAST, 1.0) if len(intensities) else 0.0

    @staticmethod
    def from_pyramid(pyramid: RgbdPyramid, strides: tuple[int, ...] = DEFAULT_STRIDES) -> Reference:
        """Sample every level on a grid, wherever a normal is known.

        Args:
            pyramid: of the view.
            strides: pixels between samples, finest level first.
        """
        levels = []
        for index, (level, stride) in enumerate(zip(pyramid.levels, strides, strict=True)):
            rows, columns = sampled_grid(level.camera.width, level.camera.height, stride)
            v, u = (axis.ravel() for axis in np.meshgrid(rows, columns, indexing="ij"))
            surfaces = _Surfaces.at(pyramid, index, (rows, columns), level.normals_at(rows, columns))
            known = np.flatnonzero(surfaces.normals[..., 2])
            levels.append(_samples(level, v[known], u[known], surfaces.chosen(known)))
        return Reference(tuple(levels), pyramid.inverse_depth_sigma)

    @staticmethod
    def sample(pyramid: RgbdPyramid, count: int = 2000) -> Reference:
        """About `count` samples, the same points and normals at every level, for sending to another robot.

        Two thirds are the pixels of strongest gray gradient in the tiles of a grid, one third is spread evenly
        over a coarser grid, so that weakly textured surfaces still determine the geometry. No random draws.
        Tiles have whole pixels: of 640x480, 4 % more than `count` are taken, of 160x120 42 %, and never three times
        as many.

        Args:
            pyramid: of the view.
            count: number of samples.
        """
        finest = pyramid.levels[0]
        gu, gv = finest.gradients
        whole = np.arange(finest.camera.height), np.arange(finest.camera.width)
        surfaces = _Surfaces.at(pyramid, 0, whole, finest.normals)
        known = _has_normal(surfaces.normals) & _usable_at_all_levels(pyramid)
        strength = np.where(known, np.sqrt(gu * gu + gv * gv), np.float32(-1))
        textured = round(count * GRADIENT_SHARE)
        chosen = np.union1d(
            _strongest_of_tiles(strength, textured), _centers_of_tiles(known, count - textured)
        )
        v, u = np.divmod(chosen, finest.camera.width)
        samples = _samples(finest, v, u, surfaces.chosen(chosen))
        levels = [samples]
        for index, level in enumerate(pyramid.levels[1:], start=1):
            scale = 2.0**index
            gray = bilinear(level.gray, (u + 0.5) / scale - 0.5, (v + 0.5) / scale - 0.5)
            levels.append(ReferenceLevel(samples.points, samples.normals, gray, samples.depth_sigmas))
        return Reference(tuple(levels), pyramid.inverse_depth_sigma)


@dataclass(frozen=True)
class _Surfaces:
    """What is seen at the pixels of a grid.

    Attributes:
        normals: [r, c, 3], or [n, 3] of chosen ones; zero where unknown.
        inverse_depth: [r, c], or [n], 1/m.
    """

    normals: Samples
    inverse_depth: Samples

    @staticmethod
    def at(
        pyramid: RgbdPyramid, index: int, pixels: tuple[NDArray[np.intp], NDArray[np.intp]], normals: Samples
    ) -> _Surfaces:
        """At rows and columns, with normals by the level, or by wide windows where noise hides surfaces from it."""
        level, wide = pyramid.levels[index], pyramid.wide_surfaces
        inverse_depth = level.inverse_depth[np.ix_(*pixels)]
        if wide is not None:
            factor = 1 << (len(pyramid.levels) - 1 - index)
            normals, inverse_depth = wide.instead(
                normals, inverse_depth, pixels=pixels, camera=level.camera, factor=factor
            )
        return _Surfaces(normals, inverse_depth)

    def chosen(self, index: NDArray[np.intp]) -> _Surfaces:
        """Those of flat indices [n]."""
        return _Surfaces(self.normals.reshape(-1, 3)[index], self.inverse_depth.ravel()[index])


def _has_normal(normals: Samples) -> NDArray[np.bool_]:
    """Pixels [h, w] off the border whose normal, of [h, w, 3], is known."""
    known = normals[..., 2] != 0
    known[:MARGIN] = known[-MARGIN:] = False
    known[:, :MARGIN] = known[:, -MARGIN:] = False
    return known


def _usable_at_all_levels(pyramid: RgbdPyramid) -> NDArray[np.bool_]:
    """Pixels [h, w] of the finest level around which the pixels of every coarser one may be used."""
    finest, coarsest = pyramid.levels[0], pyramid.levels[-1]
    usable = np.ones(finest.gray.shape, dtype=bool)
    if coarsest.mask is not None:
        scale = 2 ** (len(pyramid.levels) - 1)
        whole = masks.whole_windows(coarsest.mask, 1).repeat(scale, axis=0).repeat(scale, axis=1)
        # a last odd row or column is in no coarse pixel
        usable[: whole.shape[0], : whole.shape[1]] = whole
    return usable


def _samples(level: Level, v: NDArray[np.int64], u: NDArray[np.int64], surfaces: _Surfaces) -> ReferenceLevel:
    """The samples at pixels (u, v), each [n], of the surfaces there."""
    camera, z = level.camera, 1 / surfaces.inverse_depth.astype(np.float64)
    points = back_project(camera, u, v, z)
    sigmas = None if level.depth_sigma_m is None else level.depth_sigma_m[v, u]
    return ReferenceLevel(points.astype(np.float32), surfaces.normals, level.gray[v, u], sigmas)


def _tiles(image: Samples, count: int) -> tuple[Samples, int, NDArray[np.int64]]:
    """About `count` square tiles of an image [h, w]: values [tiles, side * side], side (px), flat pixel indices."""
    h, w = image.shape
    side = max(1, int(np.sqrt(h * w / max(count, 1))))
    rows, columns = -(-h // side), -(-w // side)
    padded = np.full((rows * side, columns * side), -1, dtype=np.float32)
    padded[:h, :w] = image
    index = np.full(padded.shape, -1, dtype=np.int64)
    index[:h, :w] = np.arange(h * w).reshape(h, w)

    def split(a: NDArray) -> NDArray:
        return a.reshape(rows, side, columns, side).swapaxes(1, 2).reshape(rows * columns, side * side)

    return split(padded), side, split(index)


def _strongest_of_tiles(score: Samples, count: int) -> NDArray[np.int64]:
    """Flat index of the highest non-negative score in every tile that has one."""
    values, _, index = _tiles(score, count)
    best = values.argmax(axis=1)
    tiles = np.arange(len(values))
    return index[tiles, best][values[tiles, best] >= 0]


def _centers_of_tiles(known: NDArray[np.bool_], count: int) -> NDArray[np.int64]:
    """Flat index of the known pixel nearest to the center of every tile that has one."""
    values, side, index = _tiles(np.where(known, np.float32(0), np.float32(-1)), count)
    offset = np.arange(side) - (side - 1) / 2
    distance = (offset[:, None] ** 2 + offset**2).ravel()
    best = np.where(values >= 0, distance, np.inf).argmin(axis=1)
    tiles = np.arange(len(values))
    return index[tiles, best][values[tiles, best] >= 0]


def bilinear(image: Samples, u: NDArray[np.float64], v: NDArray[np.float64]) -> Samples:
    """Image at pixels between its own, clamped to the border.

    Args:
        image: [h, w].
        u: columns [n].
        v: rows [n].
    """
    h, w = image.shape
    u, v = np.clip(u, 0, w - 1), np.clip(v, 0, h - 1)
    u0, v0 = np.minimum(u.astype(np.int64), w - 2), np.minimum(v.astype(np.int64), h - 2)
    a, b = u - u0, v - v0
    top = (1 - a) * image[v0, u0] + a * image[v0, u0 + 1]
    bottom = (1 - a) * image[v0 + 1, u0] + a * image[v0 + 1, u0 + 1]
    return ((1 - b) * top + b * bottom).astype(np.float32)
