"""Sessions of two and three robots in a small room: agreement, replay, and what the log says of them."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.network import LinkConfig
from duagc.pipeline.exchange.evidence_records import gain, order_of_sending, own_records, paper_priority
from duagc.pipeline.exchange.record import read_session
from duagc.pipeline.exchange.replay import replay_agent_of
from duagc.pipeline.exchange.session import run_session_of
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import Kind
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import content_digest, read_log
from duagc.pipeline.runs.robot_data import RobotData, SessionResult
from tests.exchange.meeting import NAMES, Team, error_m, meet
from tests.fixtures.results import same
from tests.fixtures.sampling import sampled


@pytest.fixture(scope="module", params=["admm", "elimination"])
def lossy_chain(
    team: Team,
    tmp_path_factory: pytest.TempPathFactory,
    request: pytest.FixtureRequest,
) -> tuple[dict[str, SessionResult], Path, ExchangeConfig]:
    folder = tmp_path_factory.mktemp("chain")
    config = ExchangeConfig(link=LinkConfig(topology="chain", loss_probability=0.3), solver=request.param)
    return meet(team, 3, folder, link=config.link, solver=config.solver), folder, config


def test_robots_know_how_the_maps_of_others_were_made(
    lossy_chain: tuple[dict[str, SessionResult], Path, ExchangeConfig], team: Team
) -> None:
    """Of alpha's and charlie's, who are not linked, by what bravo hands on."""
    kinds = {"alpha": "blended", "bravo": "blended", "charlie": "ray_plane"}
    for name, result in lossy_chain[0].items():
        assert result.depth_of == {other: kind for other, kind in kinds.items() if other != name}
        assert result.camera_of == {other: team[other][0].camera for other in kinds if other != name}


def test_a_chain_agrees_though_packets_are_lost(lossy_chain: Any, team: Team) -> None:
    results, _, _ = lossy_chain
    for name, result in results.items():
        assert result.component == NAMES
        assert result.agreed
        assert result.converged
        assert error_m(result, team) < 0.01  # odometry alone drifts by 1 to 2 cm, frames were unknown
        assert set(result.evidence) == set(NAMES) - {name}
        assert all(len(e.ids) == 300 for e in result.evidence.values())
    alpha, charlie = results["alpha"], results["charlie"]
    assert np.allclose(alpha.T_world_keyframe[0], np.eye(4), atol=1e-12)
    for name in NAMES:  # everybody has the same poses and pairs, bit for bit
        assert np.array_equal(alpha.T_world_keyframe_of[name], charlie.T_world_keyframe_of[name])
    assert sorted(alpha.pairs) == [("alpha", "bravo"), ("alpha", "charlie"), ("bravo", "charlie")]
    assert all(np.array_equal(alpha.pairs[k], charlie.pairs[k]) for k in alpha.pairs)
    assert len(alpha.pairs["alpha", "bravo"]) > 10


def test_evidence_is_the_owners_wherever_it_ends(lossy_chain: Any) -> None:
    results, _, _ = lossy_chain
    for name in NAMES:
        for other in set(NAMES) - {name}:
            assert same_evidence(results[other].evidence[name], results[name].own_evidence)


def same_evidence(a: Any, b: Any) -> bool:
    return all(
        np.array_equal(getattr(a, f), getattr(b, f)) for f in ("ids", "anchors", "theta", "information")
    )


@pytest.mark.parametrize("name", NAMES)
def test_an_agent_comes_out_again_from_its_delivered_packets(lossy_chain: Any, team: Team, name: str) -> None:
    results, folder, config = lossy_chain
    again, sent = replay_agent_of(team[name][0], config, seed=0, exchange_path=folder / "exchange.mcap")
    assert sent.equal
    assert same(again, results[name])


def test_a_replay_from_other_data_differs(lossy_chain: Any, make_robot: Any) -> None:
    """The comparison above can fail: other data give other packets."""
    _, folder, config = lossy_chain
    other, _ = make_robot("alpha", 0.05, keyframes=4)
    _, sent = replay_agent_of(other, config, seed=0, exchange_path=folder / "exchange.mcap")
    assert not sent.equal


def test_the_log_accounts_for_every_byte(lossy_chain: Any) -> None:
    _, folder, _ = lossy_chain
    session = read_session(folder / "exchange.mcap")
    summary = next(iter(read_log(folder / "exchange.mcap", ["/exchange/summary"]))).message()
    assert summary.bytes_sent == sum(len(p.data) for p in session.packets)
    end_ns = max(p.send_ns for p in session.packets)
    on_time = [len(p.data) * sum(at_ns <= end_ns for at_ns in p.deliver_ns) for p in session.packets]
    assert summary.bytes_delivered == sum(on_time)
    assert sum(on_time) < sum(len(p.data) * len(p.deliver_ns) for p in session.packets)
    assert summary.packets_dropped == sum(not p.deliver_ns for p in session.packets)
    assert 0.2 < summary.packets_dropped / summary.packets_sent < 0.4
    assert all(bool(p.dropped) == (not p.deliver_ns) for p in session.packets)
    for sender in NAMES:
        for receiver in NAMES:
            sequences = [p.sequence for p in session.packets if (p.sender, p.receiver) == (sender, receiver)]
            assert sequences == list(range(len(sequences)))
    budget = LinkConfig().budget_bytes
    per_round: dict[tuple[str, str, int], int] = {}
    for p in session.packets:
        key = (p.sender, p.receiver, p.round)
        per_round[key] = per_round.get(key, 0) + len(p.data)
    assert max(per_round.values()) <= budget


def test_every_candidate_has_a_verdict_with_a_reason(lossy_chain: Any) -> None:
    results, folder, _ = lossy_chain
    topics = [f"/{name}/consensus/loop_closure" for name in NAMES]
    decisions = [r.message() for r in read_log(folder / "consensus.mcap", topics)]
    assert len(decisions) == sum(len(r.closures) for r in results.values()) > 10
    assert all(d.verdict for d in decisions)
    kept = [d for d in decisions if d.verdict == "kept"]
    assert kept
    assert all(d.weight == 1.0 and d.measured for d in kept)


def test_the_printed_order_of_evidence_depends_on_the_unit_of_length(team: Team) -> None:
    """The default order does not: information and prior change alike. Both orders hold every Gaussian once."""
    records = own_records(team["alpha"][0], Kind.EVIDENCE_DOUBLE, ExchangeConfig().weights)
    in_cm = records.copy()
    in_cm["information"][:, :6] /= 100.0**2
    by_paper = [order_of_sending(r, "paper", 0, "alpha") for r in (records, in_cm)]
    assert not np.array_equal(*by_paper)
    by_gain, reverse = (order_of_sending(records, kind, 0, "alpha") for kind in ("gain", "reversed"))
    assert np.array_equal(gain(records)[by_gain], gain(records)[reverse[::-1]])
    drawn = [order_of_sending(records, "random", seed, "alpha") for seed in (0, 0, 1)]
    assert np.array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])
    for order in (*by_paper, by_gain, reverse, *drawn):
        assert np.array_equal(np.sort(order), np.arange(len(records)))
    value = paper_priority(records)[by_paper[0]]
    assert np.all(np.diff(value) <= 0)


def test_a_share_of_the_evidence_is_the_first_of_its_order(team: Team, tmp_path: Path) -> None:
    """What stays with its owner is known to nobody else, and is matched with nothing."""
    half = meet(team, 2, tmp_path, evidence_share=0.5)
    for robot, peer in (NAMES[:2], NAMES[1::-1]):
        records = own_records(team[peer][0], Kind.EVIDENCE, ExchangeConfig().weights)
        first = records[order_of_sending(records, "gain", 0, peer)][: math.ceil(len(records) / 2)]
        here = half[robot].evidence[peer].ids
        assert np.array_equal(np.sort(here), np.sort(first["id"]))
        assert len(half[peer].own_evidence.ids) == len(records) > len(here)
        assert half[robot].arrived == {peer: 0.5}
    (pairs,) = half["alpha"].pairs.values()
    for ids, owner, other in zip(np.asarray(pairs).T, NAMES, NAMES[1::-1], strict=False):
        assert len(ids)
        assert set(ids.tolist()) <= set(half[other].evidence[owner].ids.tolist())


def test_two_sessions_are_the_same_bit_for_bit(team: Team, tmp_path: Path) -> None:
    digests = []
    for run in ("one", "two"):
        (tmp_path / run).mkdir()
        meet(team, 2, tmp_path / run, link=LinkConfig(loss_probability=0.5), coverage="overlap")
        digests.append([content_digest(tmp_path / run / f"{log}.mcap") for log in ("exchange", "consensus")])
    assert digests[0] == digests[1]


def test_elimination_ends_where_the_other_solver_does(
    team: Team, undisturbed: dict[str, SessionResult], tmp_path: Path
) -> None:
    results = meet(team, 2, tmp_path, solver="elimination")
    for name, result in results.items():
        assert result.converged
        moved_m, moved_rad = se3.distance(result.T_world_keyframe, undisturbed[name].T_world_keyframe)
        assert moved_m.max() < 2e-5  # the other one stops when it moves by less than 1e-5
        assert moved_rad.max() < 2e-5
    kinds = {p.kind_name for p in read_session(tmp_path / "exchange.mcap").packets}
    assert "TREE" in kinds


def test_robots_that_saw_different_places_stay_apart(make_robot: Any, tmp_path: Path) -> None:
    data = [make_robot("alpha", 0.0, 2, 20)[0], make_robot("bravo", np.pi, 2, 20)[0]]
    results = run_session_of(
        data,
        ExchangeConfig(),
        seed=0,
        exchange_path=tmp_path / "exchange.mcap",
        consensus_path=tmp_path / "consensus.mcap",
    )
    for d in data:
        assert results[d.robot].component == (d.robot,)
        assert results[d.robot].converged
        assert np.array_equal(results[d.robot].T_world_keyframe, d.T_map_keyframe)
    closures = [c for result in results.values() for c in result.closures]
    assert len(closures) >= 2  # why not, for every keyframe of the robot that sent its descriptors
    assert all(c.verdict != "kept" for c in closures)


@pytest.mark.parametrize("solver", sampled(["admm", "elimination"]))
def test_neither_names_nor_the_origins_of_maps_move_the_team(team: Team, tmp_path: Path, solver: Any) -> None:
    """Other names and map frames anywhere: the same closures, and the same shape of the team."""
    rng = np.random.default_rng(0)
    renamed = dict(zip(NAMES, ("zulu", "alpha", "mike"), strict=True))
    found = []
    for change in (False, True):
        data = [team[name][0] for name in NAMES]
        if change:
            data = [dataclasses.replace(moved(d, rng), robot=renamed[d.robot]) for d in data]
        folder = tmp_path / str(change)
        folder.mkdir()
        results = run_session_of(
            data,
            ExchangeConfig(solver=solver),
            seed=0,
            exchange_path=folder / "exchange.mcap",
            consensus_path=folder / "consensus.mcap",
        )
        names = [renamed[name] if change else name for name in NAMES]
        poses = np.concatenate([results[name].T_world_keyframe for name in names])
        found.append(se3.inverse(poses[0]) @ poses)
    assert (
        se3.distance(*found)[0].max() < 2e-5
    )  # the tolerance of the solver; no other closures, no other weights


def moved(data: RobotData, rng: np.random.Generator) -> RobotData:
    """The same robot with another map frame."""
    T = se3.from_quat_translation(rng.normal(size=(1, 4)), 10 * rng.normal(size=(1, 3))) @ data.T_map_keyframe
    return dataclasses.replace(data, T_map_keyframe=T, gaussians=data.gaussians.moved(data.T_map_keyframe, T))


def test_a_robot_without_a_map_keeps_nobody_waiting(team: Team, tmp_path: Path) -> None:
    empty = dataclasses.replace(
        team["bravo"][0],
        T_map_keyframe=np.zeros((0, 4, 4)),
        odometry=[],
        registrations=[],
        gaussians=team["bravo"][0].gaussians.select(slice(0, 0)),
    )
    results = run_session_of(
        [team["alpha"][0], empty],
        ExchangeConfig(),
        seed=0,
        exchange_path=tmp_path / "exchange.mcap",
        consensus_path=tmp_path / "consensus.mcap",
    )
    assert results["bravo"].component == ("bravo",)
    assert results["bravo"].converged
    assert results["bravo"].rounds < 20


def test_every_registration_counts_in_the_consensus(team: Team, tmp_path: Path) -> None:
    """A sure registration that the odometry does not tell of holds the last keyframe where it says."""
    alpha, truth = team["alpha"]
    last = alpha.keyframes - 1
    T_first_last = se3.inverse(alpha.T_map_keyframe[0]) @ alpha.T_map_keyframe[last]
    T_first_last = T_first_last @ se3.exp(np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.0]))
    sure = RelativePose(0, last, T_first_last, 1e10 * np.eye(6))
    consensus = PoseConsensusConfig(odometry_floor_m=1e-5, odometry_floor_rad=1e-5)
    away_m = []
    for more in ([], [sure]):
        stated = dataclasses.replace(alpha, registrations=[*alpha.registrations, *more])
        result = meet({**team, "alpha": (stated, truth)}, 2, tmp_path, consensus=consensus)["alpha"]
        assert result.component == ("alpha", "bravo")
        T = result.T_world_keyframe
        away_m.append(float(se3.distance(T_first_last, se3.inverse(T[0]) @ T[last])[0]))
    assert away_m[0] > 0.01
    assert away_m[1] < 1e-3
