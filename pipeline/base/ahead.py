"""Work on the items of a sequence by threads, its results in order: decoding and encoding of images."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

from duagc.pipeline.base.machine import processors

Item = TypeVar("Item")
Result = TypeVar("Result")

EACH = 2  # items that are under way or wait to be taken, for each thread


def in_order(
    work: Callable[[Item], Result], items: Iterable[Item], threads: int | None = None
) -> Iterator[Result]:
    """Results of all items, in their order; a few are computed ahead of the one that is taken.

    What `work` raises is raised in the place of its result; what was begun after it is dropped.
    Results that nobody takes are dropped without waiting for the threads, which end soon: the garbage collector may
    close this iterator inside any allocation, also where the interpreter holds a lock that a thread needs to end.

    Args:
        work: done by threads; it must not depend on the order of the items.
        items: read by the caller's thread only.
        threads: how many; None: as many as this process may use.
    """
    threads = threads or processors()
    waiting: deque[Future[Result]] = deque()
    left = iter(items)
    pool = ThreadPoolExecutor(threads)
    try:
        waiting.extend(pool.submit(work, item) for item in islice(left, EACH * threads))
        while waiting:
            yield waiting.popleft().result()
            waiting.extend(pool.submit(work, item) for item in islice(left, 1))
    except GeneratorExit:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    except BaseException:
        pool.shutdown(cancel_futures=True)
        raise
    pool.shutdown()
