"""Tiles of a large map: keyframes that look at places near each other, and what of the map they see.

The map of a room is one tile. That of a building is cut where its keyframes look, so that each tile has a bounded
number of them; a place that is visited again belongs to the same tiles. Every Gaussian is owned by the tile of the
keyframe that it is anchored to. In other tiles that see it, it is a guest: drawn, trained while the map grows, and left
as it is by the final optimization, in which keyframes of other tiles at the border of a tile take part instead. So
memory and work of a step depend on what a tile sees, and not on the size of the map.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.frontend.growing_map import GrowingMap
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import back_project
from duagc.pipeline.geometry.statistics import evenly_spaced

BLOCKS = 40
"""Blocks across an image in which the farthest depth is kept."""
BEHIND_M, BEHIND = 0.05, 0.02
"""How far behind the farthest depth of its block a Gaussian is still drawn: meters, and a share of that depth."""
SIGMAS = 3.0
"""Radius of a Gaussian, in its largest standard deviation."""
NEAR_M = 0.05
POINTS_APART = 5
"""Blocks between the points of a view that are kept."""
BORDER_SHARE = 0.05
"""Share of the points of a tile from which a view of another tile is at its border."""

Indices = NDArray[np.int64]


def make_tiles(centers_map: Array, most: int) -> list[list[int]]:
    """Keyframes in tiles, cut at the median of the longest side until every tile is small enough.

    Args:
        centers_map: [k, 3], what each keyframe looks at.
        most: keyframes of a tile.

    Returns:
        Indices of the keyframes of every tile, ascending; the tile of the first keyframe is the first.
    """

    def cut(members: Indices) -> list[Indices]:
        if len(members) <= most:
            return [members]
        centers = centers_map[members]
        axis = int(np.argmax(np.ptp(centers, axis=0)))
        order = members[np.argsort(centers[:, axis], kind="stable")]
        half = len(order) // 2
        return [*cut(np.sort(order[:half])), *cut(np.sort(order[half:]))]

    tiles = cut(np.arange(len(centers_map)))
    return sorted(([int(k) for k in tile] for tile in tiles), key=lambda tile: tile[0])


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
        height, width = depth_m.shape[0] // side, depth_m.shape[1] // side
        known = np.where(depth_m > 0, depth_m, np.float32(np.inf))[: height * side, : width * side]
        blocks = known.reshape(height, side, width, side).max(axis=(1, 3))
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
        spread = camera.fx * reach / depth + side
        u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        inside = (u > -spread) & (u < camera.width + spread) & (v > -spread) & (v < camera.height + spread)
        rows, u, v, z, reach = rows[inside], u[inside], v[inside], z[inside], reach[inside]
        column = np.clip(u / side, 0, width - 1).astype(np.int64)
        row = np.clip(v / side, 0, height - 1).astype(np.int64)
        farthest = self.farthest_m[row, column]
        seen[rows] = z - reach <= np.float32(1 + BEHIND) * farthest + np.float32(BEHIND_M)
        return seen


def border_keyframes(
    tile: Sequence[int], others: Iterable[int], views: Sequence[tuple[ViewExtent, Array]], most: int
) -> list[int]:
    """Keyframes of other tiles that look into what a tile shows, evenly spread over all of them, ascending.

    Args:
        tile: its keyframes.
        others: those that may be chosen.
        views: what every keyframe sees, and its pose.
        most: how many.
    """
    points = np.concatenate(
        [se3.transform(T, sight.points_camera).astype(np.float32) for sight, T in (views[k] for k in tile)]
    )
    radii_m = np.zeros(len(points), np.float32)
    least = BORDER_SHARE * len(points)
    near = []
    for k in sorted(set(others) - set(tile)):
        sight, T_map_camera = views[k]
        if np.count_nonzero(sight.sees(points, radii_m, T_map_camera)) >= max(least, 1):
            near.append(k)
    return [near[k] for k in evenly_spaced(len(near), min(most, len(near)))]


def take_tile(
    whole: GrowingMap,
    keyframes: Sequence[int],
    own: Sequence[tuple[ViewExtent, Array]],
    other: Sequence[tuple[ViewExtent, Array]],
) -> GrowingMap:
    """Take out of a map what the views of a tile may see, and all that the tile owns.

    Args:
        whole: the map; it keeps the rest.
        keyframes: of the tile.
        own: what its keyframes see, and their poses.
        other: the same of other views that take part.
    """
    gaussians = whole.gaussians
    owned = np.isin(gaussians.anchors, np.asarray(keyframes))
    strangers = np.flatnonzero(~owned)
    counted = _seen(strangers, whole, own)
    left = np.setdiff1d(strangers, counted)
    uncounted = _seen(left, whole, other)
    return whole.take(np.concatenate([uncounted, counted]), np.flatnonzero(owned), len(uncounted))


def _seen(rows: Indices, whole: GrowingMap, views: Sequence[tuple[ViewExtent, Array]]) -> Indices:
    """Those of some Gaussians that some view may see."""
    means = whole.gaussians.means[rows]
    radii_m = np.float32(SIGMAS) * np.exp(whole.gaussians.log_scales[rows].max(axis=1, initial=-np.inf))
    seen = np.zeros(len(rows), np.bool_)
    for sight, T_map_camera in views:
        left = np.flatnonzero(~seen)
        seen[left] = sight.sees(means[left], radii_m[left], T_map_camera)
    return rows[seen]
