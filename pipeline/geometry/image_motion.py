"""How fast images move, by the path of their camera: those taken slowly are the sharpest."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import Trajectory


def image_speeds(path: Trajectory, distance_m: float) -> Array:
    """Speed of the image, rad/s [n], at every pose: that of the turn, and that of the shift seen at a distance.

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
    moved = se3.log(se3.inverse(path.poses[before]) @ path.poses[after])
    seconds = 1e-9 * (path.stamps_ns[after] - path.stamps_ns[before])
    return np.asarray(
        (np.linalg.norm(moved[:, 3:], axis=1) + np.linalg.norm(moved[:, :3], axis=1) / distance_m) / seconds
    )


def slowest_of_parts(speeds: Sequence[float] | Array, count: int) -> list[int]:
    """The slowest of each of `count` equal parts of a sequence, ascending; of equal ones the first.

    Args:
        speeds: of what is chosen from.
        count: number of things chosen, at most as many as there are.
    """
    bounds = [k * len(speeds) // count for k in range(count + 1)] if count else []
    return [first + int(np.argmin(speeds[first:last])) for first, last in pairwise(bounds)]
