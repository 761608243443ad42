"""Descriptors of features: RootSIFT, and mutual nearest neighbors among them.

RootSIFT (Arandjelovic and Zisserman 2012) is the square root of the L1-normalized SIFT, here quantized to one byte.
Products of bytes summed over 128 dimensions stay below 2^24, so float32 matrix products of them are exact and do not
depend on the order of the sum.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Descriptors = NDArray[np.uint8]
DIMENSIONS = 128
SCALE = 512.0  # RootSIFT entries are at most 1 and mostly below 0.5; larger ones saturate at one byte


def root_sift(sift: NDArray[np.float32]) -> Descriptors:
    """RootSIFT, uint8 [n, 128].

    Args:
        sift: SIFT descriptors, [n, 128].
    """
    values = np.asarray(sift, dtype=np.float64)
    total = np.maximum(values.sum(axis=-1, keepdims=True), 1e-12)
    return np.minimum(np.rint(SCALE * np.sqrt(values / total)), 255).astype(np.uint8)


def matches(ours: Descriptors, theirs: Descriptors, ratio: float) -> NDArray[np.int64]:
    """Mutual nearest neighbors that pass the ratio test among ours.

    Args:
        ours: uint8 [n, 128], at least two.
        theirs: uint8 [m, 128].
        ratio: nearest distance over second-nearest, below which a match counts.

    Returns:
        Pairs (index in ours, index in theirs), int64 [k, 2], by index in theirs.
    """
    return matches_of(squared_distances(ours, theirs), ratio)


def squared_distances(ours: Descriptors, theirs: Descriptors) -> NDArray[np.float32]:
    """Between descriptors, [n, m], exact integers.

    Args:
        ours: uint8 [n, 128].
        theirs: uint8 [m, 128].
    """
    a, b = ours.astype(np.float32), theirs.astype(np.float32)
    squared = a @ b.T
    squared *= -2
    squared += (a * a).sum(axis=1)[:, None]
    squared += (b * b).sum(axis=1)
    return squared


def matches_of(squared: NDArray[np.float32], ratio: float) -> NDArray[np.int64]:
    """`matches` by squared distances.

    Args:
        squared: [n, m], as of `squared_distances`; they are changed.
        ratio: as of `matches`.
    """
    if len(squared) < 2 or not squared.shape[1]:
        return np.zeros((0, 2), dtype=np.int64)
    columns = np.arange(squared.shape[1])
    best = squared.argmin(axis=0)
    mutual = squared.argmin(axis=1)[best] == columns
    least = squared[best, columns]
    squared[best, columns] = np.inf
    second = squared.min(axis=0)
    good = mutual & (least < np.float32(ratio) ** 2 * second)
    return np.stack([best[good], columns[good]], axis=1)
