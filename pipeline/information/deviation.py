"""How far a map's Gaussians are from the surfaces that the depth images show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.row_blocks import row_blocks
from duagc.pipeline.base.shelf import ShelvedList
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import back_project, visible
from duagc.pipeline.information.views import MapViews

Distances: TypeAlias = tuple[NDArray[np.int64], NDArray[np.float64]]
MEDIAN_PX = 5
NEAR_M = 0.05  # points closer to a camera than this are not judged by it


def surface_deviation(views: MapViews, gate_m: float) -> NDArray[np.float64]:
    """How far every Gaussian's mean is from the surface that the depth images show, meters [n].

    Overlapping splats compensate for each other's positions: where their sum is drawn to a millimeter, each may be a
    centimeter off, and no pixel shows it. The depth image does: the deviation is the median, over the views that
    measured a surface within the gate, of the mean's distance from the tangent plane at its pixel (of the depth's
    median over 5 x 5 px, or the sensor's noise would pass for the map's deviation). Not the root mean square: at an
    edge some views look past a Gaussian at another surface. The median over all Gaussians counts as half a view more; a
    Gaussian that no view measured has the gate.

    Args:
        views: the map and its images.
        gate_m: a surface farther than this from a Gaussian belongs to another one.
    """
    near = ShelvedList(_near_surfaces(views, gate_m))
    n = len(views.gaussians)
    count, median = np.zeros(n, np.int64), np.zeros(n)
    for block in row_blocks(n):
        count[block], median[block] = _medians(near, block)
    measured = count > 0
    deviation_m = np.full(n, gate_m)
    if measured.any():
        views_of, median = count[measured], median[measured]
        typical = np.median(median)
        deviation_m[measured] = np.sqrt((views_of * median**2 + 0.5 * typical**2) / (views_of + 0.5))
    return deviation_m


def _near_surfaces(views: MapViews, gate_m: float) -> Iterator[Distances]:
    """Of every view the rows of the Gaussians near a surface that it measured, ascending, and their distances."""
    import cv2

    means = views.gaussians.means.astype(np.float64)
    for image in views.images:
        usable = image.depth_m if image.mask is None else np.where(image.mask, image.depth_m, np.float32(0))
        smooth = np.asarray(cv2.medianBlur(np.ascontiguousarray(usable), MEDIAN_PX), dtype=np.float32)
        points = se3.transform(se3.inverse(image.T_world_camera), means)
        rows, distance_m = _from_tangent_planes(points, smooth, views.camera)
        near = np.abs(distance_m) < gate_m
        yield rows[near], np.abs(distance_m[near])


def _medians(near: Sequence[Distances], block: slice) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """How many views measured a surface near each Gaussian of some rows, and the median of its distances there."""
    all_rows, all_distances = [np.zeros(0, np.int64)], [np.zeros(0)]
    for rows, distance_m in near:
        part = slice(*np.searchsorted(rows, (block.start, block.stop)))
        all_rows.append(rows[part] - block.start)
        all_distances.append(distance_m[part])
    rows, distance_m = np.concatenate(all_rows), np.concatenate(all_distances)
    distance_m = distance_m[np.lexsort((distance_m, rows))]
    count = np.bincount(rows, minlength=block.stop - block.start)
    median = np.zeros(len(count))
    measured = count > 0
    first = (np.cumsum(count) - count)[measured]
    median[measured] = distance_m[first + (count[measured] - 1) // 2]
    return count, median


def _from_tangent_planes(
    points_camera: NDArray[np.float64], depth_m: NDArray[np.float32], camera: PinholeCamera
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows of the points whose pixel and its neighbors two pixels off were measured, and their distances, meters."""
    rows, u, v = visible(camera, points_camera, NEAR_M, margin_px=2)

    def surface(du: int, dv: int) -> NDArray[np.float64]:
        return back_project(camera, u + du, v + dv, depth_m[v + dv, u + du].astype(np.float64))

    at, right, left, below, above = (surface(*d) for d in ((0, 0), (2, 0), (-2, 0), (0, 2), (0, -2)))
    normal = np.cross(right - left, below - above)
    length = np.linalg.norm(normal, axis=1)
    measured = (length > 0) & np.all([p[:, 2] > 0 for p in (at, right, left, below, above)], axis=0)
    off = np.sum(normal * (points_camera[rows] - at), axis=1) / np.where(length > 0, length, 1.0)
    return rows[measured], off[measured]
