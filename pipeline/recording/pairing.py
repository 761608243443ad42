"""Which depth image belongs to which color image, by their times."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

TOLERANCE_NS = 20_000_000
"""Color and depth farther apart are not of one frame: a robot moves by some centimeters in this time."""


@dataclass(frozen=True)
class Pairing:
    """pairs: (time of color, time of depth) of every frame in order, ns. color_alone, depth_alone: times without."""

    pairs: tuple[tuple[int, int], ...]
    color_alone: tuple[int, ...]
    depth_alone: tuple[int, ...]

    @property
    def largest_offset_ns(self) -> int:
        """Largest time between the color and the depth of a frame."""
        return max((abs(color - depth) for color, depth in self.pairs), default=0)


def pair(color_ns: Iterable[int], depth_ns: Iterable[int], tolerance_ns: int = TOLERANCE_NS) -> Pairing:
    """Pair two sequences of times: each is the other's nearest (the earlier of two), within the tolerance."""
    color, depth = (np.unique(np.fromiter(times, np.int64)) for times in (color_ns, depth_ns))
    if len(color) == 0 or len(depth) == 0:
        return Pairing((), tuple(color.tolist()), tuple(depth.tolist()))
    to_depth, to_color = _nearest(color, depth), _nearest(depth, color)
    mutual = to_color[to_depth] == np.arange(len(color))
    near = np.abs(depth[to_depth] - color) <= tolerance_ns
    rows = np.flatnonzero(mutual & near)
    columns = to_depth[rows]
    return Pairing(
        tuple(zip(color[rows].tolist(), depth[columns].tolist(), strict=True)),
        tuple(np.delete(color, rows).tolist()),
        tuple(np.delete(depth, columns).tolist()),
    )


def _nearest(times: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Index of the nearest of `others` (sorted) to each of `times`; of two as near the earlier."""
    after = np.clip(np.searchsorted(others, times), 0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(others[before] - times) <= np.abs(others[after] - times), before, after)
