"""How images move, by the path of their camera: those taken slowly are the sharpest."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import Trajectory

MOST_BEFORE = 16
"""Cameras before the one that they share: of a camera that stands still, few pairs are compared."""


def image_shift(T_map_first: Array, T_map_second: Array, distance_m: float) -> Array:
    """How far images move between cameras, rad [...]: by the turn, and by the shift seen at a distance.

    Args:
        T_map_first: [..., 4, 4].
        T_map_second: the same.
        distance_m: of what is seen.
    """
    moved = se3.log(se3.inverse(T_map_first) @ T_map_second)
    turn, shift = np.linalg.norm(moved[..., 3:], axis=-1), np.linalg.norm(moved[..., :3], axis=-1)
    return np.asarray(turn + shift / distance_m)


def nearby_cameras(T_map_camera: Array, distance_m: float, most_rad: float) -> NDArray[np.int64]:
    """For every camera of a path one near it, few in all: an image drawn there serves for all that are near it.

    Cameras one after the other have the same: the last one that the few before it are all near.

    Args:
        T_map_camera: [n, 4, 4].
        distance_m: of what is seen.
        most_rad: `image_shift` up to which a camera is near.

    Returns:
        Their places in the path, [n].
    """
    near, first = np.empty(len(T_map_camera), dtype=np.int64), 0

    def is_near(these: slice, place: int) -> bool:
        return bool((image_shift(T_map_camera[these], T_map_camera[place], distance_m) <= most_rad).all())

    while first < len(near):
        middle = first
        until = min(first + MOST_BEFORE, len(near) - 1)
        while middle < until and is_near(slice(first, middle + 1), middle + 1):
            middle += 1
        last = middle + 1
        while last < len(near) and is_near(slice(last, last + 1), middle):
            last += 1
        near[first:last] = middle
        first = last
    return near


def image_speeds(path: Trajectory, distance_m: float) -> Array:
    """Speed of the image, rad/s [n], at every pose: `image_shift` by time.

    Between the poses before and after; at an end of the path from or to the pose itself.

    Args:
        path: T_map_camera.
        distance_m: of what is seen.
    """
    count = len(path)
    if count < 2:
        return np.zeros(count)
    before = np.maximum(np.arange(count) - 1, 0)
    after = np.minimum(np.arange(count) + 1, count - 1)
    seconds = 1e-9 * (path.stamps_ns[after] - path.stamps_ns[before])
    return np.asarray(image_shift(path.poses[before], path.poses[after], distance_m) / seconds)


def slowest_of_parts(speeds: Sequence[float] | Array, count: int) -> list[int]:
    """The slowest of each of `count` equal parts of a sequence, ascending; of equal ones the first.

    Args:
        speeds: of what is chosen from.
        count: number of things chosen, at most as many as there are.
    """
    bounds = [k * len(speeds) // count for k in range(count + 1)] if count else []
    return [first + int(np.argmin(speeds[first:last])) for first, last in pairwise(bounds)]
