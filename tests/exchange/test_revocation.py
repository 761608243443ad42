"""A link whose closures are all false must not join two robots: it is revoked, and they end as if they had not met."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.network import LinkConfig
from duagc.pipeline.exchange.loop_closure_verifier import Verifier
from duagc.pipeline.exchange.record import read_session
from duagc.pipeline.exchange.replay import replay_agent_of
from duagc.pipeline.exchange.session import run_session_of
from duagc.pipeline.exchange.verification import Verdict
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import Kind, chunk_count, parse
from duagc.pipeline.recording import read_log
from duagc.pipeline.runs.robot_data import RobotData, SessionResult
from tests.fixtures.sampling import sampled

NAMES = ("alpha", "bravo", "charlie")
TRUE = np.eye(4)
Team = dict[str, tuple[RobotData, np.ndarray]]


@pytest.fixture(scope="module")
def team(make_robot: Any) -> Team:
    return {name: make_robot(name, 0.6 * i, keyframes=4) for i, name in enumerate(NAMES)}


def falsify(
    monkeypatch: pytest.MonkeyPatch, pair: tuple[str, str], frame_of: Callable[[int], np.ndarray | None]
) -> None:
    """Replace every closure of a pair: number k says that the peer's map lies at frame_of(k); None takes it away.

    A frame `TRUE` leaves the closure as it is.
    """
    decide = Verifier._decide

    def decide_falsely(self: Verifier, send: Any) -> None:
        if {self.own, self.peer} == set(pair):
            assert self.peer_keyframes is not None
            count = 0
            for at, t in enumerate(self.tried):
                closure = t.result.closure
                if closure is None:
                    continue
                frame = frame_of(count)
                count += 1
                own = self.database.graph.T_first_keyframe[closure.own_keyframe]
                peer = self.peer_keyframes.T_frame_keyframe[closure.peer_keyframe]
                if frame is not None and frame is not TRUE:
                    T_own_peer = se3.inverse(own) @ frame @ peer
                    closure = dataclasses.replace(closure, T_own_peer=T_own_peer)
                result = dataclasses.replace(t.result, closure=None if frame is None else closure)
                self.tried[at] = dataclasses.replace(t, result=result)
            assert count >= 2, "the test needs two closures to make false ones of"
        decide(self, send)

    monkeypatch.setattr(Verifier, "_decide", decide_falsely)


def meet(
    team: Team, names: tuple[str, ...], folder: Path, seed: int = 0, **config: Any
) -> dict[str, SessionResult]:
    return run_session_of(
        [team[name][0] for name in names],
        ExchangeConfig(**config),
        seed=seed,
        exchange_path=folder / "exchange.mcap",
        consensus_path=folder / "consensus.mcap",
    )


def is_alone(result: SessionResult, data: RobotData) -> bool:
    """Whether a robot ended as if it had met nobody, bit for bit."""
    return (
        result.component == (data.robot,)
        and np.array_equal(result.T_world_keyframe, data.T_map_keyframe)
        and list(result.T_world_keyframe_of) == [data.robot]
        and result.evidence == {}
        and result.pairs == {}
        and result.agreed
        and result.converged
    )


STRICT = PoseConsensusConfig(truncation=2.0)
"""Closures that lie 3.5 standard deviations from their mean pass the pairwise test, and the weights refuse them."""


def two_opinions(k: int) -> np.ndarray | None:
    """Two closures that name nearly the same wrong place, 35 mm apart: 3.5 times the floor of either, from the mean."""
    wrong, apart = se3.exp([5.0, 0.0, 0.0, 0.0, 0.4, 0.0]), [0.0175, 0.0, 0.0, 0.0, 0.0, 0.0]
    return wrong @ se3.exp(np.array(apart) * (1 - 2 * k)) if k < 2 else None


@pytest.mark.parametrize(("loss", "solver"), sampled([(0.5, "admm"), (0.0, "admm"), (0.5, "elimination")]))
def test_two_robots_with_false_closures_only_end_as_if_they_had_not_met(
    team: Team, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, loss: float, solver: Any
) -> None:
    falsify(monkeypatch, ("alpha", "bravo"), two_opinions)
    link = LinkConfig(loss_probability=loss)
    seed = 1  # in one of ten the two opinions are steady before the weights begin, and remain
    results = meet(team, NAMES[:2], tmp_path, seed, link=link, consensus=STRICT, solver=solver)
    rounds = [r.message() for r in read_log(tmp_path / "consensus.mcap", ["/alpha/consensus/agent"])]
    assert any(m.joined_links for m in rounds), "the test needs them to be joined first"
    assert rounds[-1].revoked_links == 1
    for name in NAMES[:2]:
        assert is_alone(results[name], team[name][0])
        again, sent = replay_agent_of(
            team[name][0],
            ExchangeConfig(link=link, consensus=STRICT, solver=solver),
            seed=seed,
            exchange_path=tmp_path / "exchange.mcap",
        )
        assert sent.equal
        assert again.component == (name,)
    measured = [c for r in results.values() for c in r.closures if c.T_own_peer is not None]
    assert len(measured) == 2
    assert all(c.weight == 0.0 and c.verdict != "kept" for c in measured)


@pytest.mark.parametrize(
    ("topology", "wrong_m", "solver"),
    sampled(
        [("full", 3.0, "admm"), ("chain", 5.0, "admm"), ("full", 0.3, "admm"), ("full", 3.0, "elimination")],
        quick=2,
    ),
)
def test_a_false_link_is_parted_and_the_others_stay(
    team: Team, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, topology: str, wrong_m: float, solver: Any
) -> None:
    """Full: alpha and charlie meet through bravo. Chain: bravo and charlie without alpha, in the frame of bravo."""
    false_pair = ("alpha", "charlie") if topology == "full" else ("alpha", "bravo")
    wrong = se3.exp([wrong_m, 0.0, 0.0, 0.0, 0.5, 0.0])
    if topology == "full":
        falsify(monkeypatch, false_pair, lambda k: wrong if k < 2 else None)
    else:
        falsify(monkeypatch, false_pair, two_opinions)
    consensus = PoseConsensusConfig() if topology == "full" else STRICT
    link = LinkConfig(topology=topology, loss_probability=0.2)
    results = meet(team, NAMES, tmp_path, link=link, consensus=consensus, solver=solver)
    together = NAMES if topology == "full" else NAMES[1:]
    root = together[0]
    for name in together:
        result = results[name]
        assert result.component == together
        assert result.agreed
        assert result.converged
        T_true = se3.inverse(team[root][1][0]) @ team[name][1]
        assert se3.distance(T_true, result.T_world_keyframe)[0].max() < 0.015
        assert set(result.evidence) == set(together) - {name}
    if topology == "chain":
        assert is_alone(results["alpha"], team["alpha"][0])
    decided = [c for r in results.values() for c in r.closures if c.T_own_peer is not None]
    false = [c for c in decided if {c.robot, c.peer} == set(false_pair)]
    assert false
    assert all(c.weight == 0.0 and c.verdict != "kept" for c in false)
    if wrong_m > 1 and topology == "full":  # the cycle of the three robots knew it before any weight
        assert all(
            "off the path by bravo" in c.detail for c in false if "when the link was revoked" in c.detail
        )
    rounds = [r.message() for r in read_log(tmp_path / "consensus.mcap", ["/alpha/consensus/agent"])]
    assert rounds[-1].revoked_links == 1


def more_false_than_true(monkeypatch: pytest.MonkeyPatch) -> None:
    """All closures of alpha and bravo say the same wrong thing; charlie has two with either."""
    wrong = se3.exp([1.0, 0.0, 0.5, 0.0, 0.5, 0.0])
    falsify(monkeypatch, ("alpha", "bravo"), lambda k: wrong)
    falsify(monkeypatch, ("alpha", "charlie"), lambda k: TRUE if k < 2 else None)
    falsify(monkeypatch, ("bravo", "charlie"), lambda k: TRUE if k < 2 else None)


def test_a_false_link_with_more_closures_than_the_true_ones_is_parted(
    team: Team, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three robots: it spoils their cycle, and the rest of their images speaks against it."""
    more_false_than_true(monkeypatch)
    results = meet(team, NAMES, tmp_path)
    closures = [c for r in results.values() for c in r.closures if c.T_own_peer is not None]
    false = [c for c in closures if {c.robot, c.peer} == {"alpha", "bravo"}]
    true = [c for c in closures if c not in false]
    assert len(false) > len(true) / 2 >= 2, "the test needs more false ones than true ones of either pair"
    for name in NAMES:
        assert results[name].component == NAMES
        T_true = se3.inverse(team["alpha"][1][0]) @ team[name][1]
        assert se3.distance(T_true, results[name].T_world_keyframe)[0].max() < 0.02
    assert all(c.weight == 0.0 and c.verdict != "kept" for c in false)
    assert all(c.verdict == "kept" for c in true)


@pytest.mark.parametrize("loss", sampled([0.5, 0.0]))
def test_where_nothing_tells_which_link_is_false_nobody_is_put_anywhere(
    team: Team, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, loss: float
) -> None:
    """Rooms that are alike in every image: the cycle of the three does not close, and that is all that is known."""
    more_false_than_true(monkeypatch)
    monkeypatch.setattr("duagc.pipeline.exchange.keyframe_database.surface_agreement", lambda *_, **__: 0.6)
    config = {"link": LinkConfig(loss_probability=loss)}
    results = meet(team, NAMES, tmp_path, **config)
    for name in NAMES:
        assert is_alone(results[name], team[name][0])
        _, sent = replay_agent_of(
            team[name][0], ExchangeConfig(**config), seed=0, exchange_path=tmp_path / "exchange.mcap"
        )
        assert sent.equal
    closures = [c for r in results.values() for c in r.closures if c.T_own_peer is not None]
    assert len(closures) > 4
    assert {c.verdict for c in closures} == {Verdict.UNDECIDED.value}
    assert all("which link is false is open (alpha-bravo" in c.detail for c in closures)


@pytest.mark.parametrize("loss", sampled([0.0, 0.3]))
def test_evidence_that_a_refused_neighbor_began_to_send_comes_from_another(
    make_robot: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, loss: float
) -> None:
    """The end that verifies begins to send at its first loop closure; then the pair is not joined after all."""
    large = {name: make_robot(name, 0.6 * i, 4, gaussians=2000) for i, name in enumerate(NAMES)}
    falsify(monkeypatch, ("alpha", "charlie"), lambda k: None)
    results = meet(large, NAMES, tmp_path, link=LinkConfig(budget_bytes=12_000, loss_probability=loss))
    packets = [parse(p.data) for p in read_session(tmp_path / "exchange.mcap").packets]
    begun = [p for p in packets if p.kind is Kind.EVIDENCE and {p.sender, p.receiver} == {0, 2}]
    assert begun, "the test needs evidence that was sent before the pair was decided"
    assert len({p.offset for p in begun}) < chunk_count(Kind.EVIDENCE, begun[0].total), "all of it was sent"
    for name, result in results.items():
        assert result.component == NAMES
        assert result.converged
        assert set(result.evidence) == set(NAMES) - {name}
        assert all(len(e.ids) == 2000 for e in result.evidence.values())
