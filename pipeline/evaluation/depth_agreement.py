"""How well depth images agree with each other under a trajectory: a measure that needs no ground truth.

Points of one view are moved into another by the poses and compared with the depth measured there. Noise and calibration
of the depth camera bound the number from below; beyond that it is the error of the relative poses. It also judges the
ground truth, whose poses may be worse than the estimate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import inside

Depth = NDArray[np.float32]

STRIDE_PX = 8
MIN_VIEW = 0.3
"""Share of a view's points that must fall into the other image, under every trajectory that is compared."""
MIN_POINTS = 200
MIN_PAIRS = 10
SAME_SURFACE = 0.05
"""Relative difference up to which neighboring depths are interpolated."""


def depth_agreement(
    depths_m: Sequence[Depth], camera: PinholeCamera, trajectories: Mapping[str, Array]
) -> tuple[int, dict[str, float | Absent]]:
    """Median over pairs of views of the median absolute difference of predicted and measured depth, meters.

    All trajectories are judged on the same pairs: those of which each view shows enough of the other under all of them.
    No gate: what is hidden counts too, and the median bears it.

    Args:
        depths_m: [h, w] of every view, 0 = unknown.
        camera: of the views.
        trajectories: T_frame_camera [n, 4, 4] of the same views, by name.
    Returns:
        Number of pairs, and the value of every trajectory.
    """
    found = pair_medians(depths_m, camera, trajectories)
    if len(found.pairs) < MIN_PAIRS:
        absent = Absent(f"only {len(found.pairs)} pairs of held-out views overlap, {MIN_PAIRS} are needed")
        return len(found.pairs), dict.fromkeys(trajectories, absent)
    return len(found.pairs), {name: float(np.median(values)) for name, values in found.of.items()}


@dataclass(frozen=True)
class PairMedians:
    """pairs: of views that are judged under all trajectories. of: their medians [pairs], meters, by trajectory."""

    pairs: list[tuple[int, int]]
    of: dict[str, Array]


def pair_medians(
    depths_m: Sequence[Depth], camera: PinholeCamera, trajectories: Mapping[str, Array]
) -> PairMedians:
    """What `depth_agreement` takes the median of.

    Args:
        depths_m: [h, w] of every view, meters along z, 0 = unknown.
        camera: of the views.
        trajectories: T_frame_camera [n, 4, 4] of the same views, by name.
    """
    inverse = [np.where(d > 0, 1 / np.where(d > 0, d, 1), np.nan) for d in depths_m]
    images = [(i, _points(d, camera)) for i, d in zip(inverse, depths_m, strict=True)]
    pairs: list[tuple[int, int]] = []
    medians: dict[str, list[float]] = {name: [] for name in trajectories}
    for a, b in combinations(range(len(depths_m)), 2):
        found: dict[str, float] = {}
        for name, T in trajectories.items():
            difference_m = _difference_m(images[a], images[b], se3.inverse(T[a]) @ T[b], camera)
            if difference_m is None:
                break
            found[name] = difference_m
        else:
            pairs.append((a, b))
            for name, difference_m in found.items():
                medians[name].append(difference_m)
    return PairMedians(pairs, {name: np.array(values) for name, values in medians.items()})


def _points(depth_m: Depth, camera: PinholeCamera) -> Array:
    """Points [n, 3] of every STRIDE_PX-th pixel with depth, camera frame."""
    part = np.zeros(depth_m.shape, dtype=bool)
    part[STRIDE_PX // 2 :: STRIDE_PX, STRIDE_PX // 2 :: STRIDE_PX] = True
    part &= depth_m > 0
    return np.asarray(camera.rays()[part] * depth_m[part][:, None].astype(np.float64))


def _difference_m(
    a: tuple[Array, Array], b: tuple[Array, Array], T_a_b: Array, camera: PinholeCamera
) -> float | None:
    """Median absolute difference of depth of a pair, both ways together; None if it shows too little in common.

    Args:
        a: inverse depth [h, w] (1/m) and points [n, 3] (m, camera frame) of the first image.
        b: the same of the second.
        T_a_b: from the second camera to the first.
        camera: of both.
    """
    inverse_a, points_a = a
    inverse_b, points_b = b
    there = _compare(inverse_a, se3.transform(T_a_b, points_b), camera)
    if there is None:
        return None
    back = _compare(inverse_b, se3.transform(se3.inverse(T_a_b), points_a), camera)
    if back is None:
        return None
    return float(np.median(np.abs(np.concatenate([there, back]))))


def _compare(inverse_depth: Array, points: Array, camera: PinholeCamera) -> Array | None:
    """Measured minus predicted depth of points in the frame of an image, where it was measured."""
    if not len(points):
        return None
    x, y, z = np.ascontiguousarray(points.T)  # three rows are read faster than columns
    if not (front := z > 0.05).all():
        x, y, z = x[front], y[front], z[front]
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    # all four pixels around it; the last row and column have none after them
    seen = np.flatnonzero(inside(u, v, (camera.height - 1, camera.width - 1)))
    if len(seen) < MIN_VIEW * len(points):
        return None
    u, v, z = u[seen], v[seen], z[seen]
    i, j = v.astype(np.int64), u.astype(np.int64)
    pixels, at = inverse_depth.ravel(), i * camera.width + j
    corners = [pixels.take(at + step) for step in (0, 1, camera.width, camera.width + 1)]
    low, high = (reduce(extreme, corners) for extreme in (np.minimum, np.maximum))
    known = np.flatnonzero(high - low < SAME_SURFACE * corners[0])  # false for NaN
    if len(known) < MIN_POINTS:
        return None
    a, b = (u - j)[known], (v - i)[known]
    weights = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    terms = [weight * corner[known] for weight, corner in zip(weights, corners, strict=True)]
    return np.asarray(1 / (terms[0] + terms[1] + terms[2] + terms[3]) - z[known])
