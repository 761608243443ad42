"""In which rounds a transport sends chunks and acknowledgements again, and what a single acknowledgement says."""

import itertools
import struct
from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.config.network import TransportConfig
from duagc.pipeline.network.congestion import Congestion
from duagc.pipeline.network.messages import Message
from duagc.pipeline.network.packets import MAX_PACKET_BYTES, MAX_PAYLOAD_BYTES, Kind, Packet, parse
from duagc.pipeline.network.signatures import SIGNATURE_BYTES, Identity
from duagc.pipeline.network.transport import ACK_CHUNKS, Transport

CONFIG = TransportConfig(retransmit_after_rounds=3, contact_lost_after_rounds=4)
BUDGET_BYTES = 100_000


def end(own: int = 0) -> Transport:
    return Transport(own, 1 - own, "peer", CONFIG, new_id=itertools.count(1).__next__)


def state(sequence: int, sent_round: int) -> Packet:
    """What a neighbor says without acknowledging anything."""
    return Packet(
        kind=Kind.STATE, sender=1, receiver=0, sequence=sequence, round=sent_round,
        message=1, offset=0, total=3, payload=b"abc",
    )  # fmt: skip


def chunks_of(message: int, count: int) -> list[Packet]:
    return [
        Packet(
            kind=Kind.SAMPLE, sender=1, receiver=0, sequence=k, round=0, message=message,
            offset=k * MAX_PAYLOAD_BYTES, total=count * MAX_PAYLOAD_BYTES, payload=bytes(MAX_PAYLOAD_BYTES),
        )
        for k in range(count)
    ]  # fmt: skip


def sent(transport: Transport, now: int, kind: Kind) -> list[Packet]:
    packets = [parse(out.packet) for out in transport.burst(now, [], BUDGET_BYTES)]
    return [packet for packet in packets if packet.kind is kind]


def acknowledged(receiver: Transport, sender: Transport, now: int) -> None:
    for packet in sent(receiver, now, Kind.ACK):
        sender.receive(packet, now)


@pytest.mark.parametrize(("delay", "after"), [(0, 3), (1, 4), (5, 12)])
def test_a_chunk_goes_out_again_when_its_answer_could_be_here(delay: int, after: int) -> None:
    """Never before there and back have passed, with a round for either end."""
    a, rounds = end(), []
    a.send(Message(1000, Kind.SAMPLE, bytes(10)))
    for now in range(delay, delay + 30):
        a.receive(state(now - delay, now - delay), now)
        if sent(a, now, Kind.SAMPLE):
            rounds.append(now - delay)
    assert rounds == list(range(0, 30, after))


def test_contact_is_lost_after_so_many_silent_rounds() -> None:
    a = end()
    assert not a.in_contact(0)
    a.receive(state(0, 10), 10)
    assert [a.in_contact(now) for now in (10, 14, 15)] == [True, True, False]


def test_a_report_of_a_full_link_makes_everything_late_that_was_sent_before() -> None:
    a, b = end(), end(1)
    a.send(Message(1000, Kind.SAMPLE, bytes(10)))
    a.receive(state(1, 0), 0)  # the first is the report
    assert sent(a, 0, Kind.SAMPLE)  # due again in round 3
    b.receive(state(0, 0), 0)
    for k in range(8):
        b.receive(state(k + 1, 0), 4)  # four rounds late
    packets = [parse(out.packet) for out in b.burst(4, [], BUDGET_BYTES)]
    assert packets
    a.receive(packets[0], 2)
    again = []
    for now in range(2, 12):
        a.receive(state(now, now), now)
        if sent(a, now, Kind.SAMPLE):
            again.append(now)
    assert again[0] == 3 + 4


@pytest.mark.parametrize(("heard", "times"), [(1.0, 1), (0.5, 1 + 5), (0.25, 1 + 11)])
def test_an_acknowledgement_is_repeated_until_one_of_twenty_is_lost(heard: float, times: int) -> None:
    """0.5^5 < 0.05 < 0.5^4; 0.75^11 < 0.05 < 0.75^10."""
    b, step = end(), round(1 / heard)
    for k in range(99):
        b.receive(state(step * k, 7), 7)
    last = chunks_of(7, 1)[0]
    b.receive(replace(last, sequence=step * 100 - 1), 7)
    assert [len(sent(b, now, Kind.ACK)) for now in range(7, 27)] == [1] * times + [0] * (20 - times)


def test_an_acknowledgement_says_what_arrived_around_it() -> None:
    """The first one was lost; the next one, of another chunk nearby, brings its news as well."""
    a, b = end(), end(1)
    a.send(Message(7, Kind.SAMPLE, bytes(10 * MAX_PAYLOAD_BYTES)))
    chunks = chunks_of(7, 10)
    b.receive(replace(chunks[2], sequence=0), 0)
    b.receive(replace(chunks[5], sequence=1), 0)
    assert len(sent(b, 0, Kind.ACK)) == 1  # lost
    b.receive(replace(chunks[6], sequence=2), 1)
    acknowledged(b, a, 1)
    np.testing.assert_array_equal(np.flatnonzero(a._open[7].acknowledged), [2, 5, 6])


def test_an_acknowledgement_is_no_longer_than_what_it_says() -> None:
    b = end(1)
    b.receive(chunks_of(7, 3000)[8], 0)
    (ack,) = sent(b, 0, Kind.ACK)
    assert len(ack.payload) == 10 + 1  # the eight before it could be here, the thousands after it are not


def test_what_waits_in_the_queue_is_not_sent_again_before_it_is_out() -> None:
    a, again = end(), []
    a.receive(state(0, 0), 0)
    a._rate.take(Congestion(6, 10_000, 0), 2)
    a.send(Message(1000, Kind.SAMPLE, bytes(10)))
    for now in range(2, 16):
        a.receive(state(now - 1, now), now)
        if sent(a, now, Kind.SAMPLE):
            again.append(now)
    assert again == [2, 2 + 3 + 6, 14]


def test_evidence_waits_for_everything_else() -> None:
    a = end()
    a.receive(state(0, 0), 0)
    kinds = (Kind.EVIDENCE, Kind.CURRENT_POSES, Kind.EVIDENCE_EXACT, Kind.TREE, Kind.REQUEST)
    for k, kind in enumerate(kinds):
        a.send(Message(100 + k, kind, bytes(10)))
    order = [parse(out.packet).kind for out in a.burst(0, [], BUDGET_BYTES)]
    assert order == [Kind.REQUEST, Kind.TREE, Kind.CURRENT_POSES, Kind.EVIDENCE, Kind.EVIDENCE_EXACT]


def test_long_messages_are_acknowledged_by_several_parts() -> None:
    a, b, count = end(), end(1), ACK_CHUNKS + 20
    a.send(Message(7, Kind.SAMPLE, bytes(count * MAX_PAYLOAD_BYTES)))
    for k, chunk in enumerate(chunks_of(7, count)):
        if k % 3:
            b.receive(chunk, 0)
    acknowledged(b, a, 0)
    np.testing.assert_array_equal(a._open[7].acknowledged, np.arange(count) % 3 > 0)


def test_an_acknowledgement_of_more_chunks_than_there_are_has_no_effect() -> None:
    a = end()
    a.send(Message(7, Kind.SAMPLE, bytes(3 * MAX_PAYLOAD_BYTES)))
    payload = (7).to_bytes(4, "little") + bytes(4) + (9).to_bytes(2, "little") + b"\xff\xff"
    ack = Packet(
        kind=Kind.ACK, sender=1, receiver=0, sequence=0, round=0, message=2, offset=0,
        total=len(payload), payload=payload,
    )  # fmt: skip
    assert a.receive(ack, 0) is None
    assert not a._open[7].acknowledged.any()


@pytest.mark.parametrize("signed", [False, True])
def test_the_slowest_link_sends_whole_packets(signed: bool) -> None:
    """What is left of 50 bytes a round adds up to a packet, also to one with a signature behind it."""
    identity = Identity.simulated(0, ["alpha", "bravo"], "alpha") if signed else None
    ids = itertools.count(1)
    sender = Transport(0, 1, "bravo", TransportConfig(), new_id=ids.__next__, identity=identity)
    report = struct.pack("<IIHI", 2**32 - 1, 50, 2, 0)  # 50 bytes a round, two rounds late
    sender.receive(replace(state(0, 0), kind=Kind.ACK, total=len(report), payload=report), 0)
    size = MAX_PACKET_BYTES + SIGNATURE_BYTES * signed
    lengths = list[int]()
    for now in range(2, 3 + size // 50):
        burst = sender.burst(now, [Message(next(ids), Kind.STATE, bytes(MAX_PAYLOAD_BYTES))], BUDGET_BYTES)
        lengths += [len(out.packet) for out in burst]
    assert lengths == [size]
