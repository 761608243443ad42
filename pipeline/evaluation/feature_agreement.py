"""How well matched features of views meet under a trajectory: a measure that needs no ground truth.

Pairs of views are chosen and their matches sifted by the images alone (descriptors, then the one motion that
the matched points agree on), so no trajectory is favored. A feature of one view, at the depth measured there, is
moved into the other by the poses and compared with the pixel of its partner. The front end uses features only to find
places, so this is evidence that it did not fit. It also judges the ground truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.registration.features import Features, extract, matches
from duagc.pipeline.registration.matched_points import ransac

FEATURES = 600
"""The strongest of a view that have depth."""
RATIO = 0.8
INLIER_M = 0.05
"""Distance at one meter of depth below which a match agrees with the motion of a pair; grows with depth."""
MIN_MATCHES = 15
MIN_SHARE = 0.5
"""Share of a pair's matches that must agree on one motion."""
HYPOTHESES = 64
"""Three-point samples of a pair: one in eight is right where half of the matches are, so 2 of 10,000 pairs are missed.
"""
MIN_PAIRS = 10


def feature_agreement(
    colors: Sequence[NDArray[np.uint8]],
    depths_m: Sequence[NDArray[np.float32]],
    camera: PinholeCamera,
    trajectories: Mapping[str, Array],
    *,
    masks: Sequence[NDArray[np.bool_] | None] | None = None,
) -> tuple[int, dict[str, float | Absent]]:
    """Median over pairs of views of the median distance between a moved feature and its partner, pixels.

    Args:
        colors: uint8 RGB [h, w, 3] of every view.
        depths_m: [h, w], 0 = unknown.
        trajectories: T_frame_camera [n, 4, 4] of the same views, by name.
        masks: bool [h, w] of every view, pixels that may be used; None: all.
    Returns:
        Number of pairs, and the value of every trajectory.
    """
    masks = masks or [None] * len(colors)
    features = [
        extract(color, depth_m, camera, FEATURES, mask=mask)
        for color, depth_m, mask in zip(colors, depths_m, masks, strict=True)
    ]
    medians: dict[str, list[float]] = {name: [] for name in trajectories}
    pairs = 0
    for a, b in combinations(range(len(features)), 2):
        matched = _matched(features[a], features[b], a, b)
        if matched is None:
            continue
        pairs += 1
        for name, T in trajectories.items():
            medians[name].append(_distance_px(*matched, se3.inverse(T[a]) @ T[b], camera))
    if pairs < MIN_PAIRS:
        absent = Absent(
            f"only {pairs} pairs of held-out views have features in common, {MIN_PAIRS} are needed"
        )
        return pairs, dict.fromkeys(trajectories, absent)
    return pairs, {name: float(np.median(values)) for name, values in medians.items()}


def _matched(ours: Features, theirs: Features, a: int, b: int) -> tuple[Array, Array] | None:
    """Points of matches that agree on one motion, each [k, 3] in its own camera frame; None if too few do."""
    pairs = matches(ours.descriptors, theirs.descriptors, RATIO)
    if len(pairs) < MIN_MATCHES:
        return None
    points_a, points_b = ours.points[pairs[:, 0]].astype(float), theirs.points[pairs[:, 1]].astype(float)
    rng = random_streams.generator(0, "evaluation.feature_agreement", first=a, second=b)
    _, agree = ransac(points_a, points_b, inlier_m=INLIER_M, hypotheses=HYPOTHESES, rng=rng, weighted=False)
    if agree.sum() < max(MIN_MATCHES, MIN_SHARE * len(pairs)):
        return None
    return points_a[agree], points_b[agree]


def _distance_px(points_a: Array, points_b: Array, T_a_b: Array, camera: PinholeCamera) -> float:
    """Median distance in the image, both ways together; a point behind the other camera is infinitely far."""
    ways = ((points_b, points_a, T_a_b), (points_a, points_b, se3.inverse(T_a_b)))
    distances = []
    for moved, seen, T in ways:
        there = se3.transform(T, moved)
        front = there[:, 2] > 0.05
        distance = np.full(len(there), np.inf)
        off = camera.project(there[front]) - camera.project(seen[front])
        distance[front] = np.linalg.norm(off, axis=1)
        distances.append(distance)
    median = float(np.median(np.concatenate(distances)))
    return min(
        median, float(np.hypot(camera.width, camera.height))
    )  # nothing is farther than the image is wide
