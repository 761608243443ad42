"""What the two ends of a full link say and do, round by round: delays, windows, rates, queues."""

import pytest

from duagc.pipeline.network.congestion import (
    FULL_ROUNDS,
    LEAST_HEARD,
    MOST_WINDOW_ROUNDS,
    WINDOW_ROUNDS,
    Congestion,
    LinkObserver,
    SendRate,
)
from duagc.pipeline.network.packets import MAX_PACKET_BYTES

BUDGET_BYTES = 150_000


def heard(observer: LinkObserver, now: int, late: int, *, count: int = LEAST_HEARD, first: int = 0) -> None:
    for k in range(count):
        observer.heard(first + k, now - late, now, 1200)


def test_a_round_that_is_still_to_come_makes_no_link_full() -> None:
    """Whoever writes a later round than the present one is no faster than light."""
    observer = LinkObserver()
    observer.heard(0, 90, 1, 1200)
    heard(observer, 2, 0, first=1)
    assert observer.least_delay == 0
    assert observer.congestion(2) is None


@pytest.mark.parametrize("age", [MOST_WINDOW_ROUNDS - 1, MOST_WINDOW_ROUNDS])
def test_what_was_heard_long_ago_says_nothing(age: int) -> None:
    observer = LinkObserver()
    observer.heard(0, 0, 0, 1200)
    heard(observer, 20, 5, first=1)
    said = observer.congestion(20 + age)
    assert (said is None) == (age == MOST_WINDOW_ROUNDS)


def test_a_link_is_full_by_the_delay_of_the_fastest_of_the_last_packets() -> None:
    observer = LinkObserver()
    observer.heard(0, 0, 3, 1200)  # nothing comes faster than in three rounds
    heard(observer, 30, 3 + FULL_ROUNDS, first=1)
    said = observer.congestion(30)
    assert said is not None
    assert said.excess_rounds == FULL_ROUNDS
    assert said.sent_round == 30 - 3 - FULL_ROUNDS
    observer.heard(100, 27, 30, 1200)
    assert observer.congestion(30) is None


def test_what_a_link_carries_is_what_is_heard_and_what_was_lost_on_it() -> None:
    """Three rounds, in each of which every second packet of a burst of 21 is heard: all of them were carried."""
    observer = LinkObserver()
    observer.heard(0, 0, 0, 1200)
    for now in range(30, 30 + WINDOW_ROUNDS):
        for k in range(0, 21, 2):
            observer.heard(100 * now + k, now - 5, now, 1200)
    said = observer.congestion(29 + WINDOW_ROUNDS)
    assert said is not None
    assert said.bytes_per_round == pytest.approx(11 * 1200 * 20 / 10)  # 20 gaps of which 10 were bridged


def test_a_sender_pauses_until_its_queue_is_empty() -> None:
    rate = SendRate()
    assert rate.queued_rounds == 0
    rate.take(Congestion(6, 10_000, 3), 8)
    assert rate.queued_rounds == 6
    for now in range(8, 13):
        assert rate.budget(BUDGET_BYTES, now) < 3_000
        rate.sent(0, 0, BUDGET_BYTES, now, round_trip=4, more=False)
        assert rate.queued_rounds == 13 - now  # a round's worth has left it
    assert rate.budget(BUDGET_BYTES, 13) == 10_000
    rate.sent(25_000, 0, BUDGET_BYTES, 13, round_trip=4, more=False)
    assert rate.queued_rounds == 2


def test_the_rate_falls_to_what_is_carried_but_not_by_more_than_it_must() -> None:
    rate = SendRate()
    rate.take(Congestion(2, 10_000, 3), 5)
    rate.take(Congestion(2, 8_000, 20), 22)  # a tenth less is tried first
    assert rate.limit == 9_000
    rate.take(Congestion(2, 2_000, 40), 42)  # much less: the link is another one
    assert rate.limit == 2_000
    rate.take(Congestion(2, 50_000, 60), 62)  # more than is sent: never a reason to send more
    assert rate.limit == 2_000
    assert rate.take(Congestion(9, 100, 62), 70) == 0  # of packets from before the last answer
    assert rate.limit == 2_000


def test_what_is_left_of_a_budget_is_one_packet_at_most() -> None:
    rate = SendRate()
    rate.take(Congestion(2, 5_000, 3), 5)
    rate.sent(4_000, 1_000, BUDGET_BYTES, 8, round_trip=40, more=True)
    assert rate.budget(BUDGET_BYTES, 9) == 6_000
    rate.sent(0, 4_000, BUDGET_BYTES, 9, round_trip=40, more=True)
    assert rate.budget(BUDGET_BYTES, 10) == 5_000 + MAX_PACKET_BYTES
    rate.sent(0, 4_000, BUDGET_BYTES, 10, round_trip=40, more=False)
    assert rate.budget(BUDGET_BYTES, 11) == 5_000


def test_a_guess_is_made_once_and_never_over_a_report() -> None:
    rate = SendRate()
    rate.guess(Congestion(3, 7_000, 1), 4)
    assert rate.limit == 7_000
    rate.guess(Congestion(3, 1_000, 2), 5)
    assert rate.limit == 7_000
    rate.take(Congestion(3, 6_500, 6), 9)
    rate.guess(Congestion(3, 90_000, 7), 10)
    assert rate.limit == 6_500
