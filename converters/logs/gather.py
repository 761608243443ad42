"""Messages of several topics that belong together, in order of time, without holding more of a log than needed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from duagc.converters.logs.entries import Entry
from duagc.converters.logs.files import Log
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.recording.pairing import nearest_indices

MOST_KEPT_BYTES = 512 << 20
NO_TIME = -1


def gathered(
    log: Log, groups: Sequence[Mapping[str, int]], time_ns: Callable[[Entry], int]
) -> Iterator[dict[str, Entry]]:
    """For every group of (topic -> time) its messages, in the order of the groups.

    Groups should follow the order of recording: what arrives before its group is due is kept. Of several messages of
    one topic and time the first counts; a group whose messages do not all come ends the iteration.

    Args:
        log: with the messages.
        groups: time (ns) by topic, of each group.
        time_ns: the time of a message, by the same clock as those of the groups.

    Raises:
        DuagError: more would have to be kept than memory should hold: times and recording are in different orders.
    """
    uses = Counter(part for group in groups for part in group.items())
    kept: dict[tuple[str, int], Entry] = {}
    at = kept_bytes = 0
    for entry in log.entries(*sorted({topic for topic, _ in uses})):
        part = entry.topic, NO_TIME
        with log.invalid.left_out(entry):
            part = entry.topic, time_ns(entry)
        if uses.get(part, 0) > 0 and part not in kept:
            kept[part] = entry
            kept_bytes += len(entry.data)
        if kept_bytes > MOST_KEPT_BYTES:
            raise DuagError(
                f"{log.name}: at {entry.log_ns} ns {kept_bytes >> 20} MB wait for messages of earlier times, expected "
                "times in the order of recording, or time_source=log"
            )
        while at < len(groups) and all(part in kept for part in groups[at].items()):
            yield {topic: kept[topic, stamp] for topic, stamp in groups[at].items()}
            for used in groups[at].items():
                uses[used] -= 1
                if not uses[used]:
                    kept_bytes -= len(kept.pop(used).data)
            at += 1


def nearest(times_ns: Sequence[int], others_ns: Sequence[int], most_ns: int) -> dict[int, int]:
    """For each time the nearest of the others (of two the earlier), where that is near enough.

    Args:
        times_ns: increasing.
        others_ns: increasing.
        most_ns: largest difference.

    Returns:
        The other time by the time; times without one are left out.
    """
    if not len(times_ns) or not len(others_ns):
        return {}
    ours, theirs = np.asarray(times_ns, np.int64), np.asarray(others_ns, np.int64)
    best = theirs[nearest_indices(ours, theirs)]
    near = np.abs(best - ours) <= most_ns
    return dict(zip(ours[near].tolist(), best[near].tolist(), strict=True))
