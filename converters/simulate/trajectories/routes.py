"""Smooth paths over the free floor of a scene, along the middle of rooms and doors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from duagc.pipeline.base.arrays import Array

if TYPE_CHECKING:
    from scipy.sparse import coo_array

    from duagc.converters.simulate.trajectories.walks import WalkableSpace

HOP_M = 2.0  # least distance between places that a route visits
SMOOTH_M = 0.35
ROUTE_STEP_M = 0.025  # between the points of a route
MOST_TURNS = 4.0  # a route may be so many times as long before it is smoothed


def route(
    space: WalkableSpace, graph: coo_array, length_m: float, rng: np.random.Generator, *, least_m: float = 0.0
) -> Array:
    """A path over the floor [n, 2] through places drawn at random, smoothed, ROUTE_STEP_M apart.

    Args:
        space: where a robot can stand.
        graph: its graph, by rows.
        length_m: least length before the corners are smoothed, which shortens it.
        rng: draws the places.
        least_m: least length of the smoothed path; missed where that is less than a part of the way, 1 / MOST_TURNS.
    """
    from scipy.ndimage import gaussian_filter1d
    from scipy.sparse.csgraph import dijkstra

    here = int(rng.integers(len(space.cells)))
    cells, total = [here], 0.0
    while True:
        while total < length_m:
            _, before = dijkstra(graph, directed=False, indices=here, return_predecessors=True)
            far = np.linalg.norm(space.cells - space.cells[here], axis=1) >= HOP_M
            choice = np.flatnonzero(far) if far.any() else np.setdiff1d(np.arange(len(space.cells)), [here])
            leg = [int(rng.choice(choice))]
            while leg[-1] != here:
                leg.append(int(before[leg[-1]]))
            cells += leg[-2::-1]
            here = cells[-1]
            total = float(np.linalg.norm(np.diff(space.cells[cells], axis=0), axis=1).sum())
        path = _resampled(space.cells[cells], ROUTE_STEP_M)
        path = gaussian_filter1d(path, SMOOTH_M / ROUTE_STEP_M, axis=0, mode="nearest")
        path = _resampled(path, ROUTE_STEP_M)
        lacks_m = least_m - length_of(path)
        if lacks_m <= 0 or total >= MOST_TURNS * least_m:
            return path
        length_m = total + lacks_m


def length_of(route: Array) -> float:
    """Length (m) of a path.

    Args:
        route: [n, 2], as from `route`, ROUTE_STEP_M apart.
    """
    return ROUTE_STEP_M * (len(route) - 1)


def _resampled(path: Array, step_m: float) -> Array:
    """Points of a polyline [n, 2] at equal distances along it."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(along) > 1e-9])
    wanted = np.arange(0.0, along[-1], step_m)
    return np.stack([np.interp(wanted, along[keep], path[keep, k]) for k in range(2)], axis=1)
