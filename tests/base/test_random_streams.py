"""Numbers drawn in turn."""

from itertools import islice

import pytest

from duagc.pipeline.base import random_streams


def drawn(steps: int, count: int = 5, *, first: int = 0, **key: int) -> list[tuple[int, int]]:
    return list(islice(random_streams.in_turn(7, "test", count, first=first, **key), steps))


def test_each_comes_once_before_any_comes_again_and_its_turns_are_counted() -> None:
    steps = drawn(15)
    for turn in range(3):
        assert sorted(number for number, _ in steps[5 * turn : 5 * turn + 5]) == [0, 1, 2, 3, 4]
    assert len({tuple(number for number, _ in steps[5 * turn : 5 * turn + 5]) for turn in range(3)}) == 3
    turns_of = {k: [turn for number, turn in steps if number == k] for k in range(5)}
    assert all(turns == list(range(turns[0], turns[0] + 3)) for turns in turns_of.values())
    assert {turns[0] % 2 for turns in turns_of.values()} == {0, 1}  # neighbors differ


@pytest.mark.parametrize("first", [0, 3, 5, 12])
def test_it_begins_anywhere(first: int) -> None:
    assert drawn(9, first=first) == drawn(9 + first)[first:]


def test_a_key_draws_another_order_and_none_is_an_error() -> None:
    assert drawn(10, tile=1) != drawn(10)
    with pytest.raises(ValueError, match="count is 0"):
        drawn(1, count=0)
