"""One elected robot solves for all: its answer, its messages, replay, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.network import LinkConfig
from duagc.pipeline.consensus.admm_edge import SharedKeyframes
from duagc.pipeline.consensus.tree import TreePlace
from duagc.pipeline.exchange import elected
from duagc.pipeline.exchange.elected import ElectedSolver, solve_for_all
from duagc.pipeline.exchange.own_graph import OwnGraph
from duagc.pipeline.exchange.pose_solver import LinkStart, SolverStart
from duagc.pipeline.exchange.replay import replay_agent_of
from duagc.pipeline.exchange.session import run_session_of
from duagc.pipeline.exchange.wire.elected_wire import (
    AnswerPart,
    GraphPart,
    read_answer,
    read_graphs,
    write_answer,
    write_graphs,
)
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePose, RelativePoses
from tests.fixtures.results import same

INFORMATION = np.diag([1e4] * 3 + [1e5] * 3).astype(np.float64)


def chain(first_m: float, keyframes: int) -> tuple[np.ndarray, RelativePoses]:
    """Keyframes one after the other along x, and what odometry says of them."""
    T = np.tile(np.eye(4), (keyframes, 1, 1))
    T[:, 0, 3] = first_m + 0.5 * np.arange(keyframes)
    step = se3.inverse(T[:-1]) @ T[1:]
    odometry = [RelativePose(k, k + 1, step[k], INFORMATION) for k in range(keyframes - 1)]
    return T, RelativePoses.of(odometry)


def team_of_two(false: int) -> tuple[dict[int, GraphPart], np.ndarray]:
    """Two robots with four true loop closures and some false ones, and where the second one really is."""
    (first, odometry), (second, other) = chain(0.0, 5), chain(0.3, 5)
    closures = [LoopClosure(k, k, se3.inverse(first[k]) @ second[k], INFORMATION) for k in range(4)]
    rng = np.random.default_rng(0)
    for k in range(false):
        wrong = se3.exp(rng.uniform(-2, 2, 6))
        closures.append(LoopClosure(k % 5, (k + 2) % 5, wrong, INFORMATION))
    begun = se3.exp(np.array([0.05, -0.03, 0.02, 0.01, 0.0, -0.01])) @ second
    loops = RelativePoses.empty()
    return {
        0: GraphPart(first, odometry, loops, {1: tuple(closures)}),
        2: GraphPart(begun, other, loops, {}),
        1: GraphPart(begun, other, loops, {}),
    }, second


def test_it_finds_the_true_loop_closures_among_false_ones() -> None:
    parts, second = team_of_two(false=6)
    del parts[2]
    answer = solve_for_all(parts, 0, PoseConsensusConfig())
    assert answer[0].closure_weights[1].tolist() == [1.0] * 4 + [0.0] * 6
    assert np.abs(answer[1].T_world_keyframe - second).max() < 1e-6
    assert np.allclose(answer[0].T_world_keyframe[0], parts[0].T_world_keyframe[0], rtol=0, atol=1e-12)
    trusting = solve_for_all(parts, 0, PoseConsensusConfig(robust=False))
    assert np.abs(trusting[1].T_world_keyframe - second).max() > 0.1


def test_a_loop_closure_with_nobody_is_refused() -> None:
    parts, _ = team_of_two(false=0)
    with pytest.raises(MalformedError, match="not there"):
        solve_for_all({0: parts[0]}, 0, PoseConsensusConfig())


def test_messages_are_read_as_they_were_written() -> None:
    parts, _ = team_of_two(false=2)
    data = write_graphs(parts)
    read = read_graphs(data, 3)
    assert read.keys() == parts.keys()
    assert np.array_equal(read[0].trusted.information, parts[0].trusted.information)
    pairs = zip(read[0].closures[1], parts[0].closures[1], strict=True)
    assert all(np.array_equal(a.T_own_peer, b.T_own_peer) for a, b in pairs)
    for bad in (data[:-1], data + b"\0", b"\1" + data[1:]):
        with pytest.raises(MalformedError):
            read_graphs(bad, 3)
    with pytest.raises(MalformedError, match="none of the team"):
        read_graphs(data, 2)
    part = AnswerPart(parts[0].T_world_keyframe, np.ones(2), {1: np.zeros(3)})
    back = read_answer(write_answer({0: part}))
    assert np.array_equal(back[0].T_world_keyframe, part.T_world_keyframe)
    assert back[0].closure_weights[1].tolist() == [0.0] * 3


def test_a_session_comes_out_again_and_ends_where_the_others_end(make_robot: Any, tmp_path: Path) -> None:
    team = {
        name: make_robot(name, 0.6 * i, keyframes=4) for i, name in enumerate(("alpha", "bravo", "charlie"))
    }
    data = [robot for robot, _ in team.values()]
    found = {}
    for solver in ("elected", "elimination"):
        config = ExchangeConfig(solver=solver, link=LinkConfig(loss_probability=0.2))  # type: ignore[arg-type]
        paths = {
            "exchange_path": tmp_path / f"{solver}.mcap",
            "consensus_path": tmp_path / f"{solver}_c.mcap",
        }
        found[solver] = run_session_of(data, config, seed=0, **paths)
    for name, result in found["elected"].items():
        assert result.agreed
        assert result.refused == {}
        assert result.component == tuple(team)
        apart_m = se3.distance(result.T_world_keyframe, found["elimination"][name].T_world_keyframe)[0]
        assert np.max(apart_m) < 1e-6
    config = ExchangeConfig(solver="elected", link=LinkConfig(loss_probability=0.2))
    again, sent = replay_agent_of(data[1], config, seed=0, exchange_path=tmp_path / "elected.mcap")
    assert sent.equal
    assert same(again, found["elected"]["bravo"])


def solver_of(
    parts: dict[int, GraphPart], own: int, tree: TreePlace, keep: Any = None, **config: Any
) -> ElectedSolver:
    """One robot's side; the other end of its only link is the other robot of two."""
    part, peer = parts[own], 1 - own
    graph = OwnGraph(str(own), part.T_world_keyframe, part.trusted, np.zeros((5, 2)), part.loops)
    closures = tuple(part.closures.get(peer, ()))
    kept = np.ones(len(closures), bool) if keep is None else np.array(keep, bool)
    shared = SharedKeyframes(np.arange(5, dtype=np.int32), np.ones((5, 6), np.float32))
    link = LinkStart(peer, str(peer), shared, closures, kept, parts[peer].T_world_keyframe)
    start = SolverStart(graph, own, part.T_world_keyframe[0], tree, [link])
    return ElectedSolver(start, PoseConsensusConfig(**config), team=3)


ROOT, LEAF = TreePlace(0, None, (1,), 0b11), TreePlace(1, 0, (), 0b10)


@pytest.mark.parametrize("error", [DuagError, IndexError, np.linalg.LinAlgError, MalformedError])
def test_a_root_that_cannot_solve_goes_on(error: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    parts, _ = team_of_two(false=0)

    def fail(*args: Any) -> Any:
        raise error("no solution")

    monkeypatch.setattr(elected, "solve_for_all", fail)
    root = solver_of(parts, 0, ROOT)
    root.take_message(1, write_graphs({1: parts[1]}))
    root.advance()
    assert root.refused == ["no solution"]
    assert not root.converged
    assert np.array_equal(root.T_world_keyframe, parts[0].T_world_keyframe)


def test_graphs_of_robots_that_are_not_below_a_child_are_refused() -> None:
    parts, _ = team_of_two(false=0)
    for robots in ((0, 1), (1, 2), (2,), ()):
        root = solver_of(parts, 0, ROOT)
        root.take_message(1, write_graphs({r: parts[r] for r in robots}))
        assert root.refused == ["graphs: lacks its sender, or has a robot that is not below it"]


def test_information_is_measured_by_itself() -> None:
    """Next to a large one, a small one that is negative is not rounding."""
    parts, _ = team_of_two(false=0)
    information = parts[1].trusted.information.copy()
    information[0] *= 1e6
    information[1, 0, 0] = -1.0
    data = write_graphs({1: parts[1]})
    old, new = (np.array(parts[1].trusted.information), information)
    rows = np.triu_indices(6)
    packed = [i[:, rows[0], rows[1]].astype("<f8").tobytes() for i in (old, new)]
    assert data.count(packed[0]) == 1
    with pytest.raises(MalformedError, match="negative"):
        read_graphs(data.replace(*packed), 3)


@pytest.mark.parametrize("lacks", ["weights", "one weight", "loops", "keyframe"])
def test_an_answer_about_another_graph_is_refused(lacks: str) -> None:
    parts, _ = team_of_two(false=0)
    turned = {0: GraphPart(*list(vars(parts[1]).values())[:3], {}), 1: parts[0]}
    parts = {0: turned[0], 1: GraphPart(*list(vars(parts[0]).values())[:3], {0: parts[0].closures[1]})}
    child = solver_of(parts, 1, LEAF)
    child.advance()
    good = AnswerPart(parts[1].T_world_keyframe, np.zeros(0), {0: np.ones(4)})
    bad = {
        "weights": AnswerPart(good.T_world_keyframe, good.loop_weights, {}),
        "one weight": AnswerPart(good.T_world_keyframe, good.loop_weights, {0: np.ones(3)}),
        "loops": AnswerPart(good.T_world_keyframe, np.ones(1), good.closure_weights),
        "keyframe": AnswerPart(good.T_world_keyframe[1:], good.loop_weights, good.closure_weights),
    }[lacks]
    child.take_message(0, write_answer({1: bad}))
    assert child.refused == ["answer: of another graph"]
    assert not child.converged
    assert not child.refuted("0")
    child.take_message(0, write_answer({1: good}))
    assert child.converged
    assert child.weights("0").tolist() == [1.0] * 4


def test_without_robust_weights_only_kept_loop_closures_count() -> None:
    parts, second = team_of_two(false=3)
    keep = [1, 1, 0, 1, 0, 0, 0]
    root = solver_of(parts, 0, ROOT, keep, robust=False)
    assert root.weights("1").tolist() == keep
    root.take_message(1, write_graphs({1: parts[1]}))
    root.advance()
    assert root.converged
    assert root.weights("1").tolist() == keep
    assert not root.refuted("1")
    ((receiver, answer),) = root.messages()
    assert receiver == 1
    assert np.abs(read_answer(answer)[1].T_world_keyframe - second).max() < 1e-6
