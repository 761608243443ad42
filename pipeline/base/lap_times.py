"""Wall times of the parts of a task."""

from __future__ import annotations

import time
from collections.abc import Mapping


class LapTimes:
    """Wall times of the parts of a task, in seconds, summed by name in `laps`."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """End a part, which lasted since the last one ended.

        Args:
            name: of the part.
        """
        now = time.perf_counter()
        self.laps[name] = round(self.laps.get(name, 0.0) + now - self._last, 3)
        self._last = now

    @property
    def open_s(self) -> float:
        """Time since the last part ended."""
        return time.perf_counter() - self._last

    def go_on(self, laps: Mapping[str, float], open_s: float) -> None:
        """Go on from where another process was.

        Args:
            laps: that it had ended.
            open_s: time since the last of them.
        """
        self.laps.clear()
        self.laps.update(laps)
        self._last = time.perf_counter() - open_s
