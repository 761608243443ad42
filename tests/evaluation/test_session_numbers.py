"""Numbers of a session that its logs give, from messages made for it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.evaluation import coverage, network, oracle
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.exchange.wire.state_wire import PairList, write_pairs


def session_of(*robots: str, **parts: Any) -> network.Session:
    """A session of robots that share a world, with some of what it reads put in their place."""
    runs = {r: SimpleNamespace(component=robots, rejected_matches={}) for r in robots}
    found = network.Session(SimpleNamespace(robots=runs, config=RunConfig()))  # type: ignore[arg-type]
    found.__dict__.update(parts)
    return found


def agent(robot: str, round_index: int, agreed: bool, members: tuple[str, ...]) -> SimpleNamespace:
    return SimpleNamespace(robot=robot, round=round_index, agreed=agreed, members=members)


def test_rounds_count_until_the_last_robot_has_agreed_for_the_first_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(network, "gap_to_oracle", lambda *_: Absent("not asked for"))
    team = ("alpha", "bravo")
    since = {"alpha": 4, "bravo": 6}
    rounds = [agent(r, k, k >= since[r], team) for k in range(10) for r in team]
    summary = SimpleNamespace(converged=True, rounds=10)
    given = {"summary": summary, "pairs": {}, "loop_closures": []}
    found = session_of(*team, agent_rounds=rounds, **given).consensus_section()
    assert found["rounds_to_tolerance"] == 6 + 1
    rounds = [m for m in rounds if m.robot == "alpha" or not m.agreed]
    late = session_of(*team, agent_rounds=rounds, **given).consensus_section()["rounds_to_tolerance"]
    assert isinstance(late, Absent)
    assert "bravo" in str(late)


def test_of_several_lists_of_a_pair_the_newest_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    sent = []
    for version in (2, 3, 1):
        ids = np.array([[10 * version, 7]])
        payload = write_pairs(PairList(0, 1, version, ids))
        sent.append(SimpleNamespace(kind_name="PAIRS", payload=payload))
    session = session_of("alpha", "bravo")
    monkeypatch.setattr(session, "_log", lambda *_: sent)
    np.testing.assert_array_equal(session.pairs["alpha", "bravo"], [[30, 7]])
    assert session.matched_pairs() == 1
    assert session.rejected_matches_share() == 0.0
    session.run.robots["bravo"].rejected_matches = {("alpha", "bravo"): np.array([[30, 7]])}  # type: ignore
    assert session.rejected_matches_share() == 0.5


def test_the_gap_of_gaussians_is_the_largest_and_its_99th_percentile(monkeypatch: pytest.MonkeyPatch) -> None:
    gaps = {"alpha": np.arange(0.0, 60.0), "bravo": np.arange(60.0, 101.0)}
    monkeypatch.setattr(oracle, "pose_gap", lambda *_: (0.25, 0.5))
    monkeypatch.setattr(oracle, "_map_of", lambda robot: ())
    for name in ("shared_evidence", "in_world", "used_matches"):
        monkeypatch.setattr(oracle, name, lambda *_, **__: None)
    monkeypatch.setattr(oracle, "_gaussian_gaps", lambda run, name, *_, **__: gaps[name])
    session = session_of("alpha", "bravo")
    central = dict.fromkeys(("alpha", "bravo"), np.eye(4))
    pairs = {("alpha", "bravo"): np.zeros((0, 2), np.int64)}
    found = oracle._gap(session.run, ["alpha", "bravo"], {}, central, pairs=pairs)
    assert found == oracle.Gap(0.25, 0.5, 100.0, 99.0)


def test_a_robot_whose_map_names_no_submap_has_one() -> None:
    frame = SimpleNamespace(frame_index=0, status="tracked", reason="")
    parts = {
        "alpha": SimpleNamespace(frames=[frame], submaps=(), component=("alpha",)),
        "bravo": SimpleNamespace(frames=[frame], submaps=(1, 2), component=("bravo",)),
        "bravo-2": SimpleNamespace(frames=[frame], submaps=(1,), component=("bravo-2",)),
    }
    found = coverage.of_robots(SimpleNamespace(robots=parts, unmapped={}))  # type: ignore[arg-type]
    assert {robot: row["submaps"] for robot, row in found.items()} == {"alpha": 1, "bravo": 3}
    assert {robot: row["components"] for robot, row in found.items()} == {"alpha": 1, "bravo": 2}
