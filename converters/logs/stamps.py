"""Times of the images in order of recording: what can be used of them, and which belong together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from duagc.converters.layouts.tum_layout import Listed, associate, nearest_s
from duagc.converters.logs.options import LogOptions
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.messages.parts import NANOSECONDS

MOST_STEPS_BACK = (
    5.0  # intervals of frames that transport may exchange; a clock that was set back goes further
)
LONGEST_WAIT_S = 60.0  # between color and depth of one clock
MOST_APART_S = 0.001  # of the images of a stereo pair
LONGEST_DELAY_S = 1.0  # between topics: what drivers compute before they publish takes less
REMEDY = ", or --set time_source=log"


def clock_words(least_ns: Mapping[str, int], reference: str) -> list[str]:
    """What to warn of where headers of a topic are of another clock than those of the reference.

    Args:
        least_ns: by topic, the least time from a message's header to its recording.
        reference: one of the topics.
    """
    own_s = least_ns[reference] / NANOSECONDS if reference in least_ns else 0.0
    return [
        f"{topic} is recorded {least / NANOSECONDS:.3f} s after the times of its headers at least, and {reference} "
        f"{own_s:.3f} s, as if their clocks differ; expected one clock, or --set time_source=log"
        for topic, least in least_ns.items()
        if reference in least_ns and abs(least / NANOSECONDS - own_s) > LONGEST_DELAY_S
    ]


def sound_stamps(
    name: str, topic: str, times: Sequence[int], warnings: list[str], *, remedy: str = REMEDY
) -> list[int]:
    """The times in their order, each once, without those that are zero.

    Args:
        name: of the log.
        topic: of the images.
        times: ns, in order of recording.
        warnings: gets what was left out.
        remedy: ends the line of an error; of a converter with an option for it.
    Raises:
        DuagError: all times are zero, or the clock was set back.
    """
    if not any(times):
        raise DuagError(f"{name}: {topic}: all times are zero, expected times{remedy}")
    if list(times) != sorted(times):
        _check_steps_back(f"{name}: {topic}", times, remedy)
        warnings.append(f"{topic}: times go backwards; images are taken in order of time")
    if len(set(times)) < len(times):
        warnings.append(f"{topic}: {len(times) - len(set(times))} images repeat a time; left out")
    if unset := list(times).count(0):
        warnings.append(f"{topic}: {unset} images without a time; left out")
    return [time for time in sorted(set(times)) if time]


def _check_steps_back(where: str, times: Sequence[int], remedy: str) -> None:
    """Refuse times of a clock that was set back: frames of before and after it would be mixed."""
    known = np.array([time for time in times if time], dtype=np.int64)
    back = np.maximum.accumulate(known) - known
    worst = int(back.argmax())
    interval = float(np.median(np.diff(np.unique(known)))) if len(known) > 1 else 0.0
    if int((back > MOST_STEPS_BACK * interval).sum()) > 1:  # a single image may come late
        raise DuagError(
            f"{where}: times go back by {back[worst] / NANOSECONDS:.3f} s to {known[worst] / NANOSECONDS:.3f} s, as "
            f"of a clock that was set back; expected times in the order of recording{remedy}"
        )


def paired(
    name: str,
    topics: tuple[str, str],
    stamps: Mapping[str, Sequence[int]],
    options: LogOptions,
    *,
    warnings: list[str],
) -> dict[int, int | None]:
    """Time of a color image -> time of its depth image; None: none is near, and the camera is followed by color.

    Args:
        name: of the log.
        topics: of color and of depth.
        stamps: times of the images by topic, ns, in order of recording.
        options: of the conversion.
        warnings: gets what was left out.

    Raises:
        DuagError: times cannot be used, or no image of depth is near one of color.
    """
    color, depth = topics
    listed = {
        topic: [Listed(t, Path()) for t in sound_stamps(name, topic, times, warnings)]
        for topic, times in stamps.items()
    }
    if options.association == "all" and not options.keeps_depth_time:  # nor can it be used twice
        options = options.model_copy(update={"association": "official"})
    found = associate(listed[color], listed[depth], options)
    if not found:
        raise no_pairs(name, topics, listed, options)
    pairs: dict[int, int | None] = {c.stamp_ns: d.stamp_ns for c, d in found}
    alone = [c.stamp_ns for c in listed[color] if c.stamp_ns not in pairs]
    kept = options.keeps_depth_time
    if alone:
        end = "followed by color" if kept else "left out"
        warnings.append(
            f"{len(alone)} of {len(listed[color])} color images have no depth near in time; {end}"
        )
    if options.depth_from == "stereo":
        warnings += eyes_apart([(c.stamp_ns, d.stamp_ns) for c, d in found], topics)
    return pairs | dict.fromkeys(alone if kept else ())


def no_pairs(
    name: str, topics: tuple[str, str], listed: Mapping[str, Sequence[Listed]], options: LogOptions
) -> DuagError:
    """The error of a log none of whose depth images is near one of color.

    Args:
        name: of the log.
        topics: of color and of depth.
        listed: images by topic.
        options: of the association.
    """
    color, depth = topics
    away_s = nearest_s(*([image.stamp_ns for image in listed[topic]] for topic in (depth, color)))
    other_clock = away_s > LONGEST_WAIT_S and options.time_source == "header"
    remedy = "time_source=log" if other_clock else "max_difference_s=SECONDS"
    if not other_clock and options.keeps_depth_time:
        remedy = f"association=nearest --set {remedy}"
    return DuagError(
        f"{name}: no image on {depth} within {options.limit_ns / NANOSECONDS:g} s of one on {color} (the nearest is "
        f"{away_s:.3f} s away), expected pairs, or --set {remedy}"
    )


def eyes_apart(stamps_ns: Sequence[tuple[int, int]], topics: tuple[str, str]) -> list[str]:
    """A warning if the images of a stereo pair are not of one time; else none.

    Args:
        stamps_ns: times of both images of every pair.
        topics: of the left and of the right eye.
    """
    apart_s = float(np.median([abs(left - right) for left, right in stamps_ns])) / NANOSECONDS
    if apart_s <= MOST_APART_S:
        return []
    return [
        f"{topics[0]} and {topics[1]} are {1e3 * apart_s:.1f} ms apart (median), expected a stereo pair of one time: "
        "if the camera moved in between, all depth is wrong"
    ]
