"""Sessions of links that lose, delay, copy or end, and of robots that err: rounds are lost, and nothing else."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.exchange import ExchangeConfig, InjectionConfig
from duagc.pipeline.config.network import LinkConfig, LinkWindow, TransportConfig
from duagc.pipeline.exchange.map_agent import MapAgent
from duagc.pipeline.exchange.record import read_session
from duagc.pipeline.exchange.replay import replay_agent_of
from duagc.pipeline.exchange.session_result import result_of
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import Kind, Packet, chunk_bytes, parse, serialize
from duagc.pipeline.recording import read_log
from duagc.pipeline.runs.robot_data import SessionResult
from duagc.pipeline.splat.information import MEAN
from tests.exchange.meeting import NAMES, Team, error_m, meet
from tests.fixtures.results import same
from tests.fixtures.sampling import sampled


def test_total_loss_is_no_communication(team: Team, tmp_path: Path) -> None:
    (tmp_path / "lost").mkdir()
    (tmp_path / "none").mkdir()
    transport = TransportConfig(silent_after_rounds=20)
    lost = meet(team, 2, tmp_path / "lost", link=LinkConfig(loss_probability=1.0), transport=transport)
    none = meet(team, 2, tmp_path / "none", link=LinkConfig(topology="none"))
    for name in NAMES[:2]:
        for result in (lost[name], none[name]):
            assert result.component == (name,)
            assert np.array_equal(result.T_world_keyframe, team[name][0].T_map_keyframe)
            assert result.evidence == {}
            assert result.pairs == {}
        assert same(dataclasses.replace(lost[name], rounds=0), dataclasses.replace(none[name], rounds=0))
        assert lost[name].rounds == 22


TROUBLE = {
    "bursts": {"burst_gap_ns": 600_000_000, "burst_length_ns": 300_000_000},
    "jitter": {"jitter_ns": 450_000_000},
    "duplicates": {"duplicate_probability": 0.5, "jitter_ns": 150_000_000},
    "bandwidth": {"bandwidth_bytes_per_s": 150_000, "queue_ns": 150_000_000},
    "everything": {
        "loss_probability": 0.2,
        "burst_gap_ns": 800_000_000,
        "burst_length_ns": 200_000_000,
        "jitter_ns": 300_000_000,
        "duplicate_probability": 0.2,
        "bandwidth_bytes_per_s": 600_000,
    },
}


@pytest.mark.parametrize("name", sampled(reversed(TROUBLE)))
def test_a_troubled_link_costs_rounds_and_nothing_else(
    team: Team, undisturbed: dict[str, SessionResult], tmp_path: Path, name: str
) -> None:
    link = LinkConfig(**TROUBLE[name])  # type: ignore[arg-type]
    results = meet(team, 2, tmp_path, link=link)
    for robot, result in results.items():
        assert result.converged
        moved_m, _ = se3.distance(result.T_world_keyframe, undisturbed[robot].T_world_keyframe)
        assert moved_m.max() < 1e-4  # both stop when they move by less than that, on different ways
        assert set(result.evidence) == set(NAMES[:2]) - {robot}
        again, sent = replay_agent_of(
            team[robot][0], ExchangeConfig(link=link), seed=0, exchange_path=tmp_path / "exchange.mcap"
        )
        assert sent.equal
        assert same(again, result)
    assert results["alpha"].rounds > undisturbed["alpha"].rounds or name == "duplicates"


def test_a_copy_made_by_the_network_changes_nothing(
    team: Team, undisturbed: dict[str, SessionResult], tmp_path: Path
) -> None:
    results = meet(team, 2, tmp_path, link=LinkConfig(duplicate_probability=1.0))
    assert all(same(results[robot], undisturbed[robot]) for robot in undisturbed)
    summary = next(iter(read_log(tmp_path / "exchange.mcap", ["/exchange/summary"]))).message()
    packets = read_session(tmp_path / "exchange.mcap").packets
    last = [p for p in packets if p.round == summary.rounds - 1]  # no agent sees these
    assert last
    assert summary.bytes_delivered == 2 * (summary.bytes_sent - sum(len(p.data) for p in last))


@pytest.mark.parametrize("seed", sampled(range(3)))
def test_injected_false_closures_are_found_out(
    team: Team, undisturbed: dict[str, SessionResult], tmp_path: Path, seed: int
) -> None:
    faults = InjectionConfig(false_closures=0.3)
    results = meet(team, 2, tmp_path, seed=seed, injection=faults)
    closures = [c for result in results.values() for c in result.closures]
    false = [c for c in closures if "injected" in c.detail]
    true = [c for c in closures if c.T_own_peer is not None and "injected" not in c.detail]
    assert len(false) == round(3 / 7 * len(true)) > 1
    assert all(c.weight == 0.0 for c in false)  # they took part and lost
    assert sum(c.weight is not None and c.weight > 0.5 for c in true) >= 0.9 * len(true)
    for name, result in results.items():
        assert result.converged
        moved_m, _ = se3.distance(result.T_world_keyframe, undisturbed[name].T_world_keyframe)
        assert moved_m.max() < 2e-3


def test_missing_poses_cost_rounds_and_false_matches_are_as_many_as_asked_for(
    team: Team, undisturbed: dict[str, SessionResult], tmp_path: Path
) -> None:
    faults = InjectionConfig(pose_dropouts=0.5, false_matches=0.4)
    results = meet(team, 2, tmp_path, injection=faults)
    for name, result in results.items():
        assert result.converged
        assert result.rounds > undisturbed[name].rounds
        moved_m, _ = se3.distance(result.T_world_keyframe, undisturbed[name].T_world_keyframe)
        assert moved_m.max() < 1e-4
    true, mixed = (r["alpha"].pairs["alpha", "bravo"] for r in (undisturbed, results))
    assert len(true) == len(mixed)
    assert 0.2 < np.mean(np.any(true != mixed, axis=1)) < 0.6
    assert np.array_equal(np.sort(true[:, 1]), np.sort(mixed[:, 1]))


def test_a_liar_sends_what_is_wrong_and_computes_with_what_is_right(
    team: Team, undisturbed: dict[str, SessionResult], tmp_path: Path
) -> None:
    faults = InjectionConfig(liar="bravo", false_poses_m=0.02, false_gaussians=0.4, false_certainty=5.0)
    limits = {"injection": faults, "max_rounds": 100}  # poses that contradict each other never settle
    results = meet(team, 2, tmp_path, **limits)
    own, heard = results["bravo"].own_evidence, results["alpha"].evidence["bravo"]
    assert same(own, undisturbed["bravo"].own_evidence)
    order = np.argsort(heard.ids)
    off_m = np.linalg.norm(heard.theta[order, MEAN] - own.theta[:, MEAN], axis=1)
    wrong = off_m > 0.29
    assert 0.3 < wrong.mean() < 0.5
    assert off_m[~wrong].max() < 0.01
    ratio = heard.information[order][wrong, :3].sum() / own.information[wrong, :3].sum()
    assert ratio == pytest.approx(25.0, rel=0.02)
    placed, true = (results[name].T_world_keyframe_of["bravo"][:, :3, 3] for name in ("alpha", "bravo"))
    assert np.linalg.norm(placed - true, axis=1).min() > 0.01
    again, sent = replay_agent_of(
        team["bravo"][0], ExchangeConfig(**limits), seed=0, exchange_path=tmp_path / "exchange.mcap"
    )
    assert sent.equal
    assert same(again, results["bravo"])


def test_a_liar_that_is_not_there_or_tells_the_truth_is_refused(team: Team, tmp_path: Path) -> None:
    with pytest.raises(DuagError, match=r"injection\.liar: robot 'delta', expected one of alpha, bravo"):
        meet(team, 2, tmp_path, injection=InjectionConfig(liar="delta", false_poses_m=0.1))
    for lies in ({"liar": "bravo"}, {"false_gaussians": 0.5}):
        with pytest.raises(ValidationError, match="expected a name with one of these"):
            InjectionConfig(**lies)


def test_a_link_that_dies_leaves_the_way_around(team: Team, tmp_path: Path) -> None:
    """Alpha and charlie lose sight of each other while the poses move; bravo hears both."""
    windows = (
        {"sender": "alpha", "receiver": "bravo"},
        {"sender": "bravo", "receiver": "charlie"},
        {"sender": "alpha", "receiver": "charlie", "until_ns": 2_000_000_000},
    )
    link = LinkConfig(topology="listed", windows=windows)  # type: ignore[arg-type]
    transport = TransportConfig(contact_lost_after_rounds=16, silent_after_rounds=40)
    results = meet(team, 3, tmp_path, link=link, transport=transport)
    reasons = {p.dropped for p in read_session(tmp_path / "exchange.mcap").packets}
    assert reasons == {"", "no link at this time"}
    for name, result in results.items():
        assert result.component == NAMES
        assert error_m(result, team) < 0.02
        assert set(result.evidence) == set(NAMES) - {name}


@pytest.mark.parametrize("left_round", sampled([20, 30]))
def test_a_robot_that_leaves_keeps_its_poses_and_is_not_done(
    team: Team, tmp_path: Path, left_round: int
) -> None:
    """Charlie loses alpha while the poses move, and bravo three rounds later; the other two go on without it."""
    until_ns, later_ns = (r * ExchangeConfig().period_ns for r in (left_round, left_round + 3))
    windows = (
        LinkWindow(sender="alpha", receiver="bravo"),
        LinkWindow(sender="alpha", receiver="charlie", until_ns=until_ns),
        LinkWindow(sender="bravo", receiver="charlie", until_ns=later_ns),
    )
    link = LinkConfig(topology="listed", windows=windows)
    transport = TransportConfig(contact_lost_after_rounds=12, silent_after_rounds=40)
    results = meet(team, 3, tmp_path, link=link, transport=transport)
    rounds = [r.message() for r in read_log(tmp_path / "consensus.mcap", ["/charlie/consensus/agent"])]
    assert rounds[-1].done
    assert rounds[-1].revoked_links == 0
    left = results["charlie"]
    assert (left.agreed, left.converged) == (False, False)
    assert left.component == NAMES
    assert error_m(left, team) < 0.02
    for name in NAMES[:2]:
        assert results[name].component == NAMES[:2]
        assert results[name].converged
        assert error_m(results[name], team) < 0.02


def test_a_link_in_one_direction_is_no_link(team: Team, tmp_path: Path) -> None:
    windows = ({"sender": "alpha", "receiver": "bravo", "both_ways": False},)
    link = LinkConfig(topology="listed", windows=windows)  # type: ignore[arg-type]
    results = meet(team, 2, tmp_path, link=link, transport=TransportConfig(silent_after_rounds=20))
    for name, result in results.items():
        assert result.component == (name,)
        assert np.array_equal(result.T_world_keyframe, team[name][0].T_map_keyframe)


def test_a_neighbor_that_falls_silent_ends_the_session(team: Team) -> None:
    """Whoever it met has gone: the agent stops waiting, keeps what it has, and does not call that agreement."""
    config = ExchangeConfig(transport=TransportConfig(silent_after_rounds=15))
    agents = {n: MapAgent(team[n][0], NAMES[:2], set(NAMES[:2]) - {n}, config, seed=0) for n in NAMES[:2]}
    air: dict[str, list[bytes]] = {n: [] for n in NAMES[:2]}
    for round_index in range(60):
        if round_index == 20:  # the poses move by now; bravo is switched off
            assert agents["alpha"].poses is not None
            assert not agents["alpha"].agreed
            del agents["bravo"]
        sent = {n: agent.tick(round_index, air[n]) for n, agent in agents.items()}
        air = {n: [o.packet for s in sent.values() for o in s if o.receiver == n] for n in NAMES[:2]}
    assert agents["alpha"].done
    result = result_of(agents["alpha"])
    assert not result.converged
    assert not result.agreed
    assert np.isfinite(result.T_world_keyframe).all()


def test_an_end_by_rounds_leaves_the_own_map_usable(team: Team, tmp_path: Path) -> None:
    results = meet(team, 2, tmp_path, max_rounds=16)
    for name, result in results.items():
        assert not result.converged
        assert np.isfinite(result.T_world_keyframe).all()
        assert name in result.component


def test_hostile_packets_change_nothing(team: Team) -> None:
    """An agent fed with rubbish, forgeries and contradictions behaves as one that heard nothing useful."""
    rng = np.random.default_rng(0)
    rubbish: list[bytes | Packet] = [rng.bytes(int(n)) for n in rng.integers(0, 1300, 50)]
    for kind in Kind:
        for size in (0, 7, 40, 1100):
            payload = rng.bytes(size)
            for sender in (1, 2):
                rubbish.append(Packet(kind, sender, 0, 0, 0, int(kind), 0, size, payload))
        if kind > Kind.STATE:
            rubbish.append(Packet(kind, 1, 0, 0, 0, 77, 0, 1 << 31, bytes(chunk_bytes(kind))))
    agent = MapAgent(team["alpha"][0], ["alpha", "bravo", "charlie"], ["bravo"], ExchangeConfig(), seed=0)
    sequences = itertools.count()
    for round_index in range(4):
        packets = [
            serialize(dataclasses.replace(r, sequence=next(sequences))) if isinstance(r, Packet) else r
            for r in rubbish
        ]
        for out in agent.tick(round_index, packets):
            assert parse(out.packet).sender == 0
    assert sum(agent.refused.values()) > 200
    assert not agent.neighbors[1].decided
    assert result_of(agent).component == ("alpha",)
