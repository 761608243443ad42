"""How far robots are with work that has parts, and how long it still takes.

Of every part it is predicted how long it takes (`cache.durations`). What it takes here is learned part by part: from
the robots that have done it, and from the one that is at it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

from duagc.pipeline.cache import durations

TRUSTED_S = 0.5
"""So many predicted seconds count for the prediction: the first steps say little."""
TRUSTED_PART_S = 0.25
"""The same of a part, for what its whole work takes."""
START = "start"
"""The part of a work that ends with the first step of another: a process starts."""
LEAST_LEFT = 0.1
"""Of what something takes, where it takes longer than it should."""


def kind_of(part: str) -> str:
    """What takes equally long for every prediction, whichever robot it is of: "peers" for "peers of bravo".

    Args:
        part: of a work.
    """
    return part.partition(" of ")[0]


@dataclass
class RobotWork:
    """What is done for a robot.

    Attributes:
        parts: predicted seconds, in order.
        unheard: parts whose steps do not say how far they are.
        done: share of every part that is done.
        before: share of every part that another process had done.
        took_s: how long parts took that are done.
        now: the part that it is at, and since when; None: it has not begun, or is done.
        ended: whether it is done.
    """

    parts: dict[str, float]
    unheard: Collection[str] = ()
    done: dict[str, float] = field(default_factory=dict)
    before: dict[str, float] = field(default_factory=dict)
    took_s: dict[str, float] = field(default_factory=dict)
    now: tuple[str, float] | None = None
    ended: bool = False

    def step(self, part: str, share: float, now: float) -> None:
        """A step was done.

        Args:
            part: of the work.
            share: of the part that is done.
            now: the time, seconds.
        """
        order = list(self.parts)
        began = self.now is None or self.now[0] == START
        if self.now is None or self.now[0] != part:
            self._close(now)
            self.now = part, now
        for earlier in order[: order.index(part)]:
            self.done[earlier] = 1.0
            if began and earlier != START:
                self.before[earlier] = 1.0
        if part not in self.unheard:
            self.done[part] = max(self.done.get(part, 0.0), min(share, 1.0))
            if began and share < 1:
                self.before[part] = self.done[part]
        if part == order[-1] and share >= 1:
            self.end(now)

    def end(self, now: float) -> None:
        """All is done.

        Args:
            now: the time, seconds.
        """
        if not self.ended:
            self._close(now)
            self.now, self.ended = None, True
            self.done = dict.fromkeys(self.parts, 1.0)

    def _close(self, now: float) -> None:
        if self.now is not None:
            part, since = self.now
            self.took_s[part] = self.took_s.get(part, 0.0) + now - since

    def measured(self, part: str, now: float) -> tuple[float, float]:
        """Seconds that what this process did of a part took, and predicted seconds of that.

        Args:
            part: of the work.
            now: the time, seconds.
        """
        took = self.took_s.get(part, 0.0)
        if self.now is not None and self.now[0] == part and part not in self.unheard:
            took += now - self.now[1]
        if part not in self.took_s and took == 0.0:
            return 0.0, 0.0
        return took, self.parts[part] * (self.done.get(part, 0.0) - self.before.get(part, 0.0))

    def whole_s(self) -> float:
        """Predicted seconds of all."""
        return sum(self.parts.values())


class RobotsWork:
    """The same work of some robots, several side by side."""

    def __init__(self, of: Mapping[str, RobotWork], workers: int, slower: float, now: float) -> None:
        """Take the work of every robot, which begins at `now` unless `start` is called.

        Args:
            of: by robot, in the order in which they begin.
            workers: robots that are worked on at the same time.
            slower: seconds for every predicted one, with so many at work.
            now: the time, seconds.
        """
        self.of, self._workers, self._slower, self._started_s = of, workers, slower, now

    def start(self, now: float) -> None:
        """The first robots begin: processes start for them.

        Args:
            now: the time, seconds.
        """
        self._started_s = now

    def step(self, robot: str, part: str, share: float, now: float) -> None:
        """A step was done; nothing is known of robots and parts that were not predicted.

        Args:
            robot: for which.
            part: of its work.
            share: of the part that is done.
            now: the time, seconds.
        """
        work = self.of.get(robot)
        if work is None or part not in work.parts:
            return
        begun = sum(other.now is not None or other.ended for other in self.of.values())
        if work.now is None and not work.ended and begun < self._workers and START in work.parts:
            work.now = START, self._started_s
        work.step(part, share, now)

    def end(self, now: float) -> None:
        """All is done.

        Args:
            now: the time, seconds.
        """
        for work in self.of.values():
            work.end(now)

    @property
    def begun(self) -> bool:
        """Whether a robot has begun, or all is done."""
        return any(work.now is not None or work.ended for work in self.of.values())

    def predicted_s(self) -> float:
        """Seconds until all is done, before anything is known."""
        whole = [self._slower * work.whole_s() for work in self.of.values()]
        return durations.side_by_side_s((), whole, self._workers)

    def rate(
        self, now: float, kinds: Iterable[str], base: float = 1.0, trusted_s: float = TRUSTED_S
    ) -> float:
        """Measured seconds for every predicted one.

        Args:
            now: the time, seconds.
            kinds: of the parts that it is of.
            base: what it is where nothing was measured.
            trusted_s: so many predicted seconds count for that.
        """
        measured, predicted = 0.0, 0.0
        wanted = set(kinds)
        for work in self.of.values():
            for part in work.parts:
                if kind_of(part) in wanted:
                    took, of = work.measured(part, now)
                    measured, predicted = measured + took, predicted + self._slower * of
        return (trusted_s * base + measured) / (trusted_s + predicted)

    def left_s(self, now: float, base: float = 1.0) -> float:
        """Seconds until all is done.

        Args:
            now: the time, seconds.
            base: measured seconds for every predicted one, where nothing was measured.
        """
        every = {kind_of(part) for work in self.of.values() for part in work.parts}
        whole = self.rate(now, every, base)
        rates = {kind: self.rate(now, (kind,), whole, TRUSTED_PART_S) for kind in every}
        begun, waiting = list[float](), list[float]()
        for work in self.of.values():
            if work.ended:
                continue
            left = sum(
                self._slower * rates[kind_of(part)] * seconds * (1 - work.done.get(part, 0.0))
                for part, seconds in work.parts.items()
            )
            if work.now is None:
                waiting.append(left)
                continue
            part, since = work.now
            if part in work.unheard:
                part_s = self._slower * rates[kind_of(part)] * work.parts[part]
                left -= min(now - since, (1 - LEAST_LEFT) * part_s)
            begun.append(left)
        return durations.side_by_side_s(begun, waiting, self._workers)
