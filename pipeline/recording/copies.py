"""Robots whose logs are one recording: their color images are the same, byte for byte."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from itertools import combinations

MOST_SHARED, MOST_SHARE = (
    2,
    0.05,
)  # images that may be the same by chance, as black ones: so many, or that share


def image_digest(data: bytes) -> int:
    """A number that differs between images, but by chance.

    Args:
        data: of the image, as it is in the log.
    """
    return zlib.crc32(data)


def copies(digests: Mapping[str, set[int]]) -> list[tuple[str, str, int]]:
    """Pairs of robots with color images in common, and how many.

    Args:
        digests: `image_digest` of the color images, by robot.
    """
    found = []
    for a, b in combinations(sorted(digests), 2):
        same = len(digests[a] & digests[b])
        if same > max(MOST_SHARED, MOST_SHARE * min(len(digests[a]), len(digests[b]))):
            found.append((a, b, same))
    return found
