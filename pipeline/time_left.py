"""How far a run is, and how long it still takes.

What every stage takes is predicted from the size of its logs (`cache.durations`). How much slower this machine and this
recording are is learned from what is done, and counts for what is left.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from duagc.pipeline.base.machine import processors
from duagc.pipeline.cache import durations
from duagc.pipeline.cache.durations import Size
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.runs import stages

EVERY_S = 10.0
KEYFRAMES_OF_FRAMES = 0.06
"""Until the keyframes of a robot are known."""
TRUSTED_S = 5.0
"""So many predicted seconds count for the prediction: the first steps of a run say little."""
LEAST_LEFT = 0.1
"""Of what a stage takes, where it takes longer than it should."""
PARTS = {"tracking again": "tracking", "keyframes": "poses"}
"""Parts of a front end that are not named as in `durations`."""


@dataclass
class RobotWork:
    """The front end of a robot.

    Attributes:
        size: of its log.
        known: whether its keyframes are.
        part: what it does now, in words; "": it has not begun, or is done.
        earlier_s: predicted seconds that another process had done before.
        began_s: when; None: it has not.
        took_s: how long it was at work; None: it is not done.
        parts: share of every part that is done.
    """

    size: dict[str, int]
    known: bool = False
    part: str = ""
    earlier_s: float = 0.0
    began_s: float | None = None
    took_s: float | None = None
    parts: dict[str, float] = field(default_factory=dict)


class TimeLeft:
    """Follows a run from the thread or process that carries it; other threads may tell it things."""

    def __init__(
        self,
        robots: Mapping[str, Size],
        mapping: MappingConfig,
        *,
        found: Mapping[str, Size],
        workers: int,
        wanted: Sequence[stages.Stage],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin.

        Args:
            robots: `frames` and `pixels` of those whose front ends are computed, and `keyframes` if they are known.
            mapping: how long maps are optimized.
            found: the same of those whose front ends are there.
            workers: robots that are prepared at the same time.
            wanted: stages that are done.
            clock: seconds.
        """
        self._mapping, self._workers, self._clock = mapping, max(1, min(workers, len(robots))), clock
        self._lock = threading.Lock()
        self.robots = {
            name: RobotWork({"keyframes": self._guess(size), **size}, "keyframes" in size)
            for name, size in robots.items()
        }
        self._later = self._units([*(work.size for work in self.robots.values()), *found.values()], wanted)
        # stage that this process does, predicted seconds, since when
        self._now: tuple[str, float, float] | None = None
        # measured and predicted seconds of stages that are done
        self._taken: dict[str, tuple[float, float]] = {}

    @staticmethod
    def _guess(size: Size) -> int:
        return max(1, round(KEYFRAMES_OF_FRAMES * size["frames"]))

    def _units(self, sizes: Sequence[Size], wanted: Sequence[stages.Stage]) -> list[tuple[str, float]]:
        """What follows the front ends, in order: stages, and predicted seconds; fusion robot by robot."""
        slower = durations.slowdown(self._workers, processors())
        evaluated = durations.side_by_side_s(
            (), [durations.evaluation_s(s, len(sizes)) for s in sizes], self._workers
        )
        fused_s = [durations.threaded_s(durations.fusion_s(s), processors()) for s in sizes]
        fused = [(stages.FUSION, seconds) for seconds in fused_s] if len(sizes) > 1 else []
        expected = [
            (stages.EXCHANGE, durations.exchange_s(len(sizes))),
            *fused,
            (stages.EVALUATION, slower * evaluated),
            (stages.REPORT, durations.READERS_S / 2),
            (stages.VIEW, durations.READERS_S / 2),
        ]
        return [(stage.name, seconds) for stage, seconds in expected if stage in wanted]

    def step(self, robot: str, part: str, done: int, total: int) -> None:
        """A step of a front end.

        Args:
            robot: whose.
            part: its name, as of `Checkpoints`.
            done: steps.
            total: steps; 0: the robot is done.
        """
        with self._lock:
            work = self.robots.get(robot)
            if work is None:
                return
            now, first = self._clock(), work.began_s is None
            work.began_s = now if work.began_s is None else work.began_s
            if total == 0:
                work.took_s, work.part = now - work.began_s, ""
                return
            if part == "keyframes":
                work.size["keyframes"], work.known = total, True
            name = _part_of(part)
            order = list(durations.front_end_parts(work.size, self._mapping))
            for before in order[: order.index(name)]:
                work.parts[before] = 1.0
            if name != "poses":  # many short ones
                work.parts[name] = max(work.parts.get(name, 0.0), done / total)
            if first and done > 1:
                work.earlier_s = self._done(work)
            work.part = f"{part.removeprefix(f'{robot}.')} {done}/{total}"

    def begin(self, stage: str) -> None:
        """A stage of the team begins in this process, or goes on with the next robot.

        Args:
            stage: its name.
        """
        with self._lock:
            now = self._clock()
            for work in self.robots.values():
                work.took_s = now - (work.began_s or now) if work.took_s is None else work.took_s
            if self._now is not None:
                before, predicted, since = self._now
                taken = self._taken.get(before, (0.0, 0.0))
                self._taken[before] = taken[0] + now - since, taken[1] + predicted
            self._now = None
            if stage in (name for name, _ in self._later):
                while self._later[0][0] != stage:
                    self._later.pop(0)
                self._now = *self._later.pop(0), now

    def left_s(self) -> float:
        """Seconds until the run is done."""
        with self._lock:
            now, rate = self._clock(), self._rate()
            begun, waiting = list[float](), list[float]()
            slower = durations.slowdown(self._workers, processors())
            for work in self.robots.values():
                if work.took_s is not None:
                    continue
                left = slower * rate * (self._whole(work) - self._done(work))
                (waiting if work.began_s is None else begun).append(left)
            seconds = durations.side_by_side_s(begun, waiting, self._workers)
            if self._now is not None:
                name, predicted, since = self._now
                whole = self._rate_of(name, rate) * predicted
                seconds += max(whole - (now - since), LEAST_LEFT * whole)
            seconds += sum(self._rate_of(name, rate) * predicted for name, predicted in self._later)
            return seconds

    def line(self) -> str:
        """Where the robots are, and the time left."""
        left = self.left_s()
        with self._lock:
            at_work = [f"{name}: {work.part}" for name, work in self.robots.items() if work.part]
            if self._now is not None:
                at_work = [self._now[0]]
        where = f"{', '.join(at_work)}; " if at_work else ""
        return f"{where}{in_words(left)} left of the run"

    def _whole(self, work: RobotWork) -> float:
        return durations.front_end_s(work.size, self._mapping) + durations.information_s(work.size)

    def _done(self, work: RobotWork) -> float:
        parts = durations.front_end_parts(work.size, self._mapping)
        return sum(work.parts.get(name, 0.0) * seconds for name, seconds in parts.items())

    def _rate(self) -> float:
        """Measured seconds for every predicted one."""
        now = self._clock()
        measured, predicted = (sum(values) for values in zip((0.0, 0.0), *self._taken.values(), strict=True))
        for work in self.robots.values():
            if work.began_s is not None:
                measured += work.took_s if work.took_s is not None else now - work.began_s
                done = self._done(work) if work.took_s is None else self._whole(work)
                predicted += durations.slowdown(self._workers, processors()) * (done - work.earlier_s)
        return (TRUSTED_S + measured) / (TRUSTED_S + predicted)

    def _rate_of(self, stage: str, rate: float) -> float:
        """The same of a stage: its own once something of it is done."""
        measured, predicted = self._taken.get(stage, (0.0, 0.0))
        return (TRUSTED_S * rate + measured) / (TRUSTED_S + predicted)


def _part_of(part: str) -> str:
    """The part of `durations` that a part of a front end belongs to."""
    last = part.rpartition(".")[2]
    if last in ("mapping", "final", "model"):
        return last
    return PARTS.get(part, "tracking" if part == "tracking" else "poses")


def in_words(seconds: float) -> str:
    """A time that nobody needs to the second.

    Args:
        seconds: of it.
    """
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
