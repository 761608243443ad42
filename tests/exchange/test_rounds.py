"""When packets of a round are there, in which order, and what an agent makes of records that come twice."""

import numpy as np
import pytest

from duagc.pipeline.exchange.knowledge import Knowledge
from duagc.pipeline.exchange.rounds import due
from duagc.pipeline.exchange.wire import evidence_wire
from duagc.pipeline.exchange.wire.anchors_wire import PlacedKeyframes
from duagc.pipeline.exchange.wire.state_wire import COMPLETE, NOBODY
from duagc.pipeline.network.packets import Kind, MalformedError

KIND = Kind.EVIDENCE_EXACT


def test_what_has_arrived_comes_by_time_sender_and_number_and_once() -> None:
    waiting = [
        (30, "alpha", 1, b"late"),
        (20, "bravo", 4, b"fifth"),
        (10, "charlie", 9, b"second"),
        (20, "alpha", 7, b"fourth"),
        (10, "bravo", 2, b"first"),
        (20, "alpha", 6, b"third"),
    ]
    assert due(waiting, 20) == [b"first", b"second", b"third", b"fourth", b"fifth"]
    assert due(waiting, 20) == []
    assert due(waiting, 29) == []
    assert due(waiting, 30) == [b"late"]
    assert waiting == []


def payload(ids: list[int], anchors: list[int], owner: int = 2) -> bytes:
    records = np.zeros(len(ids), evidence_wire.record_dtype(KIND))
    records["id"], records["anchor"] = ids, anchors
    records["theta"][:, 0] = ids
    return evidence_wire.write_evidence(KIND, owner, "blended", evidence_wire.to_body(KIND, records))


def test_a_gaussian_that_came_by_two_ways_counts_once() -> None:
    known = Knowledge(0, 3, KIND)
    assert known.take_evidence(1, 100, payload([7, 5], [0, 4]), complete=False) is None
    assert known.take_evidence(2, 200, payload([5, 9], [4, 1]), complete=False) is None
    records = known.records(2)
    assert records["id"].tolist() == [5, 7, 9]
    np.testing.assert_array_equal(records["theta"][:, 0], [5, 7, 9])
    sound = known.sound_records(PlacedKeyframes(2, np.tile(np.eye(4), (4, 1, 1))))
    assert sound["id"].tolist() == [7, 9]  # keyframe 4 is none of the owner's
    assert known.records(1)["id"].tolist() == []


def test_chunks_of_another_owner_in_a_message_and_speech_for_others_are_refused() -> None:
    known = Knowledge(0, 3, KIND)
    known.take_evidence(1, 100, payload([7], [0]), complete=False)
    with pytest.raises(MalformedError, match="different owners"):
        known.take_evidence(1, 100, payload([8], [0], owner=1), complete=False)
    with pytest.raises(MalformedError, match="speaks for this robot"):
        known.take_evidence(1, 101, payload([8], [0], owner=0), complete=True)
    assert known.records(2)["id"].tolist() == [7]


def test_what_is_complete_replaces_its_parts_and_is_forgotten_as_arriving() -> None:
    known = Knowledge(0, 3, KIND)
    known.take_evidence(1, 100, payload([7], [0]), complete=False)
    known.take_evidence(2, 200, payload([8], [0]), complete=False)
    assert known.sources(set(), {1, 2}).tolist() == [COMPLETE, NOBODY, 1]
    assert known.sources({1}, {2}).tolist() == [COMPLETE, 1, 2]  # a neighbor sends its own; only 2 still may
    assert known.take_evidence(1, 100, payload([7, 8, 9], [0, 0, 0]), complete=True) == 2
    assert known.forget_incoming(2) == [(2, 200)]
    assert known.records(2)["id"].tolist() == [7, 8, 9]
    assert known.share(2) == 1.0
    assert known.share(1) == 0.0
