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


def test_nothing_gives_nothing():
    assert list(in_order(str, [])) == []
