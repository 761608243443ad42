"""From which distance on depth is none: some cameras give their greatest one where they measure nothing."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.ros_images import UnusableImage, depth_values, in_meters
from duagc.converters.logs.entries import Entry
from duagc.converters.logs.files import Log
from duagc.pipeline.recording.greatest_depth import unmeasured

EVERY, IMAGES = 8, 8  # the first images of a log that are looked at


def farthest_measured_m(
    log: Log, topic: str, scale: float, is_mapped: Callable[[Entry], bool]
) -> tuple[float, float]:
    """Distance in meters from which on depth is none, and its share of the known depth; 0: all depth counts.

    Args:
        log: the log.
        topic: of its depth images.
        scale: meters per unit of integer depth.
        is_mapped: whether a depth image is of no frame that is held out.
    """
    images: list[NDArray[np.float32]] = []
    due = 0
    for number, entry in enumerate(log.entries(topic)):
        if due >= EVERY * IMAGES:
            break
        if number >= due and is_mapped(entry):
            due += EVERY
            with suppress(UnusableImage):
                images.append(in_meters(depth_values(entry.read(), f"{log.name}: {topic}"), scale))
    return unmeasured(images)
