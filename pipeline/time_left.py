"""How far a run is, and how long it still takes.

What every stage takes is predicted from the size of its logs (`cache.durations`). How much slower this machine and this
recording are is learned from what is done, and counts for what is left that is of the same kind.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence

from duagc.pipeline.base.machine import processors
from duagc.pipeline.base.worker_reports import KEYFRAMES, OF_TEAM
from duagc.pipeline.cache import durations
from duagc.pipeline.cache.durations import Size
from duagc.pipeline.cache.footprint import KEYFRAMES_OF_FRAMES
from duagc.pipeline.cache.robots_work import LEAST_LEFT, START, TRUSTED_S, RobotsWork, RobotWork, kind_of
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.runs import stages

EVERY_S = 10.0
UNHEARD = ("poses", "information", "surface", "agreement")
"""Parts of a front end, and of an evaluation, that do not say how far they are."""
PARTS = {"tracking again": "tracking"}
"""Parts of a front end that are not named as in `durations`."""
IMAGES = (START, "tracking", "poses", "model")
"""Parts of a front end that take as long as images are large, as the evaluation does."""
GAUSSIANS = ("mapping", "final")
"""Parts of a front end that take as long as the map has Gaussians, as fusion does."""
EVALUATION_OF_TEAM = f"{stages.EVALUATION.name} of the team"
"""What follows the evaluation of each robot."""
LIKE = {stages.FUSION.name: GAUSSIANS, stages.EVALUATION.name: IMAGES}
"""Parts of the front end that a stage is like; any other is like all of them."""


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
        """Predict how long front ends and later stages take, before the first step.

        Args:
            robots: `frames` and `pixels` of those whose front ends are computed, and `keyframes` if they are known.
            mapping: how long maps are optimized.
            found: the same of those whose front ends are there.
            workers: robots that are prepared at the same time.
            wanted: stages that are done.
            clock: seconds.
        """
        self._mapping, self._clock, self._lock = mapping, clock, threading.Lock()
        self._sizes = {name: {"keyframes": _guess(size), **size} for name, size in robots.items()}
        self._words: dict[str, str] = {}  # what front ends are at
        preparing, reading = (max(1, min(workers, n)) for n in (len(robots), len(robots) + len(found)))
        front = {name: RobotWork(self._front_end(size), UNHEARD) for name, size in self._sizes.items()}
        slower = durations.slowdown(preparing, processors())
        self._front = RobotsWork(front, preparing, slower, clock())
        self._found, self._wanted, self._reading = dict(found), wanted, reading
        self._predict_later()
        # stage that this process does, predicted seconds, since when
        self._now: tuple[str, float, float] | None = None
        # measured and predicted seconds of stages that are done
        self._taken: dict[str, tuple[float, float]] = {}

    def _front_end(self, size: Size) -> dict[str, float]:
        parts = durations.front_end_parts(size, self._mapping)
        return parts | {"information": durations.information_s(size)}

    def _predict_later(self) -> None:
        """What follows the front ends, in order: stages, and predicted seconds; fusion robot by robot, or of all."""
        team, reading = self._sizes | self._found, self._reading
        works = {name: RobotWork(_evaluation(name, size, list(team)), UNHEARD) for name, size in team.items()}
        if reading > 1:  # worker processes start
            for work in list(works.values())[:reading]:
                work.parts = {START: durations.START_S, **work.parts}
        one_s, many = durations.threaded_s(1.0, processors()), durations.slowdown(reading, processors())
        sizes = list(team.values())
        slower = one_s if reading == 1 else many
        self._evaluation = RobotsWork(works, reading, slower, self._clock())
        fused_s = [slower * durations.fusion_s(s) for s in sizes] if len(sizes) > 1 else []
        if reading > 1:
            fused_s = [durations.side_by_side_s((), fused_s, reading)]
        expected = [
            (stages.EXCHANGE, durations.exchange_s(sizes)),
            *((stages.FUSION, seconds) for seconds in fused_s),
            (stages.EVALUATION, self._evaluation.predicted_s()),
            (stages.REPORT, durations.REPORT_S),
            # next to the report if there are several workers
            (stages.VIEW, durations.VIEW_S if reading == 1 or stages.REPORT not in self._wanted else 0.0),
        ]
        self._later = [(stage.name, seconds) for stage, seconds in expected if stage in self._wanted]
        if stages.EVALUATION in self._wanted:
            after = 1 + [name for name, _ in self._later].index(stages.EVALUATION.name)
            self._later.insert(after, (EVALUATION_OF_TEAM, durations.evaluation_of_team_s(len(team))))

    def step(self, robot: str, part: str, done: int, total: int) -> None:
        """A step of a front end, or of the evaluation of a robot.

        Args:
            robot: whose.
            part: its name, as of `Checkpoints`.
            done: steps.
            total: steps; 0: the front end is done.
        """
        with self._lock:
            now = self._clock()
            if self._now is not None and self._now[0] == stages.EVALUATION.name:
                if robot == OF_TEAM:
                    self._go_on(EVALUATION_OF_TEAM, now)
                self._evaluation.step(robot, part, done / max(total, 1), now)
                return
            work = self._front.of.get(robot)
            if work is None:
                return
            if total == 0:
                work.end(now)
                self._words.pop(robot, None)
                return
            if part in KEYFRAMES.values():
                self._sizes[robot] |= {"keyframes": total, "exact": int(part == KEYFRAMES["ray_plane"])}
                work.parts |= self._front_end(self._sizes[robot])
                self._predict_later()
            name = _part_of(part)
            self._front.step(robot, name, done / total, now)
            self._words[robot] = f"{part.removeprefix(f'{robot}.')} {done}/{total}"

    def begin(self, stage: str) -> None:
        """A stage of the team begins in this process, or goes on with the next robot.

        Args:
            stage: its name.
        """
        with self._lock:
            now = self._clock()
            self._front.end(now)
            self._words.clear()
            self._go_on(stage, now)
            if stage == stages.EVALUATION.name:
                self._evaluation.start(now)

    def _go_on(self, stage: str, now: float) -> None:
        """What was done took so long; what is predicted of a stage begins, or the next part of it."""
        if self._now is not None:
            before, predicted, since = self._now
            taken = self._taken.get(kind_of(before), (0.0, 0.0))
            self._taken[kind_of(before)] = taken[0] + now - since, taken[1] + predicted
        self._now = None
        if stage in (name for name, _ in self._later):
            while self._later[0][0] != stage:
                self._later.pop(0)
            self._now = *self._later.pop(0), now

    def left_s(self) -> float:
        """Seconds until the run is done."""
        with self._lock:
            now = self._clock()
            seconds = self._front.left_s(now)
            if self._now is not None:
                seconds += self._left_of_stage(*self._now, now)
            return seconds + sum(self._rate_of(name, now) * predicted for name, predicted in self._later)

    def line(self) -> str:
        """Where the robots are, and the time left."""
        left = self.left_s()
        with self._lock:
            at_work = [f"{name}: {words}" for name, words in sorted(self._words.items())]
            if self._now is not None:
                at_work = [self._now[0]]
        where = f"{', '.join(at_work)}; " if at_work else ""
        return f"{where}{in_words(left)} left of the run"

    def _left_of_stage(self, name: str, predicted: float, since: float, now: float) -> float:
        """Seconds of a stage of the team that is at work."""
        if name == stages.EVALUATION.name and self._evaluation.begun:
            return self._evaluation.left_s(now, self._rate_of(name, now))
        whole = self._rate_of(name, now) * predicted
        return max(whole - (now - since), LEAST_LEFT * whole)

    def _rate_of(self, stage: str, now: float) -> float:
        """Measured seconds of a stage for every predicted one; its own once something of it is done."""
        parts = LIKE.get(kind_of(stage), (*IMAGES, *GAUSSIANS))
        measured, predicted = self._taken.get(kind_of(stage), (0.0, 0.0))
        return (TRUSTED_S * self._front.rate(now, parts) + measured) / (TRUSTED_S + predicted)


def _guess(size: Size) -> int:
    return max(1, round(KEYFRAMES_OF_FRAMES * size["frames"]))


def _evaluation(robot: str, size: Size, team: Sequence[str]) -> dict[str, float]:
    """Parts of the evaluation of a robot by the names that are reported: sets of views say whose they are."""
    parts = durations.evaluation_parts(size, len(team))
    peers = [name for name in team if name != robot]
    return {
        f"held_out of {robot}": parts["held_out"],
        f"training of {robot}": parts["training"],
        **{f"peers of {peer}": parts["peers"] / len(peers) for peer in peers},
        "surface": parts["surface"],
        "agreement": parts["agreement"],
    }


def _part_of(part: str) -> str:
    """The part of `durations` that a part of a front end belongs to."""
    last = part.rpartition(".")[2]
    if last in (*GAUSSIANS, "model", "information"):
        return last
    return PARTS.get(part, "tracking" if part == "tracking" else "poses")


def in_words(seconds: float) -> str:
    """A time that nobody needs to the second.

    Args:
        seconds: of it.
    """
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 570:
        return f"{round(seconds / 30) / 2:g} min"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
