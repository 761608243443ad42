"""Threads of processes that work side by side: when some have no more to do, the others may use more.

No result depends on how many threads computed it, so the number may change at any time.
"""

from __future__ import annotations

import multiprocessing
import threading
from ctypes import c_int
from typing import Any

from duagc.pipeline.base.machine import processors
from duagc.pipeline.base.stop_signals import start_resource_tracker

_of_this_process: list[tuple[c_int, int]] = []


def threads_per_worker(workers: int) -> int:
    """Threads of each of `workers` processes on this machine.

    Args:
        workers: number of processes, 1 or more.
    """
    return max(1, processors() // workers)


class ThreadShare:
    """How many processes are at work on some tasks, as these processes see it."""

    def __init__(self, workers: int, tasks: int, in_all: int | None = None) -> None:
        """Count every worker as busy for which there is a task.

        Args:
            workers: processes, each with one task at a time.
            tasks: how many there are.
            in_all: threads of all processes together; None: as many as this process may use.

        Raises:
            DuagError: this machine has no place where processes can share what they know.
        """
        self._workers, self._left, self._lock = workers, tasks, threading.Lock()
        start_resource_tracker()
        self._busy = multiprocessing.get_context("spawn").RawValue(c_int, max(1, min(workers, tasks)))
        self._in_all = in_all or processors()

    @property
    def handed(self) -> tuple[c_int, int]:
        """What a process gets for `keep_share`, while it starts."""
        return self._busy, self._in_all

    def done(self, task: Any) -> None:
        """Say that a task has ended.

        Args:
            task: which; as a future hands itself to its callbacks.
        """
        with self._lock:
            self._left -= 1
            self._busy.value = max(1, min(self._workers, self._left))


def keep_share(busy: c_int, in_all: int) -> None:
    """Which share this process has part in.

    Args:
        busy: processes at work.
        in_all: threads of all of them together.
    """
    _of_this_process.append((busy, in_all))


class SharedThreads:
    """A number of threads that grows when other processes of the share end (a `SupportsIndex`)."""

    def __index__(self) -> int:
        """Threads that this process may use now."""
        if not _of_this_process:
            return 1
        busy, in_all = _of_this_process[-1]
        return max(1, in_all // busy.value)
