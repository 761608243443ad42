"""Algorithm 1 as a solver of sessions: its gradient, its fixed point, replay, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.network import LinkConfig
from duagc.pipeline.exchange.algorithm_1 import Algorithm1Solver
from duagc.pipeline.exchange.map_agent import MapAgent
from duagc.pipeline.exchange.replay import replay_agent_of
from duagc.pipeline.exchange.rounds import run_rounds
from duagc.pipeline.exchange.session import run_session_of, team_of
from duagc.pipeline.exchange.wire.algorithm_1_wire import read_means, read_pairs, write_means, write_pairs
from duagc.pipeline.exchange.wire.link_setup_wire import LinkSetup, read_setup, write_setup
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.link_model import LinkModel
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph.least_squares import retract
from duagc.pipeline.posegraph.relative_poses import LoopClosure
from tests.fixtures.results import same

NAMES = ("alpha", "bravo")
SOLVERS = ("algorithm_1", "algorithm_1_printed")


class Silent:
    """Sees what happens and does nothing."""

    def ticked(self, *_: Any, **__: Any) -> None: ...

    def sent(self, *_: Any, **__: Any) -> None: ...

    def ended(self, *_: Any, **__: Any) -> None: ...


@pytest.fixture(scope="module")
def team(make_robot: Any) -> dict[str, Any]:
    return {name: make_robot(name, 0.6 * i, keyframes=4) for i, name in enumerate(NAMES)}


def after(team: dict[str, Any], solver: Any, rounds: int) -> MapAgent:
    config = ExchangeConfig(solver=solver)
    agents = team_of([data for data, _ in team.values()], config, 0)
    run_rounds(
        agents, LinkModel(config.link, 0), Silent(), period_ns=config.period_ns, max_rounds=rounds, title=""
    )
    return agents["alpha"]


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_step_goes_along_the_slope_of_the_cost(team: dict[str, Any], solver: str) -> None:
    """Numerically, at poses with pair terms and, as printed, with multipliers."""
    poses = after(team, solver, 26).poses
    assert isinstance(poses, Algorithm1Solver)
    (peer,) = poses._peers.values()
    assert peer.pairs is not None
    assert len(peer.pairs.mean) > 10
    assert len(peer.between) >= 2
    assert np.any(peer.multipliers != 0) == poses.printed
    gradient = poses._gradient()
    poses._x = retract(poses._x, np.full((4, 6), 2e-3))
    gradient, h = poses._gradient(), 1e-6
    for k, d in ((0, 0), (1, 2), (2, 3), (3, 5)):
        step = np.zeros((4, 6))
        step[k, d] = h
        rise = poses._cost(retract(poses._x, step)) - poses._cost(retract(poses._x, -step))
        assert rise / (2 * h) == pytest.approx(gradient[k, d], rel=2e-3, abs=1e-3 * np.abs(gradient).max())


def test_corrected_it_ends_where_no_pose_can_gain(team: dict[str, Any]) -> None:
    agent = after(team, "algorithm_1", 200)
    poses = agent.poses
    assert isinstance(poses, Algorithm1Solver)
    assert agent.agreed
    assert np.abs(poses._newton_step() - poses._x).max() < 5e-6


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_session_comes_out_again(team: dict[str, Any], solver: Any, tmp_path: Path) -> None:
    config = ExchangeConfig(solver=solver, link=LinkConfig(loss_probability=0.2), max_rounds=110)
    paths = {"exchange_path": tmp_path / "exchange.mcap", "consensus_path": tmp_path / "consensus.mcap"}
    results = run_session_of([data for data, _ in team.values()], config, seed=0, **paths)
    for result in results.values():
        assert result.component == NAMES
        assert result.agreed == (solver == "algorithm_1")  # noisy loop closures cannot hold as constraints do
        assert result.refused == {}
        T_true = se3.inverse(team["alpha"][1][0]) @ team[result.robot][1]
        assert np.max(se3.distance(T_true, result.T_world_keyframe)[0]) < 0.015
    again, sent = replay_agent_of(team["bravo"][0], config, seed=0, exchange_path=paths["exchange_path"])
    assert sent.equal
    assert same(again, results["bravo"])


def test_messages_are_read_as_they_were_written() -> None:
    closure = LoopClosure(1, 0, se3.exp(np.arange(6) * 0.1), np.diag(np.arange(1.0, 7.0)), True)
    setup = LinkSetup(np.stack([np.eye(4), se3.exp(np.ones(6))]), (closure,))
    data = write_setup(setup)
    read = read_setup(data, 1, "Algorithm 1")
    assert np.array_equal(read.poses, setup.poses)
    assert read.closures[0].measured_from_peer
    assert np.array_equal(read.closures[0].information, closure.information)
    for bad in (data[:-1], data + b"\0", data[:4] + b"\2" + data[5:]):
        with pytest.raises((MalformedError, ValueError)):
            read_setup(bad, 1, "Algorithm 1")
    with pytest.raises(MalformedError, match="descent: a loop closure of a keyframe that does not exist"):
        read_setup(data, 0, "block descent")
    assert read_pairs(write_pairs(np.array([[1, 2], [3, 4]]))).tolist() == [[1, 2], [3, 4]]
    means = np.random.default_rng(0).normal(size=(200, 3))
    parts = [read_means(part, 200) for part in write_means(means, 1000)]
    assert len(parts) == 3
    assert np.allclose(np.concatenate([values for _, values in parts]), means, atol=1e-6)
    with pytest.raises(MalformedError, match="more Gaussians"):
        read_means(write_means(means, 1000)[-1], 199)


def test_a_loop_closure_may_say_nothing_of_a_direction() -> None:
    """Rounding leaves the information there a little above or below zero."""
    rng, poses = np.random.default_rng(0), np.eye(4)[None]

    def read(information: Array) -> LoopClosure:
        closure = LoopClosure(0, 0, np.eye(4), information)
        return read_setup(write_setup(LinkSetup(poses, (closure,))), 1, "Algorithm 1").closures[0]

    for _ in range(20):
        J = rng.normal(size=(5, 6)) * rng.uniform(1, 1e3, 6)
        information = J.T @ J
        np.testing.assert_array_equal(read(information).information, information)
    skew = np.zeros((6, 6))
    skew[0, 1] = 1e-3 * information.max()
    for wrong in (-np.eye(6), 1e16 * np.eye(6), information + skew):
        with pytest.raises(MalformedError, match="too large, not symmetric or negative"):
            read(wrong)


def test_without_gaussians_there_is_nothing_to_solve(team: dict[str, Any]) -> None:
    from duagc.pipeline.consensus.tree import TreePlace
    from duagc.pipeline.exchange.pose_solver import SolverStart

    agent = after(team, "admm", 1)
    start = SolverStart(agent.graph, 0, np.eye(4), TreePlace.of(0, {0: None}), [])
    with pytest.raises(ValueError, match="needs Gaussians"):
        Algorithm1Solver(start, PoseConsensusConfig(), None)
