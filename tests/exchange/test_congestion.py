"""A link that is full is found out by both ends, loss alone slows nothing down, and false reports do little."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.network import LinkConfig, TransportConfig
from duagc.pipeline.exchange.replay import replay_agent_of
from duagc.pipeline.exchange.session import run_session_of
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.congestion import MOST_ROUNDS, Congestion, LinkObserver, SendRate
from duagc.pipeline.network.link_model import LinkModel
from duagc.pipeline.network.messages import Message
from duagc.pipeline.network.packets import Kind, parse
from duagc.pipeline.network.transport import Transport
from tests.fixtures.results import same

PERIOD_NS = 100_000_000
BUDGET_BYTES = 150_000


class Ends:
    """Both ends of a link, each with more evidence than it can send."""

    def __init__(self, link: LinkConfig) -> None:
        self.link = LinkModel(link, seed=3)
        self.ids = {name: itertools.count(1) for name in ("alpha", "bravo")}
        self.ends = {
            name: Transport(own, 1 - own, peer, TransportConfig(), new_id=self.ids[name].__next__)
            for own, (name, peer) in enumerate((("alpha", "bravo"), ("bravo", "alpha")))
        }
        for name, end in self.ends.items():
            end.send(Message(next(self.ids[name]), Kind.EVIDENCE, bytes(4_000_000)))
        self.air: dict[str, list[tuple[int, int, bytes]]] = {name: [] for name in self.ends}
        self.fresh, self.seen = dict.fromkeys(self.ends, 0), set[tuple[str, int]]()

    def rounds(self, count: int) -> Iterator[int]:
        for now in range(count):
            for name, end in self.ends.items():
                waiting = sorted(self.air[name])
                self.air[name] = [x for x in waiting if x[0] > now * PERIOD_NS]
                for _, _, data in [x for x in waiting if x[0] <= now * PERIOD_NS]:
                    packet = parse(data)
                    if packet.kind is Kind.EVIDENCE and (name, packet.offset) not in self.seen:
                        self.seen.add((name, packet.offset))
                        self.fresh[name] += len(packet.payload)
                    end.receive(packet, now)
            for name, end in self.ends.items():
                state = [Message(next(self.ids[name]), Kind.STATE, bytes(100))]
                for out in end.burst(now, state, BUDGET_BYTES):
                    fate = self.link.fate(
                        name,
                        out.receiver,
                        sequence=out.sequence,
                        send_ns=now * PERIOD_NS,
                        size=len(out.packet),
                    )
                    self.air[out.receiver] += [(at, out.sequence, out.packet) for at in fate.deliver_ns]
            yield now


@pytest.mark.parametrize("loss", [0.0, 0.3, 0.6])
def test_a_slow_link_carries_what_it_can(loss: float) -> None:
    """At 150 kB a round into 12.5 kB: three quarters of what gets through are new. It was a fifth and less."""
    ends = Ends(LinkConfig(bandwidth_bytes_per_s=125_000, loss_probability=loss))
    assert list(ends.rounds(100))[-1] == 99
    for fresh in ends.fresh.values():
        assert fresh > 0.75 * (1 - loss) * 12_500 * 100
    for end in ends.ends.values():
        assert end._rate.limit is not None
        assert 0.5 * 12_500 < end._rate.limit < 2.5 * 12_500


@pytest.mark.parametrize("loss", [0.3, 0.9])
def test_loss_alone_is_no_reason_to_send_less(loss: float) -> None:
    ends = Ends(LinkConfig(loss_probability=loss))
    for _ in ends.rounds(25):
        assert all(end._rate.limit is None for end in ends.ends.values())


def test_a_link_that_becomes_fast_is_used_again() -> None:
    """From a limit of 1 kB a round to none, as nothing is late any more."""
    rate = SendRate()
    assert rate.take(Congestion(5, 1_000, 0), 0) == 5
    for now in range(300):
        budget = rate.budget(BUDGET_BYTES, now)
        assert (budget == BUDGET_BYTES) == (rate.limit is None)
        rate.sent(budget, 0, BUDGET_BYTES, now, round_trip=4, more=True)
    assert rate.limit is None


def test_a_link_that_takes_less_than_a_state_a_round_is_not_silent() -> None:
    """Between ends that have little to say, jitter looks like a link that carries as little."""
    end = Transport(0, 1, "bravo", TransportConfig(), new_id=itertools.count(1).__next__)
    end._rate.take(Congestion(2, 30, 0), 0)
    sent = [len(end.burst(now, [Message(now, Kind.STATE, bytes(100))], BUDGET_BYTES)) for now in range(1, 61)]
    assert set(sent) == {0, 1}
    assert max(len(list(group)) for empty, group in itertools.groupby(sent) if not empty) <= 5
    assert sent[-1] == 1


def test_a_false_report_delays_a_little_and_once() -> None:
    rate = SendRate()
    assert rate.take(Congestion(60_000, 0, 7), 8) == MOST_ROUNDS
    assert rate.take(Congestion(60_000, 0, 7), 9) == 0
    assert rate.budget(BUDGET_BYTES, 9) < rate.budget(BUDGET_BYTES, 9 + MOST_ROUNDS) + 2


def test_a_number_that_no_link_reaches_is_reported_all_the_same() -> None:
    """A sequence number may be anything that somebody writes; what is reported fits its field."""
    observer = LinkObserver()
    for k in range(20):
        observer.heard(k, 0, 0, 1200)
    for sequence in (20, 2**32 - 1):
        observer.heard(sequence, 1, 5, 1200)
    for k in range(21, 40):
        observer.heard(k, 1, 5, 1200)
    said = observer.congestion(5)
    assert said is not None
    assert 0 <= said.bytes_per_round < 2**32


def test_what_arrived_counts_when_a_contact_ends(make_robot: Any, tmp_path: Any) -> None:
    """Before poses are agreed and evidence is complete; and the result comes out again from the packets."""
    team = {name: make_robot(name, 0.6 * i, keyframes=4) for i, name in enumerate(("alpha", "bravo"))}
    config = ExchangeConfig(
        link=LinkConfig(bandwidth_bytes_per_s=1_250_000, loss_probability=0.2), max_rounds=44
    )
    paths = {"exchange_path": tmp_path / "exchange.mcap", "consensus_path": tmp_path / "consensus.mcap"}
    results = run_session_of([data for data, _ in team.values()], config, seed=0, **paths)
    first = team["alpha"][1][0]
    for name, result in results.items():
        other = "bravo" if name == "alpha" else "alpha"
        assert not result.agreed
        assert result.component == ("alpha", "bravo")
        assert 0 < len(result.evidence[other].ids) <= 300
        assert len(result.pairs["alpha", "bravo"]) > 5
        for owner in team:
            T_true = se3.inverse(first) @ team[owner][1]
            assert np.max(se3.distance(T_true, result.T_world_keyframe_of[owner])[0]) < 0.03
    data = team["bravo"][0]
    again, sent = replay_agent_of(data, config, seed=0, exchange_path=tmp_path / "exchange.mcap")
    assert sent.equal
    assert same(again, results["bravo"])
