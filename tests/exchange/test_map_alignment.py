"""What a robot keeps of relative frames that are flooded: each is read once, however many neighbors send it."""

import itertools

import numpy as np
import pytest

from duagc.pipeline.exchange.map_alignment import MapAlignment
from duagc.pipeline.exchange.wire import state_wire
from duagc.pipeline.exchange.wire.state_wire import RelativeFrames, pair_bit, write_relative_frames
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph.cycle_consistency import Proposal

TEAM = ["alpha", "bravo", "charlie", "delta"]


def frames(lower: int, higher: int, support: int = 3) -> RelativeFrames:
    return RelativeFrames(lower, higher, (Proposal(support, np.eye(4), (1e-4, 1e-4), 0.5),))


def test_a_relative_frame_that_comes_again_is_not_read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    read = []

    def reading(data: bytes, team: int) -> RelativeFrames:
        read.append(data)
        return read_once(data, team)

    read_once = state_wire.read_relative_frames
    monkeypatch.setattr(state_wire, "read_relative_frames", reading)
    alignment = MapAlignment(3, TEAM, 4.0)
    pairs = list(itertools.combinations(range(3), 2))
    for pair in pairs * 5:
        assert alignment.receive(write_relative_frames(frames(*pair)), lambda _: False) == pair
    assert len(read) == len(pairs)
    assert alignment.links == sum(pair_bit(*pair) for pair in pairs)
    first = alignment.placement
    assert alignment.receive(write_relative_frames(frames(0, 1, 9)), lambda _: False) == (0, 1)
    assert alignment.pairs[0, 1].proposals[0].support == 3  # the first word counts
    assert alignment.placement is first


def test_nobody_else_speaks_for_a_pair_that_this_robot_decides_on() -> None:
    alignment = MapAlignment(1, TEAM, 4.0)
    payload = write_relative_frames(frames(0, 1))
    with pytest.raises(MalformedError, match="speaks for this robot"):
        alignment.receive(payload, lambda pair: 1 in pair)
    assert not alignment.links
    alignment.add(frames(0, 1))
    assert alignment.receive(payload, lambda pair: 1 in pair) == (0, 1)  # an echo of the own word
    assert alignment.links == pair_bit(0, 1)
