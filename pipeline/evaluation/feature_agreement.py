"""How well matched features of views meet under a trajectory: a measure that needs no ground truth.

Pairs of views are chosen and their matches sifted by the images alone (descriptors, then the one motion that
the matched points agree on), so no trajectory is favored. A feature of one view, at the depth measured there, is
moved into the other by the poses and compared with the pixel of its partner. The front end uses features only to find
places, so this is evidence that it did not fit. It also judges the ground truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.registration.descriptors import matches
from duagc.pipeline.registration.features import Features, extract
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


@dataclass(frozen=True)
class MatchedPair:
    """Two views with features in common that agree on one motion.

    Attributes:
        a: place of the one view among all.
        b: of the other.
        points_a: [k, 3], meters, in the camera frame of `a`.
        points_b: [k, 3], the same points in the camera frame of `b`.
    """

    a: int
    b: int
    points_a: Array
    points_b: Array


def matched_pairs(
    colors: Sequence[NDArray[np.uint8]],
    depths_m: Sequence[NDArray[np.float32]],
    camera: PinholeCamera,
    masks: Sequence[NDArray[np.bool_] | None] | None = None,
) -> list[MatchedPair]:
    """All pairs of views whose matches agree on one motion, by the images alone.

    Args:
        colors: uint8 RGB [h, w, 3] of every view.
        depths_m: [h, w], 0 = unknown.
        camera: of all views.
        masks: bool [h, w] of every view, pixels that may be used; None: all.
    """
    masks = masks or [None] * len(colors)
    features = [
        extract(color, depth_m, camera, FEATURES, mask=mask)
        for color, depth_m, mask in zip(colors, depths_m, masks, strict=True)
    ]
    found = (match_views(features[a], features[b], a, b) for a, b in combinations(range(len(features)), 2))
    return [pair for pair in found if pair is not None]


def feature_agreement(
    pairs: Sequence[MatchedPair], camera: PinholeCamera, trajectories: Mapping[str, Array]
) -> dict[str, float | Absent]:
    """Median over pairs of views of the median distance between a moved feature and its partner, pixels.

    Args:
        pairs: of the views.
        camera: of all views.
        trajectories: T_frame_camera [n, 4, 4] of all views, by name.
    Returns:
        The value of every trajectory.
    """
    if len(pairs) < MIN_PAIRS:
        absent = Absent(
            f"only {len(pairs)} pairs of held-out views have features in common, {MIN_PAIRS} are needed"
        )
        return dict.fromkeys(trajectories, absent)
    return {
        name: float(
            np.median([_distance_px(pair, se3.inverse(T[pair.a]) @ T[pair.b], camera) for pair in pairs])
        )
        for name, T in trajectories.items()
    }


def match_views(ours: Features, theirs: Features, a: int, b: int) -> MatchedPair | None:
    """Two views by the matches that agree on one motion; None if too few do.

    Args:
        ours: features of the first view, points in its camera frame, meters.
        theirs: of the second.
        a: place of the first view among all; it also names the random stream of the motion.
        b: place of the second.
    """
    pairs = matches(ours.descriptors, theirs.descriptors, RATIO)
    if len(pairs) < MIN_MATCHES:
        return None
    points_a, points_b = ours.points[pairs[:, 0]].astype(float), theirs.points[pairs[:, 1]].astype(float)
    rng = random_streams.generator(0, "evaluation.feature_agreement", first=a, second=b)
    _, agree = ransac(points_a, points_b, inlier_m=INLIER_M, hypotheses=HYPOTHESES, rng=rng, weighted=False)
    if agree.sum() < max(MIN_MATCHES, MIN_SHARE * len(pairs)):
        return None
    return MatchedPair(a, b, points_a[agree], points_b[agree])


def _distance_px(pair: MatchedPair, T_a_b: Array, camera: PinholeCamera) -> float:
    """Median distance in the image, both ways together; a point behind the other camera is infinitely far."""
    ways = ((pair.points_b, pair.points_a, T_a_b), (pair.points_a, pair.points_b, se3.inverse(T_a_b)))
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
