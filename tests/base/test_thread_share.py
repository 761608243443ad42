"""Threads of processes that work side by side."""

from __future__ import annotations

import operator
import time
from pathlib import Path

from duagc.pipeline.base.thread_share import SharedThreads, ThreadShare, keep_share
from duagc.pipeline.base.workers import worker_pool

PATIENCE_S = 30.0


def threads_until(enough: int) -> list[int]:
    """The numbers of threads that this process may use, until they are enough."""
    threads, seen, end_s = SharedThreads(), list[int](), time.monotonic() + PATIENCE_S
    while not seen or (seen[-1] < enough and time.monotonic() < end_s):
        now = operator.index(threads)
        if seen[-1:] != [now]:
            seen.append(now)
        time.sleep(0.001)
    return seen


def wait_for(path: Path) -> int:
    """Work until a file is there; the threads that this process may use by then."""
    end_s = time.monotonic() + PATIENCE_S
    while not path.exists() and time.monotonic() < end_s:
        time.sleep(0.001)
    return operator.index(SharedThreads())


def test_the_last_process_gets_the_threads_of_those_that_ended(tmp_path: Path) -> None:
    share = ThreadShare(workers=2, tasks=3, in_all=8)
    with worker_pool(2, keep_share, share.handed) as pool:
        first = pool.submit(wait_for, tmp_path / "go")
        second = pool.submit(wait_for, tmp_path / "go")
        last = pool.submit(threads_until, 8)
        for task in (first, second, last):
            task.add_done_callback(share.done)
        (tmp_path / "go").touch()
        assert (first.result(), second.result()) == (4, 4)
        assert last.result()[-1] == 8


def test_there_is_always_one_thread() -> None:
    assert operator.index(SharedThreads()) == 1  # a process that has no part in any
    share = ThreadShare(workers=4, tasks=2, in_all=3)
    busy, in_all = share.handed
    assert (busy.value, in_all) == (2, 3)
    for _ in range(2):
        share.done(None)
    assert busy.value == 1
