"""How far a map's Gaussians are from the surfaces that the depth images show."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.row_blocks import row_blocks
from duagc.pipeline.base.shelf import ShelvedList
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import back_project, visible
from duagc.pipeline.splat.gaussians import Gaussians

Distances: TypeAlias = tuple[NDArray[np.int64], NDArray[np.float64]]
MEDIAN_PX = 5
NEAR_M = 0.05  # points closer to a camera than this are not judged by it


@dataclass(frozen=True)
class DepthView:
    """A depth image with the pose that it was taken from.

    Attributes:
        depth_m: float32 [H, W], meters, 0 where nothing was measured, or where it is not of the map.
        T_map_camera: [4, 4].
    """

    depth_m: NDArray[np.float32]
    T_map_camera: NDArray[np.float64]


def surface_deviation(
    gaussians: Gaussians, camera: PinholeCamera, views: Iterable[DepthView], gate_m: float
) -> NDArray[np.float64]:
    """How far every Gaussian's mean is from the surface that the depth images show, meters [n].

    Overlapping splats compensate for each other's positions: where their sum is drawn to a millimeter, each may be a
    centimeter off, and no pixel shows it. Depth images do: a view measures the signed distance of the mean from the
    tangent plane at its pixel (of the depth's median over 5 x 5 px). The median over all views that measured a surface
    within the gate is what is left of it when the noise of the sensor is averaged out; not the mean, because at an edge
    some views look past a Gaussian at another surface. What no view shows, because neighbors or all views share it,
    counts as half of what is typical: of the median of these distances over all Gaussians. A Gaussian that no view
    measured has the gate.

    Args:
        gaussians: of a map.
        camera: of the views.
        views: of the robot that made the map, in its frame; the more, the less noise is left.
        gate_m: a surface farther than this from a Gaussian belongs to another one.
    """
    near = ShelvedList(_near_surfaces(gaussians, camera, views, gate_m))
    n = len(gaussians)
    measured, off_m = np.zeros(n, bool), np.zeros(n)
    for block in row_blocks(n):
        measured[block], off_m[block] = _medians(near, block)
    deviation_m = np.full(n, gate_m)
    if measured.any():
        typical_m = np.median(np.abs(off_m[measured]))
        deviation_m[measured] = np.hypot(off_m[measured], 0.5 * typical_m)
    return deviation_m


def _near_surfaces(
    gaussians: Gaussians, camera: PinholeCamera, views: Iterable[DepthView], gate_m: float
) -> Iterator[Distances]:
    """Of every view the rows of the Gaussians near a surface that it measured, ascending, and signed distances."""
    import cv2

    means = gaussians.means.astype(np.float64)
    for view in views:
        smooth = np.asarray(cv2.medianBlur(np.ascontiguousarray(view.depth_m), MEDIAN_PX), dtype=np.float32)
        points = se3.transform(se3.inverse(view.T_map_camera), means)
        rows, distance_m = _from_tangent_planes(points, smooth, camera)
        near = np.abs(distance_m) < gate_m
        yield rows[near], distance_m[near]


def _medians(near: Sequence[Distances], block: slice) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Whether a view measured a surface near each Gaussian of some rows, and the median of its signed distances."""
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
    lower, upper = (distance_m[first + (count[measured] - k) // 2] for k in (1, 0))
    median[measured] = 0.5 * (lower + upper)
    return measured, median


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
