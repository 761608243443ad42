"""Packets: round trip, cutting, and refusal of anything that is not as written."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from duagc.pipeline.network.packets import (
    FIRE_AND_FORGET,
    MAX_PACKET_BYTES,
    Kind,
    MalformedError,
    Packet,
    chunk_bytes,
    chunk_count,
    parse,
    serialize,
)


def packets_of(kind: Kind, size: int) -> list[Packet]:
    payload = np.random.default_rng(size).bytes(size)
    step = chunk_bytes(kind)
    return [
        Packet(kind, 1, 2, 7 + i, 3, 11, i * step, size, payload[i * step : (i + 1) * step])
        for i in range(chunk_count(kind, size))
    ]


@given(kind=st.sampled_from([k for k in Kind if k not in FIRE_AND_FORGET]), size=st.integers(0, 5000))
@settings(max_examples=60, deadline=None)
def test_a_message_comes_back_from_its_packets(kind: Kind, size: int) -> None:
    packets = packets_of(kind, size)
    wire = [serialize(p) for p in packets]
    assert all(len(w) <= MAX_PACKET_BYTES for w in wire)
    assert [parse(w) for w in wire] == packets
    assert sum(len(p.payload) for p in packets) == size


@given(data=st.data())
@settings(max_examples=200, deadline=None)
def test_every_mutation_is_refused(data: st.DataObject) -> None:
    good = serialize(packets_of(Kind.PAIRS, 300)[0])
    place = data.draw(st.integers(0, len(good) - 1))
    flip = data.draw(st.integers(1, 255))
    bad = good[:place] + bytes([good[place] ^ flip]) + good[place + 1 :]
    with pytest.raises(MalformedError):
        parse(bad)


@pytest.mark.parametrize("size", [0, 1, 33, 100, 333, 335, 5000])
def test_a_wrong_length_is_refused(size: int) -> None:
    good = serialize(packets_of(Kind.PAIRS, 300)[0])
    with pytest.raises(MalformedError):
        parse((good + bytes(5000))[:size])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"offset": 5}, "not a cut"),
        ({"offset": 1166 * 3}, "not a cut"),
        ({"total": 900}, "expected 900"),
        ({"receiver": 1}, "same robot"),
        ({"kind": Kind.STATE, "total": 5000}, "one packet"),
    ],
)
def test_a_header_that_contradicts_itself_is_refused(change: dict[str, int], reason: str) -> None:
    packet = dataclasses.replace(packets_of(Kind.PAIRS, 2000)[0], **change)
    with pytest.raises(MalformedError, match=reason):
        parse(serialize(packet))
