"""Messages of the set-up and of elimination: what is written is read, what is broken is refused."""

import dataclasses

import numpy as np
import pytest

from duagc.pipeline.consensus.elimination import BackSubstitution, Block
from duagc.pipeline.exchange.wire import elimination_wire, loop_closing_wire, poses_wire, state_wire
from duagc.pipeline.exchange.wire.loop_closing_wire import NamedKeyframes
from duagc.pipeline.exchange.wire.state_wire import State
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import MalformedError


def poses(rng, n):
    return se3.from_quat_translation(rng.normal(size=(n, 4)), 10 * rng.normal(size=(n, 3)))


def test_set_up_messages_come_back():
    rng = np.random.default_rng(3)
    named = NamedKeyframes(np.array([1, 5], np.int32), poses(rng, 2), np.array([[0.0, 0.1], [0.5, 0.2]]))
    for precision, atol in (("float32", 1e-5), ("float64", 1e-14)):
        data = loop_closing_wire.write_keyframes(named, precision)
        read = loop_closing_wire.read_keyframes(data, named.keyframes, precision)
        np.testing.assert_allclose(read.T_first_keyframe, named.T_first_keyframe, atol=atol)
    np.testing.assert_allclose(read.drift, named.drift, rtol=1e-6)
    nothing = np.full(4, state_wire.NOBODY, np.uint8)
    for revoked in (0, 0b10):
        state = State(0b110001, revoked, 3, 255, agreed=True, done=False, sources=nothing)
        data = state_wire.write_state(state, short=True)
        back, poses_of_round = state_wire.read_state(data + b"poses", 4)
        assert poses_of_round == b"poses"
        np.testing.assert_array_equal(back.sources, nothing)
        assert vars(back) | {"sources": None} == vars(state) | {"sources": None}
        assert len(data) == 4 + bool(revoked)
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
    step = BackSubstitution(
        4, accepted=True, finished=False, fresh=True, damping=1e-3, delta=rng.normal(size=(3, 6))
    )
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
    step = BackSubstitution(
        0, accepted=True, finished=False, fresh=False, damping=0.0, delta=np.zeros((2, 6))
    )
    messages = [
        (
            loop_closing_wire.write_keyframes(named, "float32"),
            lambda d: loop_closing_wire.read_keyframes(d, named.keyframes, "float32"),
        ),
        (elimination_wire.write_front({(0, 1): 3}), lambda d: elimination_wire.read_front(d, 2)),
        (elimination_wire.write_block(0, block, "float64"), lambda d: elimination_wire.read_block(d, 2)),
        (elimination_wire.write_step(step), lambda d: elimination_wire.read_step(d, 2)),
    ]
    for data, read in messages:
        read(data)
        for broken in (data[:-1], data + b"\0"):
            with pytest.raises(MalformedError):
                read(broken)
    with pytest.raises(MalformedError, match="outside the team"):
        state_wire.read_state(bytes([0, 0, 4, 0b11111111]), 3)
    with pytest.raises(MalformedError, match="name"):
        loop_closing_wire.read_keyframes(
            loop_closing_wire.write_keyframes(named, "float32"), np.array([1, 6], np.int32), "float32"
        )
    with pytest.raises(MalformedError, match="expected 3"):
        elimination_wire.read_block(elimination_wire.write_block(0, block, "float64"), 3)


@pytest.mark.parametrize("count", [1, 8, 13])
def test_masks_come_back_and_name_no_other_keyframe(count):
    active = np.arange(count) % 3 == 0
    data = poses_wire.write_mask(7, active)
    version, back = poses_wire.read_mask(data, count)
    assert version == 7
    np.testing.assert_array_equal(back, active)
    with pytest.raises(MalformedError, match="mask"):
        poses_wire.read_mask(data + b"\0", count)
    if count % 8:
        with pytest.raises(MalformedError, match="more than"):
            poses_wire.read_mask(data[:-1] + b"\xff", count)


@pytest.mark.parametrize(
    "changes",
    [{"H": 1e31 * np.eye(6)}, {"g": np.full(6, 1e308)}, {"cost": np.inf}, {"largest_step": np.inf}],
)
def test_blocks_with_numbers_that_overflow_are_refused(changes):
    block = Block(np.eye(6), np.zeros(6), 1.0, 0.0, reweighted=False, unsure=False)
    elimination_wire.read_block(elimination_wire.write_block(0, block, "float64"), 1)
    huge = dataclasses.replace(block, **changes)
    with pytest.raises(MalformedError, match="block"):
        elimination_wire.read_block(elimination_wire.write_block(0, huge, "float64"), 1)


@pytest.mark.parametrize("changes", [{"damping": np.inf}, {"delta": np.full((1, 6), 1e308)}])
def test_steps_with_numbers_that_overflow_are_refused(changes):
    step = BackSubstitution(
        0, accepted=True, finished=False, fresh=False, damping=0.0, delta=np.zeros((1, 6))
    )
    with pytest.raises(MalformedError, match="step"):
        elimination_wire.read_step(elimination_wire.write_step(dataclasses.replace(step, **changes)), 1)
