"""Times that the metadata of a log state, in seconds."""

from __future__ import annotations

import math
from collections.abc import Mapping

from duagc.pipeline.base.errors import DuagError


def stated_seconds(
    metadata: Mapping[str, str], key: str, where: str, *, least_s: float = 0.0, most_s: float
) -> float | None:
    """A time in the metadata of a log, seconds; None if they do not say.

    Args:
        metadata: of the log.
        key: of the time.
        where: path of the log, for errors.
        least_s: the least that it may be.
        most_s: the most that it may be.

    Raises:
        DuagError: it is no number, or beyond these limits.
    """
    text = metadata.get(key)
    if text is None:
        return None
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not least_s <= seconds <= most_s:
        raise DuagError(f"{where}: {key} is {text!r}, expected {least_s:g} to {most_s:g} seconds")
    return seconds
