"""Whether two robots, laid into each other by loop closures, see the same textures at the same places.

Rooms with the same furniture agree in shape, and most of what single pairs of views share looks alike. But a surface
that looks different in most pairs of views that show it is another one. So the textured parts of all pairs vote, place
by place. Where a screen or a poster changed between two recordings, the places that look different are all at one spot:
the largest spot does not count.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.posegraph.relative_poses import LoopClosure

EDGE = 0.15
"""Edge of a place, in the median distance of what is seen: about as wide as a part of an image."""
MIN_VOTES = 3
"""Pairs of views that must show a place."""
MIN_PLACES = 50
"""Fewer decide nothing."""


def share_unlike(closures: Sequence[LoopClosure], T_own: Array) -> float:
    """Share of the places that look different to most pairs of views, without those of the largest spot.

    Args:
        closures: m that agree with each other.
        T_own: [m, 4, 4], the own keyframe of each, in any one frame.

    Returns:
        0 to 1; 0 where too few places are known to decide.
    """
    seen = [np.empty((0, 3)), *(c.texture[:, :3] for c in closures)]
    distance_m = np.linalg.norm(np.concatenate(seen), axis=1)
    if not len(distance_m):
        return 0.0
    placed = [p @ T[:3, :3].T + T[:3, 3] for p, T in zip(seen[1:], T_own, strict=True)]
    alike = np.concatenate([c.texture[:, 3] for c in closures])
    cells = np.floor(np.concatenate(placed) / (EDGE * float(np.median(distance_m)))).astype(np.int64)
    places, at, votes = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    known = votes >= MIN_VOTES
    if np.count_nonzero(known) < MIN_PLACES:
        return 0.0
    unlike = known & (2 * np.bincount(at.ravel(), alike) < votes)
    spots = _spots(places[unlike])
    return float((spots.sum() - spots.max(initial=0)) / np.count_nonzero(known))


def _spots(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Numbers of places in each group of places [n, 3] that touch each other."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not len(places):
        return np.zeros(0, dtype=np.int64)
    i, j = cKDTree(places).query_pairs(1.0, p=np.inf, output_type="ndarray").T
    touching = coo_array((np.ones(len(i)), (i, j)), shape=(len(places), len(places)))
    _, spot_of = connected_components(touching, directed=False)
    return np.bincount(spot_of)
