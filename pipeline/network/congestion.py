"""How much a link takes, by what its two ends see of each other: delays in rounds, sequence numbers, nothing else.

The receiver knows from every packet the round in which it was sent. Where even the fastest of the last packets took
rounds longer than the fastest ever, packets wait in the sender's queue: the link is full. It then reports by how many
rounds, and how many bytes a round the link carries. That is not what arrives: packets lost on the link were carried as
well. Their share follows from the gaps between packets of one burst, because a full queue drops the end of a burst and
loss drops any part of it. Loss alone, of whatever share, delays nothing and therefore slows nothing down.

The sender then lets the queue run empty, goes on at the reported rate, and tries for more as long as nothing is
delayed. A link on which nothing waits causes no report and has no limit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from duagc.pipeline.network.packets import MAX_PACKET_BYTES

FULL_ROUNDS = 2
"""Excess delay from which a link counts as full. At a rate that just fits, the end of a burst is one round late."""
WINDOW_ROUNDS, MOST_WINDOW_ROUNDS = 3, 12
MOST_ROUNDS = 32  # that a sender pauses or holds, whatever is reported
LEAST_HEARD = 8  # packets in the window; it is as long as it takes to hear them, or says nothing
MOST_BYTES_PER_ROUND = 2**32 - 1  # that a report has room for
LEAST_BUDGET_BYTES = 2_400  # acknowledgements and states always go
DECREASE = 0.9
FIRST_INCREASE, LARGEST_INCREASE = 0.05, 0.5
CAREFUL_INCREASES = 3  # of the first size; then each is twice the one before


@dataclass(frozen=True)
class Congestion:
    """What a receiver says of a link that is full.

    Attributes:
        excess_rounds: delay beyond the least one ever seen.
        bytes_per_round: that the link carries, lost packets included.
        sent_round: in which the last of the packets was sent that show it.
    """

    excess_rounds: int
    bytes_per_round: int
    sent_round: int


@dataclass
class _Train:
    """Packets that were sent in one round."""

    first: int
    last: int
    heard: int = 0


@dataclass
class _Round:
    """Packets heard in one round: least delay, bytes, and by the round in which they were sent."""

    index: int
    least_delay: int
    bytes: int = 0
    trains: dict[int, _Train] = field(default_factory=dict)


class LinkObserver:
    """The receiving end: whether the packets that arrive had to wait."""

    def __init__(self) -> None:
        """Nothing was heard."""
        self.least_delay: int | None = None
        self._rounds: deque[_Round] = deque()

    def heard(self, sequence: int, sent_round: int, round_index: int, size: int) -> None:
        """Count one packet.

        Args:
            sequence: its number on this directed link.
            sent_round: in which it was sent.
            round_index: the current round.
            size: bytes, headers included.
        """
        delay = max(0, round_index - sent_round)
        self.least_delay = delay if self.least_delay is None else min(self.least_delay, delay)
        if not self._rounds or self._rounds[-1].index != round_index:
            self._rounds.append(_Round(round_index, delay))
        now = self._rounds[-1]
        now.least_delay = min(now.least_delay, delay)
        now.bytes += size
        train = now.trains.setdefault(sent_round, _Train(sequence, sequence))
        train.first, train.last = min(train.first, sequence), max(train.last, sequence)
        train.heard += 1

    def congestion(self, round_index: int) -> Congestion | None:
        """What to report to the sender; None if its packets do not wait, or too few were heard.

        Args:
            round_index: the current round.
        """
        excess = self.excess_rounds(round_index)
        if excess < FULL_ROUNDS:
            return None
        window = self._window(round_index)
        sent_round = max(k for r in window for k in r.trains)
        return Congestion(excess, _carried(window, round_index), sent_round)

    def excess_rounds(self, round_index: int) -> int:
        """By how many rounds the packets heard lately were late, at least; 0 if too few were heard.

        Args:
            round_index: the current round.
        """
        window = self._window(round_index)
        if not window or self.least_delay is None:
            return 0
        return min(r.least_delay for r in window) - self.least_delay

    def _window(self, round_index: int) -> list[_Round]:
        """The last rounds, as many as it takes to hear enough packets; none if that takes too many."""
        while self._rounds and self._rounds[0].index <= round_index - MOST_WINDOW_ROUNDS:
            self._rounds.popleft()
        window, heard = list[_Round](), 0
        for r in reversed(self._rounds):
            if heard >= LEAST_HEARD and r.index <= round_index - WINDOW_ROUNDS:
                break
            window.append(r)
            heard += sum(train.heard for train in r.trains.values())
        return window if heard >= LEAST_HEARD else []


def _carried(rounds: Sequence[_Round], round_index: int) -> int:
    """Bytes a round that a full link carries: what was heard, and what was lost between packets of one burst."""
    trains = dict[int, _Train]()
    for sent_round, part in ((k, train) for r in rounds for k, train in r.trains.items()):
        whole = trains.setdefault(sent_round, _Train(part.first, part.last))
        whole.first, whole.last = min(whole.first, part.first), max(whole.last, part.last)
        whole.heard += part.heard
    spans = sum(train.last - train.first for train in trains.values())
    within = sum(train.heard - 1 for train in trains.values())
    share = within / spans if within else 1.0
    carried = sum(r.bytes for r in rounds) / share / max(WINDOW_ROUNDS, 1 + round_index - rounds[-1].index)
    return min(int(carried), MOST_BYTES_PER_ROUND)  # sequence numbers may be anything that a sender writes


class SendRate:
    """The sending end: how many bytes may go in a round.

    Attributes:
        limit: bytes a round; None as long as the link was never full.
        guessed: a first limit was taken from the other direction.
    """

    def __init__(self, largest_packet_bytes: int = MAX_PACKET_BYTES) -> None:
        """There is no limit.

        Args:
            largest_packet_bytes: headers included; so much of a budget can wait for the next round.
        """
        self._largest_packet_bytes = largest_packet_bytes
        self.limit: float | None = None
        self.guessed = False
        self._answered_round = self._pause_until = self._raised_round = -1
        self._increases = 0
        self._left = self._queued = 0.0

    def take(self, said: Congestion, round_index: int) -> int:
        """The receiver says that the link is full.

        What it says of packets that were sent before the last answer changes nothing.

        Args:
            said: by the receiver.
            round_index: the current round.
        Returns:
            By how many rounds everything is late that was sent before; 0 if that was known.
        """
        excess = min(said.excess_rounds, MOST_ROUNDS)
        if said.sent_round <= self._answered_round:
            return 0
        carried = float(max(said.bytes_per_round, 1))
        if self.limit is None or carried < 0.5 * self.limit:
            self.limit = carried
        else:
            self.limit = min(self.limit, max(DECREASE * self.limit, carried))
        self._increases = 0
        self._answered_round = self._raised_round = round_index
        self._pause_until = round_index + excess - 1
        self._queued = excess * self.limit
        return excess

    def guess(self, other_way: Congestion, round_index: int) -> None:
        """The other direction of the link is full: begin with as much as it takes, once.

        Where both ends begin at once, what each says of the other waits behind all that it has sent itself.

        Args:
            other_way: what this end sees of the packets that it gets.
            round_index: the current round.
        """
        if self.limit is None and not self.guessed:
            self.limit, self._raised_round = float(max(other_way.bytes_per_round, 1)), round_index
        self.guessed = True

    @property
    def queued_rounds(self) -> int:
        """Rounds that the next packet will wait, as far as this end knows."""
        return 0 if self.limit is None else int(self._queued / self.limit)

    def budget(self, most_bytes: int, round_index: int) -> int:
        """Bytes that may be sent now.

        Args:
            most_bytes: that may be sent in any round.
            round_index: the current round.
        """
        if self.limit is None:
            return most_bytes
        if round_index < self._pause_until:
            return int(min(most_bytes, LEAST_BUDGET_BYTES, self.limit))
        return int(min(most_bytes, self.limit + self._left))

    def sent(
        self,
        sent_bytes: int,
        left_bytes: int,
        most_bytes: int,
        round_index: int,
        *,
        round_trip: int,
        more: bool,
    ) -> None:
        """The packets of a round are known: where more would have been sent, perhaps try for more.

        Args:
            sent_bytes: in this round.
            left_bytes: of the budget.
            most_bytes: that may be sent in any round.
            round_index: the current round.
            round_trip: rounds there and back when nothing waits.
            more: something had to wait.
        """
        wait_rounds = (
            round_trip + FULL_ROUNDS + WINDOW_ROUNDS
        )  # after which a report of the last try would be here
        self._queued = 0.0 if self.limit is None else max(0.0, self._queued + sent_bytes - self.limit)
        self._left = float(min(left_bytes, self._largest_packet_bytes)) if more else 0.0
        if (
            self.limit is None
            or not more
            or round_index < max(self._raised_round + wait_rounds, self._pause_until)
        ):
            return
        self._increases += 1
        doublings = max(0, self._increases - CAREFUL_INCREASES)
        self.limit *= 1.0 + min(LARGEST_INCREASE, FIRST_INCREASE * 2.0**doublings)
        self._raised_round = round_index
        if self.limit >= most_bytes:
            self.limit = None
