"""The time that a run still takes is known after a tenth of it."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest

from duagc.pipeline.base import machine
from duagc.pipeline.base.worker_reports import KEYFRAMES, OF_TEAM
from duagc.pipeline.cache import durations
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.runs import stages
from duagc.pipeline.time_left import EVALUATION_OF_TEAM, TimeLeft, in_words

MAPPING = MappingConfig()
STEPS = {"tracking": 50, "mapping": 12, "final": 200, "model": 50}
LATER = (stages.EXCHANGE, stages.FUSION, stages.EVALUATION, stages.REPORT, stages.VIEW)


class Simulated:
    """A run whose stages take what is predicted, times a factor for the machine, and one for each part."""

    def __init__(self, robots: int, workers: int, slower: float, uneven: float, *, exact: int = 0) -> None:
        self.now, self.exact = 0.0, exact
        self.slower, self.uneven = slower, itertools.cycle((uneven, 1 / uneven, 1.0))
        names = [f"robot{k}" for k in range(robots)]
        self.sizes = {name: {"frames": 300 + 40 * k, "pixels": 640 * 480} for k, name in enumerate(names)}
        self.times = TimeLeft(
            self.sizes, MAPPING, found={}, workers=workers, wanted=LATER, clock=lambda: self.now
        )
        self.workers = min(workers, robots)
        self.said: list[tuple[float, float]] = []  # time, and time left

    def front_end(self, robot: str, begin: float) -> list[tuple[float, tuple[str, str, int, int]]]:
        """Steps with their times."""
        keyframes, steps = self.sizes[robot]["frames"] // 20, []
        size = {**self.sizes[robot], "keyframes": keyframes, "exact": self.exact}
        at = begin
        inflation = self.slower * durations.slowdown(self.workers, machine.processors())
        for part, seconds in durations.front_end_parts(size, MAPPING).items():
            took = seconds * inflation * next(self.uneven)
            if part == "poses":
                part_of_keyframes = KEYFRAMES["ray_plane" if self.exact else "blended"]
                steps.append((at, (robot, part_of_keyframes, keyframes, keyframes)))
            name = part if part == "tracking" else f"{robot}.{part}"
            count = 0 if part == "start" else STEPS.get(part, 3)
            steps += [(at + took * (k + 1) / count, (robot, name, k + 1, count)) for k in range(count)]
            at += took
        steps.append((at, (robot, "information", 0, 1)))
        at += inflation * durations.information_s(size)
        return [*steps, (at, (robot, "", 0, 0))]

    def evaluation(self, robot: str, begin: float) -> list[tuple[float, tuple[str, str, int, int]]]:
        """Steps with their times; the last one is when the robot is done."""
        at, steps = begin, []
        inflation = self.times._evaluation._slower * self.slower
        for part, seconds in self.times._evaluation.of[robot].parts.items():
            count, took = 40 if " of " in part else 1, inflation * seconds * next(self.uneven)
            steps += [(at + took * (k + 1) / count, (robot, part, k + 1, count)) for k in range(count)]
            at += took
        return steps

    def side_by_side(
        self, work: Callable[[str, float], list[tuple[float, tuple[str, str, int, int]]]]
    ) -> None:
        """The same of all robots, as many at a time as there are workers."""
        free, steps = [self.now] * self.workers, []
        for robot in self.sizes:
            begin = min(free)
            made = work(robot, begin)
            free[free.index(begin)] = made[-1][0]
            steps += made
        for self.now, step in sorted(steps, key=lambda timed: timed[0]):
            if step[1] != "start":
                self.times.step(*step)
            self.said.append((self.now, self.times.left_s()))

    def run(self) -> float:
        """The time that it takes."""
        self.side_by_side(self.front_end)
        for stage, seconds in list(self.times._later):
            if stage == EVALUATION_OF_TEAM:
                self.times.step(OF_TEAM, "team", 0, 1)
            else:
                self.times.begin(stage)
            if stage == stages.EVALUATION.name:
                self.side_by_side(self.evaluation)
                continue
            for _ in range(10):
                self.said.append((self.now, self.times.left_s()))
                self.now += self.slower * seconds / 10
        return self.now


@pytest.mark.parametrize("robots", [1, 2, 5])
@pytest.mark.parametrize("slower", [0.4, 3.0])
def test_it_is_right_within_a_third_after_a_tenth(robots: int, slower: float) -> None:
    simulated = Simulated(robots, 2, slower, uneven=1.15)
    whole = simulated.run()
    heard = [(now, left) for now, left in simulated.said if 0.1 * whole <= now <= 0.95 * whole]
    assert len(heard) > 50
    # at the very end, when seconds are left, a twentieth of the whole is allowed
    wrong = [
        (now, left, whole - now)
        for now, left in heard
        if abs(left - (whole - now)) > max((whole - now) / 3, whole / 20)
    ]
    assert not wrong, wrong[:5]


@pytest.mark.parametrize("exact", [0, 1])
def test_how_maps_are_made_is_known_when_the_keyframes_are(exact: int) -> None:
    simulated = Simulated(1, 1, 1.0, uneven=1.0, exact=exact)
    simulated.times.step("robot0", KEYFRAMES["ray_plane" if exact else "blended"], 15, 15)
    size = {**simulated.sizes["robot0"], "keyframes": 15, "exact": exact}
    expected = durations.front_end_parts(size, MAPPING) | {"information": durations.information_s(size)}
    assert simulated.times._front.of["robot0"].parts == expected


def test_before_the_first_step_it_is_what_is_predicted() -> None:
    simulated = Simulated(2, 2, 1.0, uneven=1.0)
    predicted = simulated.times.left_s()
    assert predicted == pytest.approx(simulated.run(), rel=0.2)


def test_a_front_end_that_goes_on_is_not_taken_for_a_fast_one() -> None:
    fresh, resumed = Simulated(1, 1, 1.0, 1.0), Simulated(1, 1, 1.0, 1.0)
    steps = fresh.front_end("robot0", 0.0)
    for fresh.now, step in steps[:200]:
        fresh.times.step(*step)
    for now, step in steps[190:200]:
        resumed.now = durations.START_S + now - steps[190][0]
        resumed.times.step(*step)
    assert resumed.times.left_s() == pytest.approx(fresh.times.left_s(), rel=0.05)


def test_an_information_that_takes_long_counts_for_nothing_else() -> None:
    simulated = Simulated(2, 1, 1.0, 1.0)
    for now, step in simulated.front_end("robot0", 0.0)[:-1]:
        simulated.now = now
        simulated.times.step(*step)
    assert simulated.times._front.of["robot0"].now == ("information", simulated.now)
    before = simulated.times.left_s()
    simulated.now += 10 * durations.information_s({**simulated.sizes["robot0"], "keyframes": 15})
    assert simulated.times.left_s() <= before


def test_an_evaluation_that_is_slow_shows_while_it_is_at_work() -> None:
    simulated = Simulated(2, 2, 1.0, 1.0)
    predicted = dict(simulated.times._later)["evaluation"]
    simulated.times.begin("evaluation")
    before = simulated.times.left_s()
    for step in range(1, 11):
        simulated.now = step * 0.1 * predicted  # after the predicted time a third of it is done, or less
        for robot in ("robot0", "robot1"):
            simulated.times.step(robot, f"held_out of {robot}", 3 * step, 40)
    assert simulated.times.left_s() > before


def test_what_follows_the_evaluation_of_robots_is_not_forgotten() -> None:
    simulated = Simulated(8, 2, 1.0, 1.0)
    later = dict(simulated.times._later)
    of_robots, of_team = later["evaluation"], later[EVALUATION_OF_TEAM]
    readers = later["report"] + later["rrd"]
    simulated.times.begin("evaluation")
    simulated.now = 1.5 * of_robots
    for robot in range(8):
        simulated.times.step(f"robot{robot}", "agreement", 1, 1)
    simulated.times.step(OF_TEAM, "team", 0, 1)
    left = simulated.times.left_s()
    assert 1.2 * of_team + readers < left < 1.6 * (of_team + readers)
    simulated.now += of_team
    assert left - 1.5 * of_team < simulated.times.left_s() < left - 0.5 * of_team


def test_a_line_says_where_the_robots_are() -> None:
    simulated = Simulated(2, 2, 1.0, 1.0)
    simulated.times.step("robot0", "tracking", 30, 300)
    simulated.times.step("robot1", "robot1.final", 100, 1000)
    line = simulated.times.line()
    assert line.startswith("robot0: tracking 30/300, robot1: final 100/1000; ")
    assert line.endswith(" left of the run")
    assert [in_words(s) for s in (7.4, 150.0, 8000.0)] == ["7 s", "2.5 min", "2.2 h"]
