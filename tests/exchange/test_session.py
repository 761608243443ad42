"""Sessions of two and three robots in a small room: agreement, replay, loss, isolation."""

from __future__ import annotations

import ast
import dataclasses
import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.config.exchange import ExchangeConfig, InjectionConfig
from duagc.pipeline.config.network import LinkConfig, TransportConfig
from duagc.pipeline.exchange.evidence_records import gain, order_of_sending, own_records, paper_priority
from duagc.pipeline.exchange.map_agent import MapAgent
from duagc.pipeline.exchange.record import read_session
from duagc.pipeline.exchange.replay import replay_agent_of
from duagc.pipeline.exchange.session import run_session_of
from duagc.pipeline.exchange.session_result import result_of
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import Kind, Packet, chunk_bytes, parse, serialize
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import content_digest, read_log
from duagc.pipeline.runs.robot_data import RobotData, SessionResult
from tests.fixtures.results import same
from tests.fixtures.sampling import sampled

NAMES = ("alpha", "bravo", "charlie")


@pytest.fixture(scope="module")
def team(make_robot: Any) -> dict[str, tuple[RobotData, np.ndarray]]:
    """Three robots; the map of the last was made with another depth."""
    robots = {name: make_robot(name, 0.6 * i, keyframes=4) for i, name in enumerate(NAMES)}
    data, T_true = robots["charlie"]
    return robots | {"charlie": (replace(data, depth="ray_plane"), T_true)}


def meet(
    team: dict[str, tuple[RobotData, np.ndarray]], robots: int, folder: Path, seed: int = 0, **config: Any
) -> dict[str, SessionResult]:
    data = [team[name][0] for name in NAMES[:robots]]
    return run_session_of(
        data,
        ExchangeConfig(**config),
        seed=seed,
        exchange_path=folder / "exchange.mcap",
        consensus_path=folder / "consensus.mcap",
    )


@pytest.fixture(scope="module", params=["admm", "elimination"])
def lossy_chain(
    team: dict[str, tuple[RobotData, np.ndarray]],
    tmp_path_factory: pytest.TempPathFactory,
    request: pytest.FixtureRequest,
) -> tuple[dict[str, SessionResult], Path, ExchangeConfig]:
    folder = tmp_path_factory.mktemp("chain")
    config = ExchangeConfig(link=LinkConfig(topology="chain", loss_probability=0.3), solver=request.param)
    return meet(team, 3, folder, link=config.link, solver=config.solver), folder, config


def test_robots_know_how_the_maps_of_others_were_made(
    lossy_chain: tuple[dict[str, SessionResult], Path, ExchangeConfig],
) -> None:
    """Of alpha's and charlie's, who are not linked, by what bravo hands on."""
    kinds = {"alpha": "blended", "bravo": "blended", "charlie": "ray_plane"}
    for name, result in lossy_chain[0].items():
        assert result.depth_of == {other: kind for other, kind in kinds.items() if other != name}


def error_m(result: SessionResult, team: dict[str, tuple[RobotData, np.ndarray]]) -> float:
    """Largest distance of an own keyframe from the truth, in the map frame of the lowest-named robot."""
    T_true = se3.inverse(team[result.component[0]][1][0]) @ team[result.robot][1]
    return float(se3.distance(T_true, result.T_world_keyframe)[0].max())


def test_a_chain_agrees_though_packets_are_lost(lossy_chain: Any, team: Any) -> None:
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
def test_an_agent_comes_out_again_from_its_delivered_packets(lossy_chain: Any, team: Any, name: str) -> None:
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
    assert summary.bytes_delivered == sum(len(p.data) * len(p.deliver_ns) for p in session.packets)
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


def test_the_printed_order_of_evidence_depends_on_the_unit_of_length(team: Any) -> None:
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


def test_two_sessions_are_the_same_bit_for_bit(team: Any, tmp_path: Path) -> None:
    digests = []
    for run in ("one", "two"):
        (tmp_path / run).mkdir()
        meet(team, 2, tmp_path / run, link=LinkConfig(loss_probability=0.5), coverage="overlap")
        digests.append([content_digest(tmp_path / run / f"{log}.mcap") for log in ("exchange", "consensus")])
    assert digests[0] == digests[1]


def test_total_loss_is_no_communication(team: Any, tmp_path: Path) -> None:
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


@pytest.fixture(scope="module")
def undisturbed(team: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, SessionResult]:
    return meet(team, 2, tmp_path_factory.mktemp("undisturbed"))


@pytest.mark.parametrize("name", sampled(reversed(TROUBLE)))
def test_a_troubled_link_costs_rounds_and_nothing_else(
    team: Any, undisturbed: dict[str, SessionResult], tmp_path: Path, name: str
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
    team: Any, undisturbed: dict[str, SessionResult], tmp_path: Path
) -> None:
    results = meet(team, 2, tmp_path, link=LinkConfig(duplicate_probability=1.0))
    assert all(same(results[robot], undisturbed[robot]) for robot in undisturbed)
    summary = next(iter(read_log(tmp_path / "exchange.mcap", ["/exchange/summary"]))).message()
    assert summary.bytes_delivered == 2 * summary.bytes_sent


@pytest.mark.parametrize("seed", sampled(range(3)))
def test_injected_false_closures_are_found_out(
    team: Any, undisturbed: dict[str, SessionResult], tmp_path: Path, seed: int
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


def test_elimination_ends_where_the_other_solver_does(
    team: Any, undisturbed: dict[str, SessionResult], tmp_path: Path
) -> None:
    results = meet(team, 2, tmp_path, solver="elimination")
    for name, result in results.items():
        assert result.converged
        moved_m, moved_rad = se3.distance(result.T_world_keyframe, undisturbed[name].T_world_keyframe)
        assert moved_m.max() < 2e-5  # the other one stops when it moves by less than 1e-5
        assert moved_rad.max() < 2e-5
    kinds = {p.kind_name for p in read_session(tmp_path / "exchange.mcap").packets}
    assert "TREE" in kinds


def test_missing_poses_cost_rounds_and_false_matches_are_as_many_as_asked_for(
    team: Any, undisturbed: dict[str, SessionResult], tmp_path: Path
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


def test_a_link_that_dies_leaves_the_way_around(team: Any, tmp_path: Path) -> None:
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


def test_a_link_in_one_direction_is_no_link(team: Any, tmp_path: Path) -> None:
    windows = ({"sender": "alpha", "receiver": "bravo", "both_ways": False},)
    link = LinkConfig(topology="listed", windows=windows)  # type: ignore[arg-type]
    results = meet(team, 2, tmp_path, link=link, transport=TransportConfig(silent_after_rounds=20))
    for name, result in results.items():
        assert result.component == (name,)
        assert np.array_equal(result.T_world_keyframe, team[name][0].T_map_keyframe)


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
def test_neither_names_nor_the_origins_of_maps_move_the_team(team: Any, tmp_path: Path, solver: Any) -> None:
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


def test_a_robot_without_a_map_keeps_nobody_waiting(team: Any, tmp_path: Path) -> None:
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


def test_a_neighbor_that_falls_silent_ends_the_session(team: Any) -> None:
    """Whoever it met has gone: the agent stops waiting, keeps what it has, and does not call that agreement."""
    config = ExchangeConfig(transport=TransportConfig(silent_after_rounds=15))
    agents = {n: MapAgent(team[n][0], NAMES[:2], set(NAMES[:2]) - {n}, config, seed=0) for n in NAMES[:2]}
    air: dict[str, list[bytes]] = {n: [] for n in NAMES[:2]}
    for round_index in range(60):
        if round_index == 20:  # the poses move by now; bravo is switched off
            assert agents["alpha"].poses is not None
            assert not agents["alpha"].agreed
            del agents["bravo"]
        sent = {n: agent.tick(round_index, round_index, air[n]) for n, agent in agents.items()}
        air = {n: [o.packet for s in sent.values() for o in s if o.receiver == n] for n in NAMES[:2]}
    assert agents["alpha"].done
    result = result_of(agents["alpha"])
    assert not result.converged
    assert not result.agreed
    assert np.isfinite(result.T_world_keyframe).all()


def test_an_end_by_rounds_leaves_the_own_map_usable(team: Any, tmp_path: Path) -> None:
    results = meet(team, 2, tmp_path, max_rounds=16)
    for name, result in results.items():
        assert not result.converged
        assert np.isfinite(result.T_world_keyframe).all()
        assert name in result.component


def test_hostile_packets_change_nothing(team: Any) -> None:
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
        for out in agent.tick(round_index, round_index, packets):
            assert parse(out.packet).sender == 0
    assert sum(agent.refused.values()) > 200
    assert not agent.neighbors[1].decided
    assert result_of(agent).component == ("alpha",)


FORBIDDEN = ("truth", "evaluation", "converters", "fusion", "viewer", "report")


def test_an_agent_can_reach_nothing_but_its_own() -> None:
    """Only the session and the replay name other robots' data or read files; the agent's own modules do not."""
    folder = Path(__file__).parents[2] / "pipeline" / "exchange"
    readers = {"session.py", "replay.py", "record.py", "inputs.py"}
    for path in sorted(folder.glob("*.py")):
        names: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names |= {f"{node.module}.{alias.name}" for alias in node.names}
        assert not any(word in name for name in names for word in FORBIDDEN), path.name
        if path.name not in readers:
            assert not any(n.split(".")[0] in ("pathlib", "os", "io", "mcap") for n in names), path.name
            assert not any(
                n.startswith(("duagc.pipeline.recording", "duagc.pipeline.exchange.session")) for n in names
            ), path.name


def test_every_registration_counts_in_the_consensus(team: Any, tmp_path: Path) -> None:
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
