"""Block-coordinate descent: where it ends, its messages, replay, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.config.exchange import ExchangeConfig, InjectionConfig
from duagc.pipeline.config.network import LinkConfig
from duagc.pipeline.consensus.own_block import minimized
from duagc.pipeline.exchange.injection import DETAIL
from duagc.pipeline.exchange.replay import replay_agent_of
from duagc.pipeline.exchange.session import run_session_of
from duagc.pipeline.exchange.wire.block_descent_wire import ClosureWeights, read_message, write_message
from duagc.pipeline.exchange.wire.link_setup_wire import LinkSetup
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePose, RelativePoses
from tests.fixtures.results import same

INFORMATION = np.diag([1e4] * 3 + [1e5] * 3).astype(np.float64)


def test_a_block_goes_to_its_minimum_and_never_up() -> None:
    rng = np.random.default_rng(0)
    held = np.eye(4)[None] @ se3.exp(rng.normal(0, 0.1, (2, 6)))
    truth = se3.exp(rng.normal(0, 0.5, (3, 6)))
    everything = np.concatenate([truth, held])
    ends = [(0, 1), (1, 2), (0, 3), (2, 4)]
    noise = se3.exp(rng.normal(0, 0.01, (4, 6)))
    factors = RelativePoses.of(
        [
            RelativePose(i, j, se3.inverse(everything[i]) @ everything[j] @ noise[k], INFORMATION)
            for k, (i, j) in enumerate(ends)
        ]
    )
    start = truth @ se3.exp(rng.normal(0, 0.8, (3, 6)))
    weights = np.array([1.0, 1.0, 1.0, 0.5])
    x = minimized(factors, weights, start, held, config=PoseConsensusConfig())
    x = minimized(factors, weights, x, held, config=PoseConsensusConfig())
    g, _ = least_squares.gradient(factors, weights, np.concatenate([x, held]))
    assert np.abs(g[:3]).max() < 1e-4
    assert np.abs(g[3:]).max() > 1.0  # the held ones are not at theirs

    def cost(own: np.ndarray) -> float:
        return least_squares.cost(factors, np.concatenate([own, held]), weights)

    worse = truth @ se3.exp(rng.normal(0, 2.0, (3, 6)))
    assert cost(minimized(factors, weights, worse, held, config=PoseConsensusConfig())) < cost(worse)


def test_messages_are_read_as_they_were_written() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    closure = LoopClosure(2, 1, np.eye(4), INFORMATION)
    setup = write_message(LinkSetup(poses, (closure,)))
    read = read_message(setup, 2)
    assert isinstance(read, LinkSetup)
    assert (read.closures[0].own_keyframe, read.closures[0].peer_keyframe) == (2, 1)
    weights = write_message(ClosureWeights(3, True, np.array([0.0, 0.25])))
    back = read_message(weights, 2)
    assert isinstance(back, ClosureWeights)
    assert (back.version, back.final, back.weights.tolist()) == (3, True, [0.0, 0.25])
    above = write_message(ClosureWeights(0, False, np.array([1.5])))
    for bad in (b"", setup[:-1], weights[:-1], weights + b"\0", b"\2" + weights[1:], above):
        with pytest.raises(MalformedError):
            read_message(bad, 2)
    with pytest.raises(MalformedError, match="does not exist"):
        read_message(setup, 1)


def test_a_session_comes_out_again_and_ends_where_elimination_ends(make_robot: Any, tmp_path: Path) -> None:
    names = ("alpha", "bravo", "charlie")
    data = [make_robot(name, 0.6 * i, keyframes=4)[0] for i, name in enumerate(names)]
    found = {}
    for name, solver, loss in (("reference", "elimination", 0.0), ("lossy", "block_descent", 0.4)):
        config = _config(solver, loss)
        paths = {"exchange_path": tmp_path / f"{name}.mcap", "consensus_path": tmp_path / f"{name}_c.mcap"}
        found[name] = run_session_of(data, config, seed=0, **paths)
    for robot, result in found["lossy"].items():
        assert result.agreed
        assert result.refused == {}
        assert result.component == names
        T_reference = found["reference"][robot].T_world_keyframe
        assert np.max(se3.distance(result.T_world_keyframe, T_reference)[0]) < 1e-6
    again, sent = replay_agent_of(
        data[1], _config("block_descent", 0.4), seed=0, exchange_path=tmp_path / "lossy.mcap"
    )
    assert sent.equal
    assert same(again, found["lossy"]["bravo"])


def test_false_loop_closures_lose_their_weight(make_robot: Any, tmp_path: Path) -> None:
    data = [make_robot(name, 0.6 * i, keyframes=4)[0] for i, name in enumerate(("alpha", "bravo"))]
    paths = {"exchange_path": tmp_path / "exchange.mcap", "consensus_path": tmp_path / "consensus.mcap"}
    clean = run_session_of(data, _config("elimination", 0.0), seed=0, **paths)
    injection = InjectionConfig(false_closures=0.4, pose_dropouts=0.3)
    config = _config("block_descent", 0.2).model_copy(update={"injection": injection})
    faulty = run_session_of(data, config, seed=0, **paths)
    known = [closure for result in faulty.values() for closure in result.closures]
    assert {c.weight for c in known if c.detail.endswith(DETAIL)} == {0.0}
    assert {c.weight for c in known if c.verdict == "kept"} == {1.0}
    for robot, result in faulty.items():
        assert result.agreed
        assert np.max(se3.distance(result.T_world_keyframe, clean[robot].T_world_keyframe)[0]) < 1e-6


def _config(solver: str, loss: float) -> ExchangeConfig:
    return ExchangeConfig(solver=solver, link=LinkConfig(loss_probability=loss))  # type: ignore[arg-type]
