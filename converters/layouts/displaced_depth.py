"""Depth for a color camera displaced along x: rows map to rows, and every row is drawn again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera

Depth = Array

STRIP_ROWS = 32  # drawn at a time: what is computed of them stays in the cache
CONNECTED_RATIO = 0.03  # neighboring depths that differ by less than this share of the nearer are one surface


class DepthRegistration:
    """Resamples depth for a camera displaced along x, with another focal length and principal point.

    With w = 1 / z a point of depth pixel (u, v) falls on color column A u + B - f b w and row A v + C: rows map to
    rows. First the rows are resampled, then each row is redrawn as a chain of segments between neighbors. Inverse
    depth is interpolated, in which planes are linear, and only within a surface (CONNECTED_RATIO); where surfaces
    overlap the nearest wins; at the border of a surface a pixel covers half its width.
    """

    def __init__(self, depth_camera: PinholeCamera, color_camera: PinholeCamera, baseline_m: float) -> None:
        d, c = depth_camera, color_camera
        self._zoom = c.fx / d.fx
        self._offset = c.cx - self._zoom * d.cx
        self._shift_px_m = c.fx * baseline_m
        self._shape = (c.height, c.width)
        row = (np.arange(c.height) - c.cy) * (d.fy / c.fy) + d.cy
        self._row_near = np.clip(np.floor(row).astype(int), 0, d.height - 2)
        self._row_part = (row - self._row_near)[:, None]
        self._row_inside = ((row >= -0.5) & (row <= d.height - 0.5))[:, None]
        self._columns = np.arange(d.width)

    def __call__(self, depth: Depth) -> Depth:
        """Depth [h, w] in meters of the depth camera, 0 where none -> depth [H, W] in meters of the color camera."""
        with np.errstate(divide="ignore"):
            w = np.where(depth > 0, 1.0 / depth, 0.0)
        out = np.zeros(self._shape)
        for top in range(0, len(out), STRIP_ROWS):
            rows = slice(top, top + STRIP_ROWS)
            self._draw_segments(self._resample_rows(w, rows), out[rows])
        with np.errstate(divide="ignore"):
            return np.where(out > 0, 1.0 / out, 0.0)

    def _resample_rows(self, w: Depth, rows: slice) -> Depth:
        upper, lower, part = w[self._row_near[rows]], w[self._row_near[rows] + 1], self._row_part[rows]
        nearest = np.where(part < 0.5, upper, lower)
        between = _connected(upper, lower) & (part >= 0) & (part <= 1)
        return np.where(
            self._row_inside[rows], np.where(between, upper + part * (lower - upper), nearest), 0.0
        )

    def _draw_segments(self, w: Depth, out: Depth) -> None:
        x = self._zoom * self._columns + self._offset - self._shift_px_m * w
        left, right, w_left, w_right = x[:, :-1], x[:, 1:], w[:, :-1], w[:, 1:]
        joined = _connected(w_left, w_right)
        first = np.ceil(left)
        for column in (first, first + 1):  # connected neighbors are less than two columns apart
            inside = joined & (column <= right)
            part = (column - left) / np.where(right > left, right - left, 1.0)
            self._keep_nearest(out, inside, column, w_left + part * (w_right - w_left))
        half = 0.5 * self._zoom
        nearest = np.rint(x)
        border_left = np.ones(w.shape, bool)
        border_left[:, 1:] = ~joined
        border_right = np.ones(w.shape, bool)
        border_right[:, :-1] = ~joined
        covered = np.where(nearest < x, border_left, border_right) & (np.abs(nearest - x) <= half)
        self._keep_nearest(out, covered & (w > 0), nearest, w)

    def _keep_nearest(self, out: Depth, mask: NDArray[np.bool_], column: Depth, w: Depth) -> None:
        drawn = np.flatnonzero(mask & (column >= 0) & (column < self._shape[1]))
        rows, columns = drawn // mask.shape[1], column.ravel()[drawn].astype(np.int64)
        np.maximum.at(out.ravel(), rows * out.shape[1] + columns, w.ravel()[drawn])


def _connected(w_a: Depth, w_b: Depth) -> NDArray[np.bool_]:
    """Whether two inverse depths belong to one surface; no measurement belongs to none."""
    return (w_a > 0) & (w_b > 0) & (np.abs(w_a - w_b) <= CONNECTED_RATIO * np.minimum(w_a, w_b))
