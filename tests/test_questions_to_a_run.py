"""What can be asked of a finished run: its Gaussians, packets and loop closures, and its exchange under faults."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.evaluation.network import Session
from duagc.pipeline.exchange.record import read_session
from duagc.pipeline.exchange.session import run_session
from duagc.pipeline.experiments import pose_reference, team_faults
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs.folder import RunFolder
from duagc.pipeline.steps import agent_input
from duagc.pipeline.viewing.inspection import Inspector, format_facts, format_loop_closures
from tests.fixtures import fake_run


def test_what_happened_can_be_asked_for(small_run: Path) -> None:
    """A Gaussian's evidence is where its packets say, and the round says what was on the air."""
    inspector = Inspector(RunFolder(small_run))
    robots = inspector.run.robots
    pairs = next(iter(Session(inspector.run).pairs.values()))
    gaussian = int(pairs[0, 0])
    facts = inspector.gaussian("alpha", gaussian)
    assert facts["matches"] == {"bravo": int(pairs[0, 1])}
    assert facts["fused_map"]["robots_in_it"] == 2
    assert facts["own_map"]["mean_m"] == pytest.approx(
        robots["alpha"].own_map.gaussians.means[robots["alpha"].own_map.gaussians.ids == gaussian][0].tolist()
    )
    journey = facts["evidence_sent"][0]
    packet = inspector.packet(journey["packet"])
    assert (packet["sender"], packet["receiver"], packet["round"]) == ("alpha", "bravo", journey["round"])
    assert gaussian in packet["content"]["gaussians"]
    air = inspector.round(journey["round"])["links"]["alpha to bravo"]
    assert air["kinds"]["EVIDENCE"] > 0
    assert air["packets"] == sum(air["kinds"].values())
    last = inspector.round(inspector.round(0)["rounds"] - 1)
    assert all(robot["agreed"] for robot in last["robots"].values())
    assert "robots in it" in format_facts(facts)
    ids = robots["alpha"].own_map.gaussians.ids
    spans = f"no Gaussian 1099511627776 in the map of alpha, expected an id from {ids.min()} to {ids.max()}$"
    for ask, complaint in (
        (lambda: inspector.gaussian("zulu", 1), "no robot 'zulu', expected one of alpha, bravo"),
        (lambda: inspector.gaussian("alpha", 1 << 40), spans),
        (lambda: inspector.packet(1 << 40), "found --packet"),
        (lambda: inspector.round(1 << 40), "found --round"),
    ):
        with pytest.raises(DuagError, match=complaint):
            ask()


@pytest.mark.parametrize(
    ("count", "of_rounds", "of_packets"),
    [
        (0, "no round", "no packet"),
        (1, "round 0 alone", "packet 0 alone"),
        (5, "rounds 0 to 4", "packets 0 to 4"),
    ],
)
def test_a_number_that_is_too_large_is_next_to_those_that_are_there(
    tmp_path: Path, count: int, of_rounds: str, of_packets: str
) -> None:
    inspector = Inspector(RunFolder(fake_run.make(tmp_path).run))
    vars(inspector)["_session"] = SimpleNamespace(rounds=count, packets=[None] * count)
    with pytest.raises(DuagError, match=f"has {of_rounds}, found --round {count}$"):
        inspector.round(count)
    with pytest.raises(DuagError, match=f"has {of_packets}, found --packet {count}$"):
        inspector.packet(count)


def test_every_candidate_of_a_run_can_be_asked_for_with_its_reason(small_run: Path) -> None:
    inspector = Inspector(RunFolder(small_run))
    facts = inspector.loop_closures()
    candidates = facts["candidates"]
    assert len({c["robot"] for c in candidates}) == 1  # one end of the pair decided
    assert any(c["verdict"] == "kept" and c["weight"] == 1.0 for c in candidates)
    assert all(c["verdict"] for c in candidates)
    assert all(c["detail"] for c in candidates if c["verdict"] != "kept")
    assert sum(facts["verdicts"].values()) == len(candidates)
    assert inspector.loop_closures("alpha") == inspector.loop_closures("bravo") == facts
    with pytest.raises(DuagError, match="no robot 'zulu', expected one of alpha, bravo"):
        inspector.loop_closures("zulu")
    lines = format_loop_closures(facts).splitlines()
    assert lines[0].split()[:4] == ["Robot", "Peer", "Keyframes", "Descriptors"]
    assert len(lines) == 1 + len(candidates) + 2 + len(facts["verdicts"])


def packet(kind: str, send_ns: int, *deliver_ns: int) -> SimpleNamespace:
    return SimpleNamespace(
        sender="alpha", receiver="bravo", kind_name=kind, send_ns=send_ns, deliver_ns=deliver_ns
    )


@pytest.mark.parametrize(
    ("packets", "reason"),
    [
        ([], "no packet was sent"),
        ([packet("HELLO", 0), packet("HELLO", 9)], "of 2 packets none arrived in time"),
        (
            [packet("HELLO", 0, 10), packet("HELLO", 9)],
            "of 2 packets none arrived in time",
        ),  # after the session
        ([packet("HELLO", 0, 1), packet("DESCRIPTORS", 9)], "of 2 packets 1 arrived in time, none with desc"),
        ([packet("DESCRIPTORS", 0, 1)] * 2 + [packet("ACK", 9)], "2 with descriptors; no keyframe of one"),
    ],
)
def test_no_candidate_has_its_reason(tmp_path: Path, packets: list[SimpleNamespace], reason: str) -> None:
    """A robot that hears nothing is not one whose keyframes resemble no other."""
    inspector = Inspector(RunFolder(fake_run.make(tmp_path).run))
    vars(inspector).update(_session=SimpleNamespace(packets=packets), _consensus=lambda topic, robot: [])
    assert reason in format_loop_closures(inspector.loop_closures())


def test_the_exchange_of_a_run_can_be_repeated_under_faults(small_run: Path, small_recording: Path) -> None:
    settings = load_config(RunConfig, small_run / "config.toml", [])
    checks = ["frames", "names", "closures", "silence", "solver"]
    result = team_faults.run(
        RunFolder(small_run),
        Recording(small_recording),
        settings.exchange,
        seed=settings.seed,
        checks=checks,
        seeds=1,
    )
    stated = json.loads((small_run / "metrics.json").read_text())["team"]["ate_rmse_m"]
    assert result["base"]["team_ate_rmse_m"] == pytest.approx(stated, abs=1e-9)
    rows = {row["case"]: row for row in result["rows"]}
    assert rows["silence"]["as_if_alone"]
    assert rows["silence"]["team_ate_rmse_m"] is None
    for case in ("frames", "names", "elimination"):
        assert result["worst"][case]["difference_m"] < 1e-6
        assert result["worst"][case]["apart"] == 0
    assert rows["closures"]["closures_measured"] > result["base"]["closures_measured"]
    assert rows["closures"]["false_closures_kept"] == 0
    assert "not together" in team_faults.format_table(result)


def test_what_the_images_allow_is_told_beside_the_error_of_the_team(
    small_run: Path, small_recording: Path
) -> None:
    config = load_config(RunConfig, small_run / "config.toml", []).frontend
    result = pose_reference.run(RunFolder(small_run), Recording(small_recording), config)
    metrics = json.loads((small_run / "metrics.json").read_text())
    stated = metrics["team"]["ate_rmse_m"]
    assert result["closures"] == metrics["team"]["inter_robot_loop_closures"] > 0
    rows = {row["poses"]: row for row in result["rows"]}
    assert rows["the run"]["team_ate_rmse_m"] == pytest.approx(stated, abs=1e-9)
    assert rows["the run"]["own_ate_rmse_m"] <= stated
    assert rows["the truth"]["team_ate_rmse_m"] == 0.0
    assert result["views"]["within"] > 0
    for start in ("images, from the run", "images, from the truth"):  # exact images lead to the truth
        assert rows[start]["team_ate_rmse_m"] < 0.002
        assert rows[start]["agreement_m"]["within"] < 0.002
    assert " the run |" in pose_reference.format_table(result)


def test_a_signed_packet_can_be_asked_for(small_run: Path, small_recording: Path, tmp_path: Path) -> None:
    """The signature is no part of what a packet says. Of the run only the exchange is done again."""
    settings = load_config(RunConfig, small_run / "config.toml", ["exchange.transport.signatures=ed25519"])
    logs = Recording(small_recording)
    (tmp_path / "robots").symlink_to(small_run / "robots")
    run_session(
        [agent_input(robot, logs.log(robot), tmp_path / "robots" / robot, settings) for robot in logs.robots],
        settings.exchange,
        seed=settings.seed,
        exchange_path=tmp_path / "exchange.mcap",
        consensus_path=tmp_path / "consensus.mcap",
    )
    inspector = Inspector(RunFolder(tmp_path))
    packets = read_session(tmp_path / "exchange.mcap").packets
    number = next(k for k, p in enumerate(packets) if p.kind_name == "EVIDENCE")
    facts = inspector.packet(number)
    assert facts["content"]["owner"] in ("alpha", "bravo")
    assert len(facts["content"]["gaussians"]) == 11
    assert facts["bytes"] == 34 + 8 + 1100 + 64
    state = next(k for k, p in enumerate(packets) if p.kind_name == "STATE")
    assert inspector.packet(state)["content"]["bytes_of_poses"] == 0
