"""How far points are from the surfaces that depth images show."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.row_blocks import row_blocks
from duagc.pipeline.base.shelf import ShelvedList
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import back_project, visible

Distances: TypeAlias = tuple[NDArray[np.int64], Array]
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


def median_distances(
    points: Array, camera: PinholeCamera, views: Iterable[DepthView], gate_m: float
) -> tuple[NDArray[np.int64], Array]:
    """How many views measured a surface near each point [n], and the median of its signed distances, meters [n].

    A view measures the signed distance of a point from the tangent plane at its pixel (of the depth's median over
    5 x 5 px). The median over all views that measured a surface within the gate is what is left of it when the noise of
    the sensor is averaged out; not the mean, because at an edge some views look past a point at another surface. It is
    0 where no view measured one.

    Args:
        points: [n, 3], in the frame of the poses.
        camera: of the views.
        views: the more, the less noise is left.
        gate_m: a surface farther than this from a point belongs to something else.
    """
    near = ShelvedList(_near_surfaces(points, camera, views, gate_m))
    counts, median_m = np.zeros(len(points), np.int64), np.zeros(len(points))
    for block in row_blocks(len(points)):
        counts[block], median_m[block] = _medians(near, block)
    return counts, median_m


def _near_surfaces(
    points: Array, camera: PinholeCamera, views: Iterable[DepthView], gate_m: float
) -> Iterator[Distances]:
    """Of every view the rows of the points near a surface that it measured, ascending, and signed distances."""
    import cv2

    for view in views:
        smooth = np.asarray(cv2.medianBlur(np.ascontiguousarray(view.depth_m), MEDIAN_PX), dtype=np.float32)
        seen = se3.transform(se3.inverse(view.T_map_camera), points)
        rows, distance_m = _from_tangent_planes(seen, smooth, camera)
        near = np.abs(distance_m) < gate_m
        yield rows[near], distance_m[near]


def _medians(near: Sequence[Distances], block: slice) -> tuple[NDArray[np.int64], Array]:
    """How many views measured a surface near each point of some rows, and the median of its signed distances."""
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
