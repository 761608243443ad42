"""Times of a robot's images, and of what else its log holds, by one look through it."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from duagc.converters.logs.entries import Entry
from duagc.converters.logs.files import Log
from duagc.converters.logs.frames import TF_TYPES
from duagc.pipeline.base.progress import track

Taker: TypeAlias = tuple[str, Callable[[Entry], object]]
"""A topic, and who wants its messages."""


@dataclass(frozen=True)
class ImageTimes:
    """When images were taken and recorded; a time of 0 was set by nobody.

    Attributes:
        by_topic: times of the images by topic, in the order of recording.
        stamps_ns: [n], those of all images that are set.
        delays_ns: [n], from these to their recording.
        least_delay_ns: the least delay by topic, of images and of what says how the robot moved.
    """

    by_topic: dict[str, array[int]]
    stamps_ns: NDArray[np.int64]
    delays_ns: NDArray[np.int64]
    least_delay_ns: dict[str, int]


def look_through(
    log: Log,
    images: Sequence[str],
    motion: Sequence[Taker],
    infos: Sequence[Taker],
    *,
    time_ns: Callable[[Entry], int],
) -> ImageTimes:
    """Look through a log once, for all that is to be known before the images.

    Args:
        log: of the robot.
        images: topics of images.
        motion: who wants to know how the robot moved.
        infos: who wants to know what cameras say of themselves.
        time_ns: the time of a message by the clock that the options choose.
    """
    stamps = {topic: array("q") for topic in images}
    delays, recorded = array("q"), array("q")
    least_ns: dict[str, int] = {}

    def take_stamp(entry: Entry) -> int:
        stamp_ns = time_ns(entry)
        if stamp_ns:  # else nobody set it: such images are left out
            delay_ns = entry.log_ns - stamp_ns
            least_ns[entry.topic] = min(least_ns.get(entry.topic, delay_ns), delay_ns)
        return stamp_ns

    def take_image(entry: Entry) -> None:
        stamp_ns = take_stamp(entry)
        stamps[entry.topic].append(stamp_ns)
        if stamp_ns:
            delays.append(entry.log_ns - stamp_ns)
            recorded.append(entry.log_ns)

    takers: list[Taker] = [*motion]
    takers += [(topic, take_stamp) for topic, _ in motion if log.topics[topic].type not in TF_TYPES]
    takers += [(topic, take_image) for topic in stamps]
    takers += infos
    wanted = {topic for topic, _ in takers}
    total = sum(log.topics[topic].count for topic in wanted)
    entries = log.entries(*sorted(wanted), heads=tuple(stamps))
    for entry in track(entries, f"look through {PurePath(log.name).name}", total):
        for topic, take in takers:
            if topic == entry.topic:
                with log.invalid.left_out(entry):
                    take(entry)
    delays_ns = np.array(delays, dtype=np.int64)
    return ImageTimes(stamps, np.array(recorded, dtype=np.int64) - delays_ns, delays_ns, least_ns)
