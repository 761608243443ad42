"""Links and reliable transport: what is sent arrives, whatever is lost on the way, and within the budget."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.network import LinkConfig, TransportConfig
from duagc.pipeline.network.link_model import LinkModel
from duagc.pipeline.network.messages import Message
from duagc.pipeline.network.packets import Kind, MalformedError, Packet, parse
from duagc.pipeline.network.transport import Transport


def two_ends(config: TransportConfig | None = None) -> tuple[Transport, Transport]:
    config = config or TransportConfig()
    counters = (itertools.count(1), itertools.count(1))
    return (
        Transport(0, 1, "bravo", config, new_id=counters[0].__next__),
        Transport(1, 0, "alpha", config, new_id=counters[1].__next__),
    )


def run(
    a: Transport, b: Transport, loss: float, rounds: int, budget_bytes: int = 100_000
) -> tuple[dict[int, bytes], int, int]:
    """Rounds of both ends over a lossy link: messages that b got, rounds used, bytes sent by a."""
    model = LinkModel(LinkConfig(loss_probability=loss), seed=3)
    got: dict[int, bytes] = {}
    sent_bytes = 0
    state = b"state"
    for round_index in range(rounds):
        for sender, receiver, names in ((a, b, ("alpha", "bravo")), (b, a, ("bravo", "alpha"))):
            burst = sender.burst(round_index, [Message(sender.new_id(), Kind.STATE, state)], budget_bytes)
            assert sum(len(o.packet) for o in burst) <= budget_bytes
            sent_bytes += sum(len(o.packet) for o in burst) if sender is a else 0
            for out in burst:
                packet = parse(out.packet)
                if model.fate(*names, sequence=packet.sequence, send_ns=0, size=len(out.packet)).delivered:
                    arrival = receiver.receive(packet, round_index)
                    if arrival is not None and arrival.complete and arrival.kind is not Kind.STATE:
                        assert arrival.message not in got
                        got[arrival.message] = arrival.payload
        if a.idle and len(got):
            return got, round_index, sent_bytes
    return got, rounds, sent_bytes


@pytest.mark.parametrize("loss", [0.0, 0.3, 0.9])
def test_messages_arrive_whole_and_once(loss: float) -> None:
    a, b = two_ends()
    rng = np.random.default_rng(0)
    messages = {1000 + i: rng.bytes(size) for i, size in enumerate((0, 10, 1166, 1167, 50_000))}
    for number, payload in messages.items():
        a.send(Message(number, Kind.SAMPLE, payload))
    got, rounds, _ = run(a, b, loss, 600)
    assert got == messages
    assert a.idle
    assert rounds < {0.0: 6, 0.3: 60, 0.9: 500}[loss]


def test_nothing_is_sent_twice_without_loss() -> None:
    a, b = two_ends()
    a.send(Message(1000, Kind.SAMPLE, bytes(200_000)))
    _, rounds, sent_bytes = run(a, b, 0.0, 50, budget_bytes=30_000)
    assert sent_bytes < 200_000 * 1.04 + 60 * (rounds + 1)


def test_a_budget_spreads_a_message_over_rounds() -> None:
    a, b = two_ends()
    a.send(Message(1000, Kind.SAMPLE, bytes(100_000)))
    got, rounds, _ = run(a, b, 0.0, 100, budget_bytes=10_000)
    assert got == {1000: bytes(100_000)}
    assert 10 <= rounds <= 20


def test_without_contact_only_the_state_is_sent() -> None:
    a, b = two_ends()
    a.send(Message(1000, Kind.SAMPLE, bytes(100_000)))
    _, _, sent_bytes = run(a, b, 1.0, 100)
    assert sent_bytes == 100 * (34 + 5)


def test_evidence_is_handed_on_chunk_by_chunk() -> None:
    a, b = two_ends()
    a.send(Message(1000, Kind.EVIDENCE, bytes(5000)))
    a.last_heard = 0
    arrivals = [b.receive(parse(out.packet), 0) for out in a.burst(0, [], 100_000)]
    assert [x.complete for x in arrivals if x is not None] == [False, False, False, False, True]


def test_a_slow_link_is_not_taken_for_a_lossy_one() -> None:
    a, b = two_ends()
    a.send(Message(1000, Kind.SAMPLE, bytes(3000)))
    air: list[tuple[int, Transport, bytes]] = []
    sent = 0
    for round_index in range(60):
        for arrival in [x for x in air if x[0] == round_index]:
            arrival[1].receive(parse(arrival[2]), round_index)
        for sender, receiver in ((a, b), (b, a)):
            for out in sender.burst(round_index, [Message(sender.new_id(), Kind.STATE, b"")], 100_000):
                sent += parse(out.packet).kind is Kind.SAMPLE
                air.append((round_index + 10, receiver, out.packet))
    assert a.idle
    assert sent == 3


def test_the_rest_of_a_message_can_be_declined() -> None:
    a, b = two_ends()
    a.send(Message(1000, Kind.EVIDENCE, bytes(500_000)))
    a.last_heard = b.last_heard = 0
    for out in a.burst(0, [], 10_000):
        b.receive(parse(out.packet), 0)
    b.accept_rest(1000, 0)
    for out in b.burst(0, [], 10_000):
        a.receive(parse(out.packet), 1)
    assert a.idle


def packet(**changes: object) -> Packet:
    return replace(Packet(Kind.SAMPLE, 1, 0, 0, 0, 5, 0, 2000, bytes(1166)), **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("packets", "reason"),
    [
        ([packet(), packet(total=3000)], "was SAMPLE of 2000 bytes"),
        ([packet(total=1 << 29)], "at most"),
        ([packet(message=i) for i in range(4)], "more than 3 incomplete"),
        ([packet(kind=Kind.ACK, payload=b"123")], "cut short"),
        ([packet(kind=Kind.ACK, payload=bytes(8) + b"\xff\xff")], "bits of an acknowledgement"),
    ],
)
def test_what_contradicts_or_asks_too_much_is_refused(packets: list[Packet], reason: str) -> None:
    end, _ = two_ends(TransportConfig(max_open_messages=3))
    *before, last = [replace(p, sequence=k) for k, p in enumerate(packets)]
    for p in before:
        end.receive(p, 0)
    with pytest.raises(MalformedError, match=reason):
        end.receive(last, 0)


def test_a_false_acknowledgement_has_no_effect() -> None:
    a, _ = two_ends()
    a.send(Message(1000, Kind.SAMPLE, bytes(100)))
    a.last_heard = 0
    payloads = (b"\x07\0\0\0" + bytes(4) + b"\x01\0\x01", b"\xe8\x03\0\0" + b"\xff" * 4 + b"\x01\0\x01")
    for sequence, payload in enumerate(payloads):
        a.receive(packet(kind=Kind.ACK, payload=payload, sequence=sequence), 0)
    assert not a.idle


def test_a_packet_heard_twice_counts_once() -> None:
    end, _ = two_ends()
    state = packet(kind=Kind.STATE, total=3, payload=b"abc")
    first = packet(sequence=1)
    assert end.receive(state, 0) is not None
    assert end.receive(state, 1) is None
    assert end.receive(first, 1) is None
    assert end.receive(first, 1) is None
    last = packet(sequence=1 << 31, offset=1166, payload=bytes(834))  # a jump does not shut out the others
    arrival = end.receive(last, 1)
    assert arrival is not None
    assert arrival.complete
    assert end.receive(packet(kind=Kind.STATE, total=3, payload=b"abc", sequence=2), 1) is not None


def test_a_message_that_every_neighbor_refuses_is_not_sent() -> None:
    a, b = two_ends(TransportConfig(max_message_bytes=2000))
    a.send(Message(1000, Kind.SAMPLE, bytes(2000)))
    assert run(a, b, 0.0, 10)[0] == {1000: bytes(2000)}
    with pytest.raises(DuagError, match="max_message_bytes is 2000, expected at least 2001"):
        a.send(Message(1001, Kind.SAMPLE, bytes(2001)))
