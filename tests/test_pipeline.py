"""The whole job on a tiny team: determinism, firewall, replay, and the effect of what crosses the network."""

import json
import math
import os
import re
import shutil
import subprocess
import sys
import tomllib
from contextlib import suppress
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from duagc.converters.simulate.team import simulate
from duagc.pipeline.base.checkpoints import Checkpoints
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.base import dump_config, load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.evaluation import evaluate
from duagc.pipeline.evaluation.network import Session
from duagc.pipeline.evaluation.oracle import Gap, gap_to_oracle
from duagc.pipeline.evaluation.results import reason_of
from duagc.pipeline.exchange.record import read_session
from duagc.pipeline.exchange.session import run_session
from duagc.pipeline.experiments import pose_reference, team_faults
from duagc.pipeline.recording import Recording
from duagc.pipeline.replay import replay
from duagc.pipeline.report import write_report
from duagc.pipeline.runner import run
from duagc.pipeline.runs.digest import digest, digest_file, result_files
from duagc.pipeline.runs.folder import RunFolder
from duagc.pipeline.runs.session_file import read_session_result
from duagc.pipeline.steps import agent_input, fuse_robot
from duagc.pipeline.viewing.inspection import Inspector, format_facts, format_loop_closures
from tests.fixtures.commands import assert_one_line, duagc_here
from tests.fixtures.late_program import run_late

SMALL = (
    "frontend.mapping.max_gaussians=3000",
    "frontend.mapping.iterations=8",
    "frontend.mapping.final_iterations=8",
    "frontend.mapping.final_iterations_view=0",
    "exchange.max_rounds=400",
    "fusion.finetune.steps_per_view=2",
)
ROOT = Path(__file__).parents[1]


def quiet(line: str) -> None:
    """Say nothing."""


def make_run(recording: Path, out: Path, *overrides: str, workers: int = 2) -> Path:
    run(recording, out, load_config(RunConfig, overrides=[*SMALL, *overrides]), workers=workers, log=quiet)
    return out


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pipeline")


@pytest.fixture(scope="module")
def recording(folder: Path) -> Path:
    out = folder / "recording"
    simulate(out, robots=2, frames=20, size=(160, 120), seed=1, overlap=0.9, workers=1)
    return out


@cache
def unimportable() -> set[str]:
    """Open3D, and the modules of all optional packages that are installed."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    packages = {re.split(r"[\[<>=~]", line)[0] for lines in extras.values() for line in lines} - {"duagc"}
    installed = packages_distributions().items()
    modules = {module for module, names in installed if packages & {name.lower() for name in names}}
    return {"open3d", *filter(str.isidentifier, modules)}


@pytest.fixture(scope="module")
def bare(folder: Path) -> dict[str, str]:
    """An environment, for a process and all that it starts, with modules in front that cannot be imported."""
    (folder / "unimportable").mkdir()
    for module in unimportable():
        code = f"raise ModuleNotFoundError('no module named {module}')\n"
        (folder / "unimportable" / f"{module}.py").write_text(code)
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(folder / "unimportable"), str(ROOT)])}


@pytest.fixture(scope="module")
def finished(folder: Path, recording: Path, bare: dict[str, str]) -> Path:
    out = folder / "run"
    command = [sys.executable, "-c", "from duagc.pipeline.cli import main; main()", "run", str(recording)]
    settings = [word for line in SMALL for word in ("--set", line)]
    done = subprocess.run([*command, "--out", str(out), *settings], env=bare, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="module")
def other(folder: Path, recording: Path) -> tuple[Path, list[str]]:
    """The run again, and what it said: without ground truth, with one worker, in a program that imports numpy first."""
    blind = folder / "blind"
    shutil.copytree(recording, blind, ignore=shutil.ignore_patterns("*groundtruth*"))
    done = run_late(blind, folder / "run_blind", *SMALL)
    assert done.returncode == 0, done.stderr
    return folder / "run_blind", done.stdout.splitlines()


def robots_digests(run_folder: Path) -> dict[str, str]:
    return {
        p.as_posix(): digest_file(run_folder / p) for p in result_files(run_folder) if p.parts[0] == "robots"
    }


def exchanged_again(run_folder: Path, recording: Path, out: Path, *overrides: str) -> Path:
    """The robots of a run, prepared already, exchange and fuse again."""
    config = load_config(RunConfig, overrides=[*SMALL, *overrides])
    logs = {robot: Recording(recording).log(robot) for robot in Recording(recording).robots}
    for robot in logs:
        (out / "robots" / robot).mkdir(parents=True)
        for name in ("frontend.mcap", "information.mcap"):
            shutil.copy(run_folder / "robots" / robot / name, out / "robots" / robot / name)
    results = run_session(
        [agent_input(robot, log, out / "robots" / robot, config) for robot, log in logs.items()],
        config.exchange,
        seed=config.seed,
        exchange_path=out / "exchange.mcap",
        consensus_path=out / "consensus.mcap",
    )
    for robot, log in logs.items():
        fuse_robot(robot, log, out / "robots" / robot, results[robot], config=config, threads=2)
    return out


def test_the_team_meets_and_everything_is_written(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["team"]["robots_in_largest_component"] == 2
    assert metrics["exchange"]["matched_pairs"] > 0
    assert metrics["exchange"]["bytes_delivered"] > 0
    assert metrics["team"]["ate_rmse_m"] < 0.01
    assert metrics["consensus"]["gap_to_oracle_m"] < 1e-4  # ten times the tolerance at which the robots stop
    assert metrics["consensus"]["gap_to_oracle_rad"] < 1e-4
    assert 0 < metrics["consensus"]["gap_to_oracle_sigma_p99"] <= metrics["consensus"]["gap_to_oracle_sigma"]
    for name in (
        "report/index.html",
        "run.rrd",
        "manifest.json",
        "timing.json",
        "config.toml",
        "metrics.parquet",
    ):
        assert (finished / name).stat().st_size > 0


def test_the_job_needs_no_open3d_and_no_optional_package(bare: dict[str, str], finished: Path) -> None:
    """Nor did any process of the job that `finished` is, and that other tests repeat with everything installed."""
    for module in unimportable():
        done = subprocess.run(
            [sys.executable, "-c", f"import {module}"], env=bare, capture_output=True, text=True
        )
        assert f"no module named {module}" in done.stderr
    assert (finished / "manifest.json").exists()


def test_neither_workers_nor_ground_truth_change_a_bit(other: tuple[Path, list[str]], finished: Path) -> None:
    assert digest(other[0]) == digest(finished)
    metrics = json.loads((other[0] / "metrics.json").read_text())
    assert metrics["team"]["ate_rmse_m"] is None
    assert reason_of(metrics["reasons"], "team.ate_rmse_m")


def test_a_program_that_imports_numpy_first_gets_the_results_of_the_command(
    other: tuple[Path, list[str]], finished: Path
) -> None:
    run_folder, lines = other
    assert lines[0].startswith("front end and information: 2 robots")
    assert digest(run_folder) == digest(finished)
    manifests = [json.loads((path / "manifest.json").read_text()) for path in (run_folder, finished)]
    assert manifests[0]["outputs"] == manifests[1]["outputs"]


def test_each_robot_replays_bit_for_bit(recording: Path, finished: Path) -> None:
    comparisons = replay(finished, recording, ["alpha", "bravo"], quiet)
    assert {c.robot for c in comparisons} == {"alpha", "bravo"}
    assert [c.name for c in comparisons if not c.equal] == []


def test_a_changed_log_is_mentioned(folder: Path, recording: Path) -> None:
    changed = folder / "other_log"
    shutil.copytree(recording, changed)
    shutil.copy(changed / "alpha.mcap", changed / "bravo.mcap")  # a sound log, but another one
    said: list[str] = []
    with pytest.raises(DuagError, match="is the log of alpha, expected that of bravo"):
        run(
            changed,
            folder / "run_changed",
            load_config(RunConfig, overrides=SMALL),
            workers=1,
            log=said.append,
        )
    assert [line for line in said if "warning" in line and "bravo.mcap" in line]


def test_a_damaged_log_stops_the_run_with_one_line(folder: Path, recording: Path) -> None:
    damaged = folder / "damaged"
    shutil.copytree(recording, damaged)
    log = damaged / "bravo.mcap"
    content = bytearray(log.read_bytes())
    content[len(content) // 2] ^= 1
    log.write_bytes(content)
    with pytest.raises(DuagError, match=r"bravo\.mcap") as caught:
        make_run(damaged, folder / "run_damaged", workers=1)
    assert "\n" not in str(caught.value)
    assert not list(folder.glob("run_damaged*"))


def test_a_run_without_one_of_its_results_has_no_digest(folder: Path, finished: Path) -> None:
    damaged = folder / "incomplete"
    shutil.copytree(finished, damaged)
    for name in ("exchange.mcap", "robots/bravo/odometry.tum"):
        (damaged / name).rename(folder / "aside")
        with pytest.raises(DuagError, match=name):
            digest(damaged)
        (folder / "aside").rename(damaged / name)
    assert digest(damaged) == digest(finished)


def test_a_trajectory_that_was_changed_is_not_evaluated(
    folder: Path, finished: Path, recording: Path
) -> None:
    changed = folder / "changed_run"
    shutil.copytree(finished, changed)
    path = changed / "robots" / "alpha" / "trajectory.tum"
    path.write_text(path.read_text().replace("0.", "0.1", 1))
    with pytest.raises(DuagError, match=r"trajectory\.tum: has digest .* as in manifest\.json"):
        evaluate(changed, recording, threads=1)
    assert (changed / "metrics.json").read_bytes() == (finished / "metrics.json").read_bytes()


def test_the_log_of_another_robot_is_refused(folder: Path, recording: Path) -> None:
    mixed = folder / "mixed"
    shutil.copytree(recording, mixed)
    shutil.copyfile(mixed / "alpha.mcap", mixed / "bravo.mcap")
    with pytest.raises(DuagError, match=r"bravo\.mcap: is the log of alpha, expected that of bravo"):
        make_run(mixed, folder / "run_mixed", workers=1)
    assert not list(folder.glob("run_mixed*"))


def test_nothing_delivered_is_nothing_said(folder: Path, recording: Path, finished: Path) -> None:
    silent = make_run(recording, folder / "run_silent", "exchange.link.enabled=false", workers=1)
    deaf = exchanged_again(silent, recording, folder / "run_deaf", "exchange.link.loss_probability=1.0")
    assert robots_digests(silent) == robots_digests(deaf)
    changed = robots_digests(finished)
    own = robots_digests(silent)
    for robot in ("alpha", "bravo"):
        assert own[f"robots/{robot}/trajectory.tum"] == own[f"robots/{robot}/odometry.tum"]
        assert changed[f"robots/{robot}/frontend.mcap"] == own[f"robots/{robot}/frontend.mcap"]
        assert changed[f"robots/{robot}/odometry.tum"] == own[f"robots/{robot}/odometry.tum"]
        assert changed[f"robots/{robot}/fused.ply"] != own[f"robots/{robot}/fused.ply"]
    assert changed["robots/bravo/trajectory.tum"] != own["robots/bravo/trajectory.tum"]


def test_rejected_matches_are_no_gap_to_the_centralized_answer(
    folder: Path, recording: Path, finished: Path
) -> None:
    """A third of the matches is false; what the robots reject is part of nobody's problem, and is counted."""
    wrong = "exchange.injection.false_matches=0.33"
    out = exchanged_again(finished, recording, folder / "run_false_matches", wrong)
    (out / "config.toml").write_text(dump_config(load_config(RunConfig, overrides=[*SMALL, wrong])))
    session = Session(RunFolder(out))
    section = session.consensus_section()
    assert 0.1 < section["rejected_matches_share"] < 0.4
    assert section["gap_to_oracle_sigma_p99"] < 0.05
    careless = RunFolder(out)  # an oracle that takes what nobody took
    for robot in careless.robots.values():
        vars(robot)["rejected_matches"] = {}
    gap = gap_to_oracle(careless, session.loop_closures, session.pairs)
    assert isinstance(gap, Gap)
    assert isinstance(gap.sigma_p99, float)
    assert gap.sigma_p99 > 0.3


def test_what_happened_can_be_asked_for(finished: Path) -> None:
    """A Gaussian's evidence is where its packets say, and the round says what was on the air."""
    inspector = Inspector(RunFolder(finished))
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
    for ask, complaint in (
        (lambda: inspector.gaussian("zulu", 1), "no robot 'zulu', expected one of alpha, bravo"),
        (lambda: inspector.gaussian("alpha", 1 << 40), "no Gaussian 1099511627776 in the map of alpha"),
        (lambda: inspector.packet(1 << 40), "found --packet"),
        (lambda: inspector.round(1 << 40), "found --round"),
    ):
        with pytest.raises(DuagError, match=complaint):
            ask()


def test_every_candidate_of_a_run_can_be_asked_for_with_its_reason(finished: Path) -> None:
    inspector = Inspector(RunFolder(finished))
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


def test_the_exchange_of_a_run_can_be_repeated_under_faults(finished: Path, recording: Path) -> None:
    settings = load_config(RunConfig, finished / "config.toml", [])
    checks = ["frames", "names", "closures", "silence", "solver"]
    result = team_faults.run(
        RunFolder(finished),
        Recording(recording),
        settings.exchange,
        seed=settings.seed,
        checks=checks,
        seeds=1,
    )
    stated = json.loads((finished / "metrics.json").read_text())["team"]["ate_rmse_m"]
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


def test_what_the_images_allow_is_told_beside_the_error_of_the_team(finished: Path, recording: Path) -> None:
    config = load_config(RunConfig, finished / "config.toml", []).frontend
    result = pose_reference.run(RunFolder(finished), Recording(recording), config)
    metrics = json.loads((finished / "metrics.json").read_text())
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


def test_a_signed_packet_can_be_asked_for(finished: Path, recording: Path, tmp_path: Path) -> None:
    """The signature is no part of what a packet says. Of the run only the exchange is done again."""
    settings = load_config(RunConfig, finished / "config.toml", ["exchange.transport.signatures=ed25519"])
    logs = Recording(recording)
    (tmp_path / "robots").symlink_to(finished / "robots")
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


def again(recording: Path, out: Path, *options: str) -> tuple[int, list[str], str]:
    """`duagc run` as `finished` was made: exit code, what it said, and what it printed."""
    settings = [word for line in SMALL for word in ("--set", line)]
    result = duagc_here("run", recording, "--out", out, *settings, *options)
    return result.returncode, result.stderr.splitlines(), result.stdout


def executed(run_folder: Path) -> list[str]:
    rows = json.loads((run_folder / "timing.json").read_text())["stages"]
    return [name for name, row in rows.items() if row["executed"]]


def test_a_run_that_is_there_already_is_up_to_date(recording: Path, finished: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*")}
    assert len(executed(finished)) == 10
    code, lines, printed = again(recording, finished)
    assert (code, lines[0]) == (0, f"duagc: {finished}: up to date")
    assert [line.split()[1] for line in lines[-4:]] == ["fusion", "evaluation", "report", "rrd"]
    assert "refined.ply" in printed
    assert {path: path.stat().st_mtime_ns for path in finished.rglob("*")} == before


def test_a_damaged_result_of_a_run_is_taken_from_the_store(
    folder: Path, recording: Path, finished: Path
) -> None:
    damaged = folder / "damaged_run"
    shutil.copytree(finished, damaged)
    (damaged / "robots" / "alpha" / "odometry.tum").write_text("nothing")
    (damaged / "notes").mkdir()
    (damaged / "notes" / "mine.txt").write_text("mine")
    code, lines, _ = again(recording, damaged)
    assert code == 0
    assert (damaged / "notes" / "mine.txt").read_text() == "mine"
    assert "odometry.tum: is not what was computed; taken from the store" in lines[0]
    assert digest(damaged) == digest(finished)
    assert executed(damaged) == []
    (damaged / "metrics.json").write_text("{}")  # as `duagc evaluate --own-longer` writes it again
    assert "up to date" in again(recording, damaged)[1][0]
    (damaged / "manifest.json").write_text('{"schema": 1, "stages": {"exchange": "mine"}}')
    code, lines, _ = again(recording, damaged)
    assert code == 1
    assert "exists already, and exchange differs" in lines[0]


def test_another_consensus_computes_nothing_upstream_and_going_back_nothing_at_all(
    folder: Path, recording: Path, finished: Path
) -> None:
    other = "--set=exchange.link.loss_probability=0.2"
    code, _, printed = again(recording, finished, other, "--why")
    assert code == 0
    assert printed.splitlines() == [
        "frontend of alpha: in the store",
        "information of alpha: in the store",
        "frontend of bravo: in the store",
        "information of bravo: in the store",
        "exchange: computed: settings: exchange.link.loss_probability 0.0 -> 0.2",
        "fusion, evaluation, report, rrd: computed unless the results before turn out as they were",
    ]
    code, lines, _ = again(recording, finished, other)
    assert code == 1
    assert "exchange differs (settings: exchange.link.loss_probability 0.0 -> 0.2)" in lines[0]
    again(recording, folder / "run_other", other, "--until", "exchange")
    assert executed(folder / "run_other") == ["exchange"]
    code, lines, _ = again(recording, folder / "run_other", "--force")
    assert code == 0
    assert executed(folder / "run_other") == []
    assert digest(folder / "run_other") == digest(finished)
    for name in ("metrics.json", "report/index.html"):
        assert (folder / "run_other" / name).read_bytes() == (finished / name).read_bytes()


def test_metrics_and_report_can_be_left_out_and_come_later(
    folder: Path, recording: Path, finished: Path
) -> None:
    out = folder / "run_bare"
    code, _, printed = again(recording, out, "--no-evaluation")
    assert code == 0
    assert executed(out) == ["rrd"]
    assert "refined.ply" in printed
    assert not (out / "metrics.json").exists()
    assert not (out / "report").exists()
    assert digest(out) == digest(finished)
    assert "up to date" in again(recording, out, "--no-evaluation")[1][0]
    assert again(recording, out)[0] == 0
    assert executed(out) == []
    assert "up to date" in again(recording, out, "--no-evaluation")[1][0]
    for name in ("metrics.json", "metrics.parquet", "report/index.html"):
        assert (out / name).read_bytes() == (finished / name).read_bytes()


@pytest.mark.slow
def test_a_run_of_three_robots_is_the_same_with_one_two_and_four_workers(tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    simulate(recording, robots=3, frames=12, size=(160, 120), seed=5, overlap=0.9, workers=1)
    runs = [make_run(recording, tmp_path / f"run{workers}", workers=workers) for workers in (1, 2, 4)]
    pages = [write_report(runs[0], recording, workers=workers).read_bytes() for workers in (1, 2, 4)]
    assert len(set(pages)) == 1
    for made in runs[1:]:
        assert digest(made) == digest(runs[0])
        for name in ("metrics.json", "metrics.parquet"):
            assert (made / name).read_bytes() == (runs[0] / name).read_bytes()


def test_a_fusion_that_is_killed_goes_on_with_the_same_bits(
    folder: Path, recording: Path, finished: Path
) -> None:
    class KilledError(Exception):
        """In place of a signal."""

    def kill(part: str, done: int, total: int, shown: object) -> None:
        if (part, done) == ("training", total // 2):
            raise KilledError

    robot = folder / "killed_fusion" / "alpha"
    shutil.copytree(finished / "robots" / "alpha", robot)
    log, result = Recording(recording).log("alpha"), read_session_result(robot / "session.npz")
    config, said = load_config(RunConfig, overrides=list(SMALL)), list[str]()
    for report in (kill, None):
        place = folder / "killed_fusion" / "checkpoints"
        save = Checkpoints(place, every_s=0.0, largest_share=math.inf, say=said.append, report=report)
        with suppress(KilledError):
            fuse_robot("alpha", log, robot, result, config=config, threads=2, checkpoints=save)
            assert report is None
    assert len(said) == 1
    assert said[0].startswith("training: goes on at ")
    for name in ("fused.mcap", "fused.ply", "refined.ply"):
        assert digest_file(robot / name) == digest_file(finished / "robots" / "alpha" / name)


def test_stages_have_names(recording: Path, folder: Path) -> None:
    for option in ("--from", "--until"):
        assert_one_line(
            duagc_here("run", recording, "--out", folder / "none", option, "fussion"), "perhaps fusion"
        )
    assert_one_line(
        duagc_here("run", recording, "--out", folder / "none", "--from", "fusion", "--until", "exchange"),
        "comes after --until exchange",
    )
    assert duagc_here("run", recording, "--out", folder / "none", "--no-cache", "--why").returncode == 2
