"""Recognising places: SIFT features of keyframes, and which pairs of keyframes may show the same place.

Descriptors are RootSIFT (Arandjelovic and Zisserman 2012), the square root of the L1-normalised SIFT, quantised to
one byte. Products of bytes summed over 128 dimensions stay below 2^24, so float32 matrix products of them are exact
and do not depend on the order of the sum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import PinholeCamera

Descriptors = NDArray[np.uint8]
DIMENSIONS = 128
SCALE = 512.0  # RootSIFT entries are at most 1 and mostly below 0.5; larger ones saturate at one byte


@dataclass(frozen=True)
class Features:
    """Keypoints of one keyframe with known depth, strongest response first.

    descriptors: uint8 [n, 128]. points: float32 [n, 3], metres, camera frame.
    """

    descriptors: Descriptors
    points: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.points)


def extract(
    color: NDArray[np.uint8], depth_m: NDArray[np.float32], camera: PinholeCamera, most: int
) -> Features:
    """The strongest SIFT features of a frame that have a depth.

    Args:
        color: uint8 RGB [h, w, 3]. depth_m: float32 [h, w], 0 = unknown. most: number of features kept.
    """
    import cv2

    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    keypoints, sift = cv2.SIFT.create(nfeatures=2 * most).detectAndCompute(gray, None)
    if not keypoints:
        return Features(np.zeros((0, DIMENSIONS), np.uint8), np.zeros((0, 3), np.float32))
    u, v = np.array([k.pt for k in keypoints], dtype=np.float64).T
    response = np.array([k.response for k in keypoints])
    column = np.clip(np.rint(u).astype(np.int64), 0, camera.width - 1)
    row = np.clip(np.rint(v).astype(np.int64), 0, camera.height - 1)
    z = depth_m[row, column].astype(np.float64)
    angle = np.array([k.angle for k in keypoints])
    order = np.lexsort((angle, u, v, -response))
    order = order[z[order] > 0][:most]
    z = z[order]
    points = np.stack(
        [(u[order] - camera.cx) / camera.fx * z, (v[order] - camera.cy) / camera.fy * z, z], axis=-1
    )
    return Features(root_sift(sift[order]), points.astype(np.float32))


def root_sift(sift: NDArray[np.float32]) -> Descriptors:
    """RootSIFT of SIFT descriptors [n, 128], one byte per entry."""
    values = np.asarray(sift, dtype=np.float64)
    total = np.maximum(values.sum(axis=-1, keepdims=True), 1e-12)
    return np.minimum(np.rint(SCALE * np.sqrt(values / total)), 255).astype(np.uint8)


def matches(ours: Descriptors, theirs: Descriptors, ratio: float) -> NDArray[np.int64]:
    """Mutual nearest neighbours that pass the ratio test among ours.

    Args:
        ours: uint8 [n, 128], at least two. theirs: uint8 [m, 128].
        ratio: nearest distance over second-nearest, below which a match counts.
    Returns:
        Pairs (index in ours, index in theirs), int64 [k, 2], by index in theirs.
    """
    if len(ours) < 2 or not len(theirs):
        return np.zeros((0, 2), dtype=np.int64)
    return _matches(_squared_distances(ours, theirs), ratio)


def _squared_distances(ours: Descriptors, theirs: Descriptors) -> NDArray[np.float32]:
    """[n, m], exact integers."""
    a, b = ours.astype(np.float32), theirs.astype(np.float32)
    return (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2 * (a @ b.T)


def _matches(squared: NDArray[np.float32], ratio: float) -> NDArray[np.int64]:
    columns = np.arange(squared.shape[1])
    best = squared.argmin(axis=0)
    second = np.partition(squared, 1, axis=0)[1]
    mutual = squared.argmin(axis=1)[best] == columns
    good = mutual & (squared[best, columns] < np.float32(ratio) ** 2 * second)
    return np.stack([best[good], columns[good]], axis=1)


@dataclass(frozen=True)
class Candidate:
    """Two keyframes, one of each robot, that may show the same place; score = number of matching descriptors."""

    own_keyframe: int
    peer_keyframe: int
    score: int


@dataclass(frozen=True)
class Choice:
    """kept: pairs to verify, best first. left: pairs with enough matches that the budget leaves out, best first.

    unlike: for every keyframe of the neighbour that resembles no own one enough, the pair that comes nearest.
    """

    kept: list[Candidate]
    left: list[Candidate]
    unlike: list[Candidate]


def candidates(
    own: list[Features],
    peer: list[Descriptors],
    ratio: float,
    min_score: int,
    per_keyframe: int,
    max_keyframes: int,
) -> Choice:
    """Pairs of keyframes worth verifying.

    Args:
        own: all features of each own keyframe. peer: the compact descriptors of each keyframe of the neighbour.
        min_score: matches from which a pair counts. per_keyframe: pairs kept per keyframe of the neighbour.
        max_keyframes: keyframes of the neighbour that may be asked for, best scores first.
    """
    scored: list[Candidate] = []
    unlike: list[Candidate] = []
    for j, theirs in enumerate(peer):
        scores = [Candidate(i, j, len(matches(o.descriptors, theirs, ratio))) for i, o in enumerate(own)]
        scored += [c for c in scores if c.score >= min_score]
        if scores and max(c.score for c in scores) < min_score:
            unlike.append(max(scores, key=lambda c: (c.score, -c.own_keyframe)))
    scored.sort(key=lambda c: (-c.score, c.peer_keyframe, c.own_keyframe))
    taken: dict[int, int] = {}
    kept, left = [], []
    for c in scored:
        used = taken.get(c.peer_keyframe, 0)
        if used < per_keyframe and (used or len(taken) < max_keyframes):
            taken[c.peer_keyframe] = used + 1
            kept.append(c)
        else:
            left.append(c)
    return Choice(kept, left, unlike)
