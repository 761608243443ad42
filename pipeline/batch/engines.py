"""Where cells run. An engine starts a cell, and says which one has ended."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Mapping
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType
from typing import Protocol

from duagc.pipeline.base.stop_signals import held_back, leave_to_parent, start_resource_tracker
from duagc.pipeline.base.workers import end_with_parent
from duagc.pipeline.batch.cell import enter
from duagc.pipeline.batch.clusters import RayEngine, SlurmEngine


class Engine(Protocol):
    """Carries out cells."""

    slots: int
    """Cells at the same time."""

    def submit(self, name: str, arguments: Mapping[str, str]) -> None:
        """Start a cell.

        Args:
            name: of it.
            arguments: of `batch.cell.enter`.
        """

    def wait(self) -> str:
        """Wait until a cell has ended, well or not, and return its name."""


class LocalEngine:
    """Processes of this machine, each with a share of its processors; use it as a context manager."""

    def __init__(self, slots: int) -> None:
        """Divide the processors that this process may use among the slots; no cell runs yet.

        Args:
            slots: cells at the same time.
        """
        usable = sorted(os.sched_getaffinity(0))
        self.slots = slots
        self._shares = [tuple(usable[k::slots]) or (usable[k % len(usable)],) for k in range(slots)]
        self._running: dict[str, tuple[BaseProcess, int]] = {}

    def __enter__(self) -> LocalEngine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process, _ in self._running.values():
            process.terminate()
        for process, _ in self._running.values():
            process.join()

    def submit(self, name: str, arguments: Mapping[str, str]) -> None:
        """Start a cell in a process of its own.

        Args:
            name: of it.
            arguments: of `batch.cell.enter`.
        """
        taken = {slot for _, slot in self._running.values()}
        slot = next(k for k in range(self.slots) if k not in taken)
        start_resource_tracker()
        process = multiprocessing.get_context("spawn").Process(
            target=_begin, args=(dict(arguments), self._shares[slot])
        )
        with held_back():
            process.start()
        self._running[name] = (process, slot)

    def wait(self) -> str:
        """Wait until a cell has ended, and return its name."""
        sentinels = {process.sentinel: name for name, (process, _) in self._running.items()}
        name = sentinels[wait(list(sentinels))[0]]  # type: ignore[index]
        process, _ = self._running.pop(name)
        process.join()
        return name


def engine_of(name: str, slots: int, out: Path) -> LocalEngine | SlurmEngine | RayEngine:
    """An engine by its name.

    Args:
        name: local, slurm or ray.
        slots: cells at the same time.
        out: folder of the batch.

    Raises:
        DuagError: the package of the engine is not installed, or it is not on this machine.
    """
    if name == "slurm":
        return SlurmEngine(slots, out / "slurm")
    return RayEngine(slots) if name == "ray" else LocalEngine(slots)


def _begin(arguments: dict[str, str], processors: tuple[int, ...]) -> None:
    leave_to_parent()
    threading.Thread(target=end_with_parent, daemon=True).start()
    enter(arguments, processors)
