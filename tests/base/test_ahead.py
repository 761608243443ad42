"""Results in order, whichever is ready first."""

import threading
import time

import pytest

from duagc.pipeline.base.ahead import EACH, in_order


def test_results_are_in_order_and_few_are_ahead():
    begun = []

    def late(k):
        begun.append(k)
        time.sleep(0.002 * (k % 3 == 0))
        return k, threading.current_thread()

    found = in_order(late, range(40), threads=3)
    first, worker = next(found)
    assert len(begun) <= 3 * EACH + 1
    rest = list(found)
    assert [first, *(k for k, _ in rest)] == list(range(40))
    assert threading.main_thread() not in {worker, *(thread for _, thread in rest)}


def test_an_error_comes_in_its_place():
    def some(k):
        if k == 5:
            raise ValueError("five")
        return k

    found, got = in_order(some, range(1000), threads=2), []
    with pytest.raises(ValueError, match="five"):
        got.extend(found)
    assert got == list(range(5))


def test_results_that_nobody_takes_are_dropped_without_waiting():
    """As the garbage collector drops them, at a moment that may be the wrong one to wait for a thread."""
    go_on, begun = threading.Event(), []

    def wait(k):
        if k > 0:
            go_on.wait(60)
        begun.append(k)

    found = in_order(wait, range(100), threads=2)
    next(found)
    dropped = threading.Thread(target=found.close, daemon=True)
    dropped.start()
    dropped.join(10)
    closed = not dropped.is_alive()
    go_on.set()
    assert closed
    for thread in threading.enumerate():
        if thread.name.startswith("ThreadPoolExecutor"):
            thread.join(10)
    assert len(begun) <= 3


def test_nothing_gives_nothing():
    assert list(in_order(str, [])) == []
