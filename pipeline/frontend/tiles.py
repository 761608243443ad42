"""Tiles of a large map: keyframes that look at places near each other, and what of the map they see.

The map of a room is one tile. That of a building is cut where its keyframes look, so that each tile has a bounded
number of them; a place that is visited again belongs to the same tiles. Every Gaussian is owned by the tile of the
keyframe that it is anchored to. In other tiles that see it, it is a guest: drawn, trained while the map grows, and left
as it is by the final optimization, in which keyframes of other tiles at the border of a tile take part instead. So
memory and work of a step depend on what a tile sees, and not on the size of the map.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.frontend.growing_map import GrowingMap, Indices
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.geometry.view_extent import ViewExtent, radii_m

BORDER_SHARE = 0.05
"""Share of the points of a tile from which a view of another tile is at its border."""


def make_tiles(centers_map: Array, most: int) -> list[list[int]]:
    """Keyframes in as few tiles as possible, cut across the longest side again and again, about equally large.

    Args:
        centers_map: [k, 3], what each keyframe looks at.
        most: keyframes of a tile.

    Returns:
        Indices of the keyframes of every tile, ascending; the tile of the first keyframe is the first.
    """

    def cut(members: Indices, parts: int) -> list[Indices]:
        if parts <= 1:
            return [members]
        centers = centers_map[members]
        axis = int(np.argmax(np.ptp(centers, axis=0)))
        order = members[np.argsort(centers[:, axis], kind="stable")]
        lower = parts // 2
        first = len(order) * lower // parts
        return [*cut(np.sort(order[:first]), lower), *cut(np.sort(order[first:]), parts - lower)]

    tiles = cut(np.arange(len(centers_map)), -(-len(centers_map) // most))
    return sorted(([int(k) for k in tile] for tile in tiles), key=lambda tile: tile[0])


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
    radii = radii_m(whole.gaussians.log_scales[rows])
    seen = np.zeros(len(rows), np.bool_)
    for sight, T_map_camera in views:
        left = np.flatnonzero(~seen)
        seen[left] = sight.sees(means[left], radii[left], T_map_camera)
    return rows[seen]
