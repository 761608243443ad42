"""Memory that the stages of a robot take, before they start."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from duagc.pipeline.cache.store import StoredResults

# Bytes of the process that prepares robots one after the other, fitted to the peaks of whole runs (timing.json).
PROCESS_BYTES = 135e6
PYRAMID_BYTES = 400  # for every pixel of an image: pyramids that are kept between passes
VIEW_BYTES = 14  # for every pixel of a view that the map is made of
SUPPORT_VIEWS = 40  # of these views
KEYFRAMES_OF_FRAMES = 0.06  # where their number is unknown: short logs of slow cameras
MARGIN = 1.25
SPARE = 0.1  # share of the free memory that is left alone


def robot_bytes(size: Mapping[str, int], measured: Iterable[StoredResults] = ()) -> float:
    """Most memory that front end and information of a robot will hold.

    Args:
        size: `frames`, and `pixels` of an image; `keyframes`, if they are known.
        measured: results of front ends on this machine; where they took more than is predicted, this one will too.
    """
    ratios = [
        entry.timing["peak_rss_mb"] * 1e6 / _predicted(entry.result)
        for entry in measured
        if entry.result and entry.result.get("keyframes", 1) and "peak_rss_mb" in entry.timing
    ]
    return MARGIN * max([1.0, *ratios]) * _predicted(size)


def _predicted(size: Mapping[str, int]) -> float:
    keyframes = size.get("keyframes", KEYFRAMES_OF_FRAMES * size["frames"])
    views = min(size["frames"], SUPPORT_VIEWS) + keyframes
    return PROCESS_BYTES + size["pixels"] * (PYRAMID_BYTES + VIEW_BYTES * views)


def fitting(workers: int, needed_bytes: Iterable[float], free_bytes: int | None) -> int:
    """How many robots may be prepared at the same time, at least one.

    Args:
        workers: how many were asked for.
        needed_bytes: by every robot.
        free_bytes: of memory; None: unknown, and all that were asked for may.
    """
    if free_bytes is None:
        return workers
    largest = sorted(needed_bytes, reverse=True)
    while workers > 1 and sum(largest[:workers]) > (1.0 - SPARE) * free_bytes:
        workers -= 1
    return workers
