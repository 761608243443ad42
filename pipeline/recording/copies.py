"""Robots whose logs are one recording: their color images are the same, byte for byte."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

MOST_SHARED, MOST_SHARE = (
    2,
    0.05,
)  # images that may be the same by chance, as black ones: so many, or that share


def copies(digests: Mapping[str, set[int]]) -> list[tuple[str, str, int]]:
    """Pairs of robots with color images in common, and how many.

    Args:
        digests: of the color images, by robot.
    """
    found = []
    for a, b in combinations(sorted(digests), 2):
        same = len(digests[a] & digests[b])
        if same > max(MOST_SHARED, MOST_SHARE * min(len(digests[a]), len(digests[b]))):
            found.append((a, b, same))
    return found
