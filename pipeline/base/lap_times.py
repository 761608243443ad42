"""Wall times of the parts of a task."""

from __future__ import annotations

import time


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
