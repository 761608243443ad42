"""Checkpoints of a long computation: a process that was killed is followed by one that goes on where it was.

The computation names its parts. A part that goes step by step hands out its state after every step (`at`), and begins
with the last one that was saved (`resume`); a part that ends in a value hands out that (`done`). What is saved, and
when, changes no bit of any result: a state that is missing or damaged is computed again.

    <name>.state    where a part is
    <name>.done     what a part ended in
    once.<digest>   objects that never change, written once, however many states have them
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol, TypeVar

from duagc.pipeline.base.lap_times import LapTimes
from duagc.pipeline.base.saved_state import DamagedStateError, StateFile, write_state

EVERY_S = 5.0
LARGEST_SHARE = 0.02
"""Of the time that checkpoints may take; where one takes so long, the next one comes later."""
LONGEST_S, LARGEST_SHARE_THEN = 8.0, 0.1
"""Checkpoints come after at most this time all the same, unless they would take more than this share of it: a process
that is killed loses no more than ten seconds where a checkpoint takes less than one."""
WORTH_S = 1.0
"""A part that took less is computed again rather than saved."""
Shown = Callable[[], Any]
"""Gives what can be shown of a part while it is computed."""
Value = TypeVar("Value")
Item = TypeVar("Item")


class StepReport(Protocol):
    """Hears of every step, and changes nothing."""

    def __call__(self, part: str, done: int, total: int, shown: Shown | None) -> None:
        """Hear of one.

        Args:
            part: its name.
            done: steps.
            total: steps.
            shown: gives what can be shown; None: nothing can.
        """


class Checkpoints:
    """Saves where a computation is; without a folder it saves nothing."""

    def __init__(
        self,
        folder: Path | None = None,
        *,
        say: Callable[[str], None] = lambda line: None,
        every_s: float = EVERY_S,
        largest_share: float = LARGEST_SHARE,
        report: StepReport | None = None,
    ) -> None:
        """Begin with nothing saved or read; the time until the first checkpoint runs from now.

        Args:
            folder: of this computation alone; made when something is saved. None: nothing is saved.
            say: gets a line where the computation goes on, and where a state is damaged or cannot be saved.
            every_s: time between two checkpoints.
            largest_share: of the time that checkpoints may take.
            report: called after every step with the name of the part, steps done, steps in all, and what can be
                shown.
        """
        self._folder, self._say, self._report = folder, say, report
        self._every_s, self._largest_share = every_s, largest_share
        self._once: tuple[type, ...] = ()
        self._allowed: tuple[type, ...] = ()
        self._known: dict[str, Any] = {}
        self._names: dict[int, str] = {}
        self._clock = LapTimes()
        self._batches: list[tuple[str, list[Any]]] = []  # digest of the file, and its objects
        self._numbers: dict[int, tuple[int, int]] = {}  # by id of an object: batch, place there
        self._new: list[Any] = []  # objects that no batch has yet
        self._saved_s = time.perf_counter()
        self._began = _now()
        self._before = (0.0, 0.0)
        self.cost_s = 0.0
        self.saved = 0
        self._last_cost_s = 0.0

    def consist_of(
        self,
        clock: LapTimes,
        *,
        once: Sequence[type] = (),
        allowed: Sequence[type] = (),
        known: Mapping[str, Any] | None = None,
    ) -> None:
        """Say what states are made of, before the first of them.

        Args:
            clock: of the parts; goes on too.
            once: classes of objects that never change and are in many states.
            allowed: classes besides data classes and enumerations of this package.
            known: objects that the computation has anyway, by name; they are not saved.
        """
        self._clock, self._once, self._allowed = clock, tuple(once), tuple(allowed)
        self._known = {name: value for name, value in (known or {}).items() if value is not None}
        self._names = {id(value): name for name, value in self._known.items()}

    @property
    def folder(self) -> Path | None:
        """Of this computation; None: nothing is saved."""
        return self._folder

    @property
    def before_s(self) -> tuple[float, float]:
        """Wall and processor time of the processes whose work goes on here."""
        return self._before

    def say(self, line: str) -> None:
        """Say something about the computation.

        Args:
            line: without its end.
        """
        self._say(line)

    def resume(self, name: str) -> tuple[int, Any] | None:
        """Where a part was: steps done, and its state; None: it begins.

        Args:
            name: of the part.
        """
        found = self._read(f"{name}.state")
        if found is None:
            return None
        state, done, total = found
        where = f"at {done}/{total}" if done < total else f"with {done} results"
        self._say(f"{name}: goes on {where}")
        return done, state

    def tell(self, name: str, done: int, total: int, shown: Shown | None = None) -> None:
        """Say where a part is that is too short to be saved.

        Args:
            name: of the part.
            done: steps.
            total: steps.
            shown: gives what can be shown of it.
        """
        if self._report is not None:
            self._report(name, done, total, shown)

    def at(
        self,
        name: str,
        done: int,
        total: int,
        state: Callable[[], Any],
        *,
        shown: Shown | None = None,
    ) -> None:
        """Say where a part is, after a step of it; saved if that is due.

        Args:
            name: of the part.
            done: steps.
            total: steps.
            state: from which the part can go on; asked for only if it is saved.
            shown: gives what can be shown of it.
        """
        self.tell(name, done, total, shown)
        cost_s = self._last_cost_s
        due_s = min(cost_s / self._largest_share, max(LONGEST_S, cost_s / LARGEST_SHARE_THEN))
        if time.perf_counter() - self._saved_s >= max(self._every_s, due_s):
            self._write(f"{name}.state", (state(), done, total))

    def done(self, name: str, compute: Callable[[], Value]) -> Value:
        """What a part ends in.

        Args:
            name: of the part.
            compute: does it.
        """
        if self._folder is None:
            return compute()
        found = self._read(f"{name}.done")
        if found is not None:
            return found[0]
        began_s = self._spent_s()[0]
        value = compute()
        if self._spent_s()[0] - began_s >= min(WORTH_S, self._every_s):
            self._write(f"{name}.done", (value,))
        return value

    def each(self, name: str, items: Sequence[Item], compute: Callable[[Item], Value]) -> list[Value]:
        """What is computed of every item, in order.

        Args:
            name: of the part.
            items: that it is computed of, each by itself.
            compute: does it for one.
        """
        out: list[Value] = (self.resume(name) or (0, []))[1]
        for item in items[len(out) :]:
            out.append(compute(item))
            self.at(name, len(out), len(items), lambda: out)
        return out

    def _named(self, obj: Any) -> Any:
        kind = type(obj)
        if kind in self._once:
            place = self._numbers.get(id(obj))
            if place is None:
                place = len(self._batches), len(self._new)
                self._numbers[id(obj)] = place
                self._new.append(obj)
            return place
        return self._names.get(id(obj))

    def _known_name(self, obj: Any) -> Any:
        return self._names.get(id(obj))

    def _write(self, file: str, value: Any) -> None:
        """Save something, with the time that it took so far."""
        if self._folder is None:
            return
        began = time.perf_counter()
        self._new = []
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            write_state(self._folder / file, value, self._head, self._named)
        except OSError as error:
            self._say(
                f"warning: {self._folder}: {error.strerror or error}; the computation goes on without checkpoints"
            )
            self._folder = None  # what was saved before stays: from there the next process goes on
        self._saved_s = time.perf_counter()
        self._last_cost_s = self._saved_s - began
        self.cost_s += self._last_cost_s
        self.saved += 1

    def _head(self) -> dict[str, Any]:
        """What stands before a state; objects that are new in it are written now."""
        assert self._folder is not None
        if self._new:
            path = self._folder / "once.new"
            digest = write_state(path, self._new, dict, self._known_name)
            path.rename(self._folder / f"once.{digest}")
            self._batches.append((digest, self._new))
        wall, cpu = self._spent_s()
        return {
            "once": [digest for digest, _ in self._batches],
            "wall_s": wall,
            "cpu_s": cpu,
            "laps": self._clock.laps,
            "open_s": self._clock.open_s,
        }

    def _spent_s(self) -> tuple[float, float]:
        """Wall and processor time of this computation, in all processes that did a part of it."""
        now = _now()
        return self._before[0] + now[0] - self._began[0], self._before[1] + now[1] - self._began[1]

    def _read(self, file: str) -> Any:
        """What was saved; None if nothing was, or it is damaged."""
        if self._folder is None:
            return None
        path = self._folder / file
        try:
            saved = StateFile(path)
            batches = [self._batch(digest) for digest in saved.head["once"]]

            def named(name: Any) -> Any:
                if isinstance(name, str):
                    return self._known[name]
                return self._batches[batches[name[0]]][1][name[1]]

            value = saved.value(named, self._allowed)
        except NotADirectoryError:
            return None
        except FileNotFoundError as error:
            if error.filename != str(path):
                self._say(f"{error.filename}: is gone; {path.name} is computed again")
            return None
        except (DamagedStateError, OSError, ValueError, KeyError, TypeError) as error:
            self._say(f"{error or path}; computed again")
            with suppress(OSError):
                path.unlink()
            return None
        self._before, self._began = (saved.head["wall_s"], saved.head["cpu_s"]), _now()
        self._clock.go_on(saved.head["laps"], saved.head["open_s"])
        return value

    def _batch(self, digest: str) -> int:
        """The place of a batch of objects, which is read if it was not yet."""
        for place, (known, _) in enumerate(self._batches):
            if known == digest:
                return place
        assert self._folder is not None
        saved = StateFile(self._folder / f"once.{digest}", digest)
        objects = saved.value(self._known.__getitem__, self._allowed)
        self._batches.append((digest, objects))
        place = len(self._batches) - 1
        self._numbers |= {id(obj): (place, at) for at, obj in enumerate(objects)}
        return place


def _now() -> tuple[float, float]:
    """Wall and processor time."""
    return time.perf_counter(), time.process_time()


NO_CHECKPOINTS = Checkpoints()
