"""Which depth image belongs to which color image, by their times."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.recording.read import LOG_RECORD, LogFile
from duagc.pipeline.recording.stated_times import stated_seconds

TOLERANCE_NS = 100_000_000
"""Depth farther from a color image is not moved there: the camera may have turned back meanwhile."""
TOLERANCE_KEY = "depth_tolerance_s"
"""In the metadata of a robot's log: seconds, where depth must be nearer to its color than TOLERANCE_NS."""


@dataclass(frozen=True)
class Pairing:
    """The depth of every color image.

    Attributes:
        pairs: time of color and time of its depth, ns, of every color image in order; None: it has no depth.
        color_alone: times of color images without depth.
        depth_alone: times of depth images that belong to no color image.
        tolerance_ns: largest time between color and depth.
    """

    pairs: tuple[tuple[int, int | None], ...]
    color_alone: tuple[int, ...]
    depth_alone: tuple[int, ...]
    tolerance_ns: int

    @property
    def offsets_ns(self) -> NDArray[np.int64]:
        """How much later the depth was taken, of every color image that has one."""
        return np.array([depth - color for color, depth in self.pairs if depth is not None], dtype=np.int64)

    @property
    def largest_offset_ns(self) -> int:
        """Largest time between the color and the depth of a frame."""
        return int(np.abs(self.offsets_ns).max(initial=0))


def pair(color_ns: Iterable[int], depth_ns: Iterable[int], tolerance_ns: int = TOLERANCE_NS) -> Pairing:
    """The depth nearest to each color image, of two the earlier, within the tolerance; several may have the same.

    Args:
        color_ns: times of the color images.
        depth_ns: times of the depth images.
        tolerance_ns: largest time between them.
    """
    color, depth = (np.unique(np.fromiter(times, np.int64)) for times in (color_ns, depth_ns))
    if len(color) == 0 or len(depth) == 0:
        alone = tuple(color.tolist())
        return Pairing(tuple((stamp, None) for stamp in alone), alone, tuple(depth.tolist()), tolerance_ns)
    nearest = nearest_indices(color, depth)
    near = np.abs(depth[nearest] - color) <= tolerance_ns
    pairs = tuple(
        (stamp, partner if has else None)
        for stamp, partner, has in zip(color.tolist(), depth[nearest].tolist(), near.tolist(), strict=True)
    )
    unused = np.delete(depth, np.unique(nearest[near]))
    return Pairing(pairs, tuple(color[~near].tolist()), tuple(unused.tolist()), tolerance_ns)


def pair_topics(log: LogFile, color: str, depth: str) -> Pairing:
    """The depth of every color image of a log, within what the log allows.

    Args:
        log: of one robot.
        color: topic of the color images.
        depth: topic of the depth images, or of sweeps.

    Raises:
        DuagError: the log allows a time that is no tolerance.
    """
    return pair(log.entries_by_time(color), log.entries_by_time(depth), _tolerance_ns(log))


def _tolerance_ns(log: LogFile) -> int:
    metadata = dict(log.metadata()).get(LOG_RECORD, {})
    seconds = stated_seconds(metadata, TOLERANCE_KEY, str(log.path), most_s=TOLERANCE_NS / 1e9)
    return TOLERANCE_NS if seconds is None else round(seconds * 1e9)


def nearest_indices(times_ns: NDArray[np.int64], others_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Which of other times is the nearest to each of some times; of two as near the earlier.

    Args:
        times_ns: [n].
        others_ns: [m], sorted, at least one.

    Returns:
        Indices [n] of the others.
    """
    after = np.clip(np.searchsorted(others_ns, times_ns), 0, len(others_ns) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(others_ns[before] - times_ns) <= np.abs(others_ns[after] - times_ns)
    return np.where(is_before, before, after)
