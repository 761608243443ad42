"""Messages of the set-up and of elimination: what is written is read, what is broken is refused."""

import numpy as np
import pytest

from duagc.pipeline.consensus.elimination import Block, Step
from duagc.pipeline.exchange.wire import elimination_wire
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.team_posegraph import wire
from duagc.pipeline.team_posegraph.wire import NamedKeyframes, PairFrame, Roster


def poses(rng, n):
    return se3.from_quat_translation(rng.normal(size=(n, 4)), 10 * rng.normal(size=(n, 3)))


def test_set_up_messages_come_back():
    rng = np.random.default_rng(3)
    roster = Roster(2, 0b1011)
    assert wire.read_roster(wire.write_roster(roster), 4) == roster
    named = NamedKeyframes(np.array([1, 5], np.int32), poses(rng, 2), np.array([[0.0, 0.1], [0.5, 0.2]]))
    for precision, atol in (("float32", 1e-5), ("float64", 1e-14)):
        data = wire.write_keyframes(named, precision)
        read = wire.read_keyframes(data, named.keyframes, precision)
        np.testing.assert_allclose(read.T_map_keyframe, named.T_map_keyframe, atol=atol)
    np.testing.assert_allclose(read.drift, named.drift, rtol=1e-6)
    keep = np.array([True, False, True] * 5)
    np.testing.assert_array_equal(wire.read_verdict(wire.write_verdict(keep), 15), keep)
    frame = PairFrame(1, 3, 12, poses(rng, 1)[0])
    back = wire.read_frame(wire.write_frame(frame), 4)
    assert (back.lower, back.higher, back.support) == (1, 3, 12)
    np.testing.assert_allclose(back.T_lower_higher, frame.T_lower_higher, atol=1e-5)
    front = {(0, 4): 0b11, (2, 1): 0, (0, 9): 0b101}
    assert elimination_wire.read_front(elimination_wire.write_front(front), 3) == front


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_blocks_and_steps_come_back_and_zeros_cost_nothing(precision):
    rng = np.random.default_rng(4)
    n = 5
    A = rng.normal(size=(6 * n, 6 * n)).astype(precision).astype(np.float64)
    H = A + A.T
    H[:6, 12:18] = H[12:18, :6] = 0.0
    H = H.astype(precision).astype(np.float64)
    block = Block(H, rng.normal(size=6 * n), 3.5, 0.25, reweighted=True, unsure=False)
    data = elimination_wire.write_block(9, block, precision)
    exchange, read = elimination_wire.read_block(data, n)
    assert exchange == 9
    np.testing.assert_array_equal(read.H, H)
    np.testing.assert_array_equal(read.g, block.g)
    assert (read.cost, read.largest_step, read.reweighted, read.unsure) == (3.5, 0.25, True, False)
    dense = Block(np.where(H == 0, 1.0, H), block.g, 3.5, 0.25, reweighted=True, unsure=False)
    assert len(elimination_wire.write_block(9, dense, precision)) - len(data) == 36 * (
        4 if precision == "float32" else 8
    )
    same = Block(None, block.g, 3.5, 0.25, reweighted=False, unsure=True)
    short = elimination_wire.write_block(10, same, precision)
    assert len(short) < 400
    assert elimination_wire.read_block(short, n)[1].H is None
    step = Step(4, accepted=True, finished=False, fresh=True, damping=1e-3, delta=rng.normal(size=(3, 6)))
    back = elimination_wire.read_step(elimination_wire.write_step(step), 3)
    np.testing.assert_array_equal(back.delta, step.delta)
    assert (back.exchange, back.accepted, back.finished, back.fresh, back.damping) == (
        4,
        True,
        False,
        True,
        1e-3,
    )


def test_what_is_cut_short_or_does_not_fit_is_refused():
    rng = np.random.default_rng(5)
    named = NamedKeyframes(np.array([1, 5], np.int32), poses(rng, 2), np.zeros((2, 2)))
    block = Block(np.eye(12), np.zeros(12), 1.0, 0.0, reweighted=False, unsure=False)
    step = Step(0, accepted=True, finished=False, fresh=False, damping=0.0, delta=np.zeros((2, 6)))
    messages = [
        (wire.write_roster(Roster(0, 2)), lambda d: wire.read_roster(d, 2)),
        (
            wire.write_keyframes(named, "float32"),
            lambda d: wire.read_keyframes(d, named.keyframes, "float32"),
        ),
        (wire.write_verdict(np.ones(9, bool)), lambda d: wire.read_verdict(d, 9)),
        (wire.write_frame(PairFrame(0, 1, 2, np.eye(4))), lambda d: wire.read_frame(d, 2)),
        (elimination_wire.write_front({(0, 1): 3}), lambda d: elimination_wire.read_front(d, 2)),
        (elimination_wire.write_block(0, block, "float64"), lambda d: elimination_wire.read_block(d, 2)),
        (elimination_wire.write_step(step), lambda d: elimination_wire.read_step(d, 2)),
    ]
    for data, read in messages:
        read(data)
        for broken in (data[:-1], data + b"\0"):
            with pytest.raises(MalformedError):
                read(broken)
    with pytest.raises(MalformedError, match="team"):
        wire.read_roster(wire.write_roster(Roster(0, 0b1000)), 3)
    with pytest.raises(MalformedError, match="expected 3"):
        elimination_wire.read_block(elimination_wire.write_block(0, block, "float64"), 3)
