"""From which distance on depth is none: some cameras give their greatest one where they measure nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.ros_images import depth_values, in_meters, is_cut_short
from duagc.converters.logs.files import Log
from duagc.pipeline.recording.greatest_depth import greatest_apart

EVERY, IMAGES = 8, 8  # the first images of a log that are looked at
LEAST_SHARE = 0.005  # of the known depth of each of them


def farthest_measured_m(log: Log, topic: str, scale: float) -> tuple[float, float]:
    """Distance in meters from which on depth is none, and its share of the known depth; 0: all depth counts.

    Args:
        log: the log.
        topic: of its depth images.
        scale: meters per unit of integer depth.
    """
    known: list[NDArray[np.float32]] = []
    for number, entry in enumerate(log.entries(topic)):
        if number >= EVERY * IMAGES:
            break
        if number % EVERY == 0 and not is_cut_short(message := entry.read()):
            meters = in_meters(depth_values(message, f"{log.name}: {topic}"), scale)
            known.append(meters[meters > 0])
    greatest_m = greatest_apart(np.concatenate([np.zeros(0, np.float32), *known]))
    shares = [float(np.mean(depth == greatest_m)) for depth in known if len(depth)]
    if not greatest_m or min(shares) < LEAST_SHARE:
        return 0.0, 0.0
    return greatest_m, float(np.mean(shares))
