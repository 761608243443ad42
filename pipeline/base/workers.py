"""Worker processes that end with whoever started them: on an error, on Ctrl-C, and when the parent is killed.

Light on purpose: a fresh process imports this module first, and from then on it leaves Ctrl-C to its parent.
"""

import multiprocessing
import multiprocessing.util
import os
import pickle
import resource
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from ctypes import c_bool
from pathlib import Path
from typing import Any

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.stop_signals import held_back, leave_to_parent, start_resource_tracker

LOW_PRIORITY = 10
"""Nice value of what can wait: a tenth of a processor is left to it next to a task that cannot."""
NOT_BEGUN = (
    "a worker process could not import the main script, expected a file with its work under "
    '`if __name__ == "__main__":`'
)
ENDED = "a worker process ended before its task, expected it to finish; was it killed, or out of memory?"
LAST = -100  # of what a process does at its end
_handed_down: list[tuple[Callable[[], Any], Callable[[Any], None]]] = []


def hand_down(known: Callable[[], Any], learn: Callable[[Any], None]) -> None:
    """Let worker processes begin with something that this one has found out, and would find out again.

    Args:
        known: gives it when processes are about to start.
        learn: called with it in each of them, before its first task.
    """
    _handed_down.append((known, learn))


@contextmanager
def worker_pool(
    workers: int,
    start: Callable[..., None] | None = None,
    arguments: tuple[Any, ...] = (),
) -> Iterator[ProcessPoolExecutor]:
    """A pool of fresh processes, each kept for all its tasks: replacing them (`max_tasks_per_child`) can hang.

    Args:
        workers: how many.
        start: called once in each of them before its first task.
        arguments: of `start`.

    Raises:
        DuagError: a process ended before its task did, for example for want of memory.
    """
    start_resource_tracker()
    before = {child.pid for child in multiprocessing.active_children()}
    context = multiprocessing.get_context("spawn")
    begun = context.RawValue(c_bool, False)
    pool = ProcessPoolExecutor(
        workers,
        context,
        _begin,
        (begun, pickle.dumps([(learn, known()) for known, learn in _handed_down]), start, arguments),
    )
    try:
        yield pool
    except BaseException as error:
        for child in multiprocessing.active_children():
            if child.pid not in before:
                child.terminate()
        pool.shutdown(cancel_futures=True)
        if isinstance(error, BrokenProcessPool):
            raise DuagError(ENDED if begun.value else NOT_BEGUN) from error
        raise
    pool.shutdown()


def start_now(pool: ProcessPoolExecutor, workers: int) -> None:
    """Start the processes of a pool before there is work for them, so that they import meanwhile.

    Ctrl-C waits until they are started, and does not reach them before they leave it to their parent.

    Args:
        pool: of `worker_pool`.
        workers: how many it has.
    """
    with held_back():
        for _ in range(workers):
            pool.submit(_nothing)


def _nothing() -> None:
    """That a process is asked for it makes it start."""


def _begin(
    begun: c_bool, handed_down: bytes, start: Callable[..., None] | None, arguments: tuple[Any, ...]
) -> None:
    leave_to_parent()
    begun.value = True
    threading.Thread(target=end_with_parent, daemon=True).start()
    multiprocessing.util.Finalize(None, _end, exitpriority=LAST)
    # what it is of is imported here, and not before Ctrl-C is the parent's
    for learn, known in pickle.loads(handed_down):
        learn(known)
    if start is not None:
        start(*arguments)


def _end() -> None:
    """End at once: what a process has sent is sent, and to take its objects apart takes tenths of a second."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(0)


def end_with_parent() -> None:
    """Wait for the parent process to end, and end then."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def when_idle(do: Callable[[], None]) -> None:
    """Do something mostly in the time that others leave of the processors, where that can be asked for.

    Args:
        do: what to do; its errors are raised here.
    """
    with ThreadPoolExecutor(1, initializer=_lower_priority) as thread:
        thread.submit(do).result()


def _lower_priority() -> None:
    """Of this thread, for good; only on Linux have threads priorities of their own."""
    if sys.platform == "linux":
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), LOW_PRIORITY)


def peak_memory_bytes() -> int:
    """Most memory that this process has held. `getrusage` would count the parent that it was started from."""
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text(errors="replace").splitlines():  # the name may be cut in a letter
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
