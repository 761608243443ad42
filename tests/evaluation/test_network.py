"""Metrics of a session count what its log says, and agree with the summary that closes it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.base.component_names import same_robot
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.network import LinkConfig
from duagc.pipeline.evaluation import network
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.exchange.raw_alternative import RawAlternative
from duagc.pipeline.exchange.record import read_session
from duagc.pipeline.exchange.session import run_session_of
from duagc.pipeline.network.packets import Kind
from duagc.pipeline.recording import read_log
from duagc.pipeline.runs.robot_data import RobotData
from duagc.schemas import topics
from tests.exchange.conftest import robot

ADMM = ExchangeConfig(link=LinkConfig(duplicate_probability=0.5))
ELIMINATION = ExchangeConfig(solver="elimination")


def met(folder: Path, config: ExchangeConfig, data: list[RobotData]) -> network.Session:
    paths = {"exchange_path": folder / "exchange.mcap", "consensus_path": folder / "consensus.mcap"}
    results = run_session_of(data, config, seed=0, **paths)
    robots = {
        name: SimpleNamespace(component=r.component, rejected_matches={}) for name, r in results.items()
    }
    return network.Session(SimpleNamespace(path=folder, robots=robots))  # type: ignore[arg-type]


@pytest.mark.parametrize("config", [ADMM, ELIMINATION], ids=["copies", "messages of the solver"])
def test_metrics_and_summary_count_alike(tmp_path: Path, config: ExchangeConfig) -> None:
    names = ("alpha", "alpha-2", "bravo")
    data = [robot(name, 0.3 * i, keyframes=3, gaussians=40)[0] for i, name in enumerate(names)]
    session = met(tmp_path, config, data)
    found, summary = session.exchange_section(), session.summary
    for key in (
        "messages",
        "packets_sent",
        "packets_dropped",
        "bytes_sent",
        "bytes_delivered",
        "bytes_setup",
    ):
        assert found[key] == getattr(summary, key), key
    packets = read_session(tmp_path / "exchange.mcap").packets
    radio = [p for p in packets if not same_robot(p.sender, p.receiver)]
    assert 0 < len(radio) < len(packets)
    end_ns = (summary.rounds - 1) * config.period_ns
    on_time = [sum(at_ns <= end_ns for at_ns in p.deliver_ns) for p in radio]
    assert found["bytes_delivered"] == sum(len(p.data) * n for p, n in zip(radio, on_time, strict=True))
    assert any(n < len(p.deliver_ns) for p, n in zip(radio, on_time, strict=True))  # of the last round
    running = ("ACK", "STATE", "EVIDENCE", "EVIDENCE_EXACT", "EVIDENCE_DOUBLE")
    assert found["bytes_setup"] == sum(len(p.data) for p in radio if p.kind_name not in running)
    assert (found["bytes_delivered"] > found["bytes_sent"]) == (config is ADMM)
    assert (config is ELIMINATION) <= any(p.kind_name == "TREE" for p in radio)
    topic = topics.PEER_MESSAGE
    written = list(read_log(tmp_path / "exchange.mcap", topics=[topic.of(name) for name in names]))
    assert found["messages"] < len(written)


def test_components_of_a_robot_send_their_maps_to_the_other_robots_only() -> None:
    def part(name: str, gaussians: int, factors: int) -> Any:
        return SimpleNamespace(robot=name, gaussians=range(gaussians), registrations=range(factors))

    whole = RawAlternative.of([part("alpha", 1000, 10), part("bravo", 500, 10)])
    parts = [part("alpha", 600, 4), part("alpha-2", 400, 6), part("bravo", 500, 10)]
    assert RawAlternative.of(parts) == whole == RawAlternative(1500 * 180 + 20 * 40, 1500 * 56 + 20 * 40)


def test_a_robot_that_ends_alone_needs_no_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Alpha was joined until its link was revoked; the other two agreed in rounds 7 and 8."""

    def seen(name: str, k: int, members: str, agreed: bool = False) -> Any:
        return SimpleNamespace(robot=name, round=k, members=members.split(), agreed=agreed)

    rounds = [
        *(seen(name, 3, "alpha bravo charlie") for name in ("alpha", "bravo", "charlie")),
        seen("alpha", 5, "alpha"),
        seen("bravo", 7, "bravo charlie", agreed=True),
        seen("charlie", 8, "bravo charlie", agreed=True),
    ]
    monkeypatch.setattr(network, "gap_to_oracle", lambda *_: Absent("not asked for"))

    def ticks(log: list[Any]) -> int | Absent:
        config = SimpleNamespace(exchange=SimpleNamespace(solver="admm"))
        session = network.Session(SimpleNamespace(robots={}, config=config))  # type: ignore[arg-type]
        summary = SimpleNamespace(rounds=10, converged=True)
        session.__dict__ |= {"agent_rounds": log, "loop_closures": [], "pairs": {}, "summary": summary}
        return session.consensus_section()["rounds_to_tolerance"]  # type: ignore[no-any-return]

    assert ticks(rounds) == 9
    late = ticks(rounds[:-1])
    assert isinstance(late, Absent)
    assert late.reason == "charlie did not get there in 10 rounds"
    parts = ticks([seen(name, 8, "alpha alpha-2", agreed=True) for name in ("alpha", "alpha-2")])
    assert parts == Absent("no two robots share a world")


def test_matches_without_a_list_are_not_counted(tmp_path: Path) -> None:
    """Contact ends before the lists are sent: the robots match by themselves, and no message says what."""
    data = [robot(name, 0.3 * i, keyframes=3, gaussians=40)[0] for i, name in enumerate(("alpha", "bravo"))]
    for rounds, matches in ((20, (network.NO_LISTS,) * 3), (ADMM.max_rounds, (0, 0, network.NO_MATCHES))):
        (folder := tmp_path / str(rounds)).mkdir()
        session = met(folder, ADMM.model_copy(update={"max_rounds": rounds}), data)
        assert session.run.robots["alpha"].component == ("alpha", "bravo")
        found = session.exchange_section()
        share = session.rejected_matches_share()
        assert (found["matched_pairs"], found["bytes_paper_accounting"], share) == matches


def test_the_share_of_rejected_matches_is_of_the_lists() -> None:
    """Bravo, which did not get the list, matched by itself, and rejected what nobody listed."""
    ids = np.array([[1, 2], [3, 4], [5, 6]])
    key, component = ("alpha", "bravo"), ("alpha", "bravo")
    by_itself = np.array([[3, 4], *([k, k] for k in range(10, 30))])
    rejected: dict[str, dict[tuple[str, str], Any]] = {"alpha": {}, "bravo": {key: by_itself}}
    robots = {
        name: SimpleNamespace(component=component, rejected_matches=of) for name, of in rejected.items()
    }
    session = network.Session(SimpleNamespace(robots=robots))  # type: ignore[arg-type]
    session.__dict__["pairs"] = {key: ids}
    assert session.rejected_matches_share() == 1 / 6


def test_every_kind_of_message_of_a_run_has_a_purpose() -> None:
    """KEYFRAMES alone is of `duagc posegraph`."""
    assert set(network.PURPOSE) == {kind.name for kind in Kind} - {"KEYFRAMES"}
