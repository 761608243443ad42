"""What depth images of a log say of all: their unit, and from which distance on depth is none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.ros_images import UnusableImage, depth_values
from duagc.converters.logs.entries import Entry
from duagc.converters.logs.files import Log
from duagc.pipeline.base.errors import DuagError

EVERY, IMAGES = 8, 8  # the first images of a log that are looked at
FAR_SHARE = 0.99  # of depth that is too far to be meters


def first_depths(
    log: Log, topic: str, is_mapped: Callable[[Entry], bool]
) -> list[NDArray[np.uint16] | NDArray[np.float32]]:
    """Some of the first depth images of a log as `depth_values` gives them.

    Args:
        log: the log.
        topic: of its depth images.
        is_mapped: whether a depth image is of no frame that is held out.
    """
    images = []
    due = 0
    for number, entry in enumerate(log.entries(topic)):
        if due >= EVERY * IMAGES:
            break
        with suppress(UnusableImage), log.invalid.left_out(entry):
            if number >= due and is_mapped(entry):
                due += EVERY
                images.append(depth_values(entry.read(), f"{log.name}: {topic}"))
    return images


def float_unit_m(
    images: Sequence[NDArray[np.uint16] | NDArray[np.float32]],
    limit_m: float,
    stated_m: float | None,
    where: str,
) -> float:
    """Meters per unit of depth in floats: 1, as ROS has it, unless that would leave nothing of them.

    Args:
        images: some, as `depth_values` gives them.
        limit_m: the farthest that a recording holds.
        stated_m: by the user; None: nothing was said.
        where: begins the line of an error.
    Raises:
        DuagError: they are no meters, and the user said no unit.
    """
    floats = [image[image > 0] for image in images if image.dtype == np.float32]
    known = np.concatenate([*floats, np.zeros(0)])
    if not len(known) or np.mean(known > limit_m) < FAR_SHARE:
        return 1.0
    if stated_m is None:
        raise DuagError(
            f"{where} is 32FC1 from {known.min():g} to {known.max():g}, expected meters, up to {limit_m:.1f}, or --set "
            "depth_scale=0.001 for millimeters"
        )
    return stated_m
