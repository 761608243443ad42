"""The whole job on a tiny team: determinism, firewall, replay, and the effect of what crosses the network."""

import json
import math
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from duagc.converters.simulate.team import simulate
from duagc.pipeline.base.checkpoints import Checkpoints
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.base import dump_config, load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.evaluation import evaluate
from duagc.pipeline.evaluation.network import Session
from duagc.pipeline.evaluation.oracle import Gap, gap_to_oracle
from duagc.pipeline.evaluation.pixel_deviation import stated_in_world
from duagc.pipeline.evaluation.results import reason_of
from duagc.pipeline.exchange.session import run_session
from duagc.pipeline.recording import Recording
from duagc.pipeline.replay import replay
from duagc.pipeline.report import write_report
from duagc.pipeline.runner import run
from duagc.pipeline.runs.digest import digest, digest_file, result_files
from duagc.pipeline.runs.folder import RobotRun, RunFolder
from duagc.pipeline.runs.session_file import read_session_result
from duagc.pipeline.steps import agent_input, fuse_robot
from tests.fixtures.late_program import run_late
from tests.fixtures.small_run import SMALL, make_run, quiet, unimportable

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def other(small_runs: Path, small_recording: Path) -> tuple[Path, list[str]]:
    """The run again, and what it said: without ground truth, with one worker, in a program that imports numpy first."""
    blind = small_runs / "blind"
    shutil.copytree(small_recording, blind, ignore=shutil.ignore_patterns("*groundtruth*"))
    done = run_late(blind, small_runs / "run_blind", *SMALL)
    assert done.returncode == 0, done.stderr
    return small_runs / "run_blind", done.stdout.splitlines()


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


def test_the_team_meets_and_everything_is_written(small_run: Path) -> None:
    metrics = json.loads((small_run / "metrics.json").read_text())
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
        assert (small_run / name).stat().st_size > 0


def test_the_job_needs_no_open3d_and_no_optional_package(bare: dict[str, str], small_run: Path) -> None:
    """Nor did any process of the job that `small_run` is, and that other tests repeat with everything installed."""
    for module in unimportable():
        done = subprocess.run(
            [sys.executable, "-c", f"import {module}"], env=bare, capture_output=True, text=True
        )
        assert f"no module named {module}" in done.stderr
    assert (small_run / "manifest.json").exists()


def test_neither_workers_nor_ground_truth_change_a_bit(
    other: tuple[Path, list[str]], small_run: Path
) -> None:
    assert digest(other[0]) == digest(small_run)
    metrics = json.loads((other[0] / "metrics.json").read_text())
    assert metrics["team"]["ate_rmse_m"] is None
    assert reason_of(metrics["reasons"], "team.ate_rmse_m")


def test_a_program_that_imports_numpy_first_gets_the_results_of_the_command(
    other: tuple[Path, list[str]], small_run: Path
) -> None:
    run_folder, lines = other
    assert lines[0].startswith("front end and information: 2 robots")
    assert digest(run_folder) == digest(small_run)
    manifests = [json.loads((path / "manifest.json").read_text()) for path in (run_folder, small_run)]
    assert manifests[0]["outputs"] == manifests[1]["outputs"]


def test_each_robot_replays_bit_for_bit(small_recording: Path, small_run: Path) -> None:
    comparisons = replay(small_run, small_recording, ["alpha", "bravo"], quiet)
    assert {c.robot for c in comparisons} == {"alpha", "bravo"}
    assert [c.name for c in comparisons if not c.equal] == []


def test_a_changed_log_is_mentioned(small_runs: Path, small_recording: Path) -> None:
    changed = small_runs / "other_log"
    shutil.copytree(small_recording, changed)
    shutil.copy(changed / "alpha.mcap", changed / "bravo.mcap")  # a sound log, but another one
    said: list[str] = []
    with pytest.raises(DuagError, match="is the log of alpha, expected that of bravo"):
        run(
            changed,
            small_runs / "run_changed",
            load_config(RunConfig, overrides=SMALL),
            workers=1,
            log=said.append,
        )
    assert [line for line in said if "warning" in line and "bravo.mcap" in line]


def test_a_damaged_log_stops_the_run_with_one_line(small_runs: Path, small_recording: Path) -> None:
    damaged = small_runs / "damaged"
    shutil.copytree(small_recording, damaged)
    log = damaged / "bravo.mcap"
    content = bytearray(log.read_bytes())
    content[len(content) // 2] ^= 1
    log.write_bytes(content)
    with pytest.raises(DuagError, match=r"bravo\.mcap") as caught:
        make_run(damaged, small_runs / "run_damaged", workers=1)
    assert "\n" not in str(caught.value)
    assert not list(small_runs.glob("run_damaged*"))


def test_a_run_without_one_of_its_results_has_no_digest(small_runs: Path, small_run: Path) -> None:
    damaged = small_runs / "incomplete"
    shutil.copytree(small_run, damaged)
    for name in ("exchange.mcap", "robots/bravo/odometry.tum"):
        (damaged / name).rename(small_runs / "aside")
        with pytest.raises(DuagError, match=name):
            digest(damaged)
        (small_runs / "aside").rename(damaged / name)
    assert digest(damaged) == digest(small_run)


def test_a_trajectory_that_was_changed_is_not_evaluated(
    small_runs: Path, small_run: Path, small_recording: Path
) -> None:
    changed = small_runs / "changed_run"
    shutil.copytree(small_run, changed)
    path = changed / "robots" / "alpha" / "trajectory.tum"
    path.write_text(path.read_text().replace("0.", "0.1", 1))
    with pytest.raises(DuagError, match=r"trajectory\.tum: has digest .* as in manifest\.json"):
        evaluate(changed, small_recording, threads=1)
    assert (changed / "metrics.json").read_bytes() == (small_run / "metrics.json").read_bytes()


def test_measuring_a_run_again_in_one_process_gives_the_same_file(
    small_runs: Path, small_run: Path, small_recording: Path
) -> None:
    """The run itself matched features while its robots exchanged, and measured each in a process of its own."""
    again = small_runs / "measured_again"
    shutil.copytree(small_run, again)
    (again / "metrics.json").unlink()
    evaluate(again, small_recording, threads=1, progress=False)
    assert (again / "metrics.json").read_bytes() == (small_run / "metrics.json").read_bytes()


def test_the_log_of_another_robot_is_refused(small_runs: Path, small_recording: Path) -> None:
    mixed = small_runs / "mixed"
    shutil.copytree(small_recording, mixed)
    shutil.copyfile(mixed / "alpha.mcap", mixed / "bravo.mcap")
    with pytest.raises(DuagError, match=r"bravo\.mcap: is the log of alpha, expected that of bravo"):
        make_run(mixed, small_runs / "run_mixed", workers=1)
    assert not list(small_runs.glob("run_mixed*"))


def test_nothing_delivered_is_nothing_said(small_runs: Path, small_recording: Path, small_run: Path) -> None:
    off = "exchange.link.enabled=false"
    # the processes of a run that is not evaluated read ahead for their fusion
    silent = make_run(small_recording, small_runs / "run_silent", off, workers=2, until="fusion")
    deaf = exchanged_again(
        silent, small_recording, small_runs / "run_deaf", "exchange.link.loss_probability=1.0"
    )
    assert robots_digests(silent) == robots_digests(deaf)
    changed = robots_digests(small_run)
    own = robots_digests(silent)
    for robot in ("alpha", "bravo"):
        assert own[f"robots/{robot}/trajectory.tum"] == own[f"robots/{robot}/odometry.tum"]
        assert changed[f"robots/{robot}/frontend.mcap"] == own[f"robots/{robot}/frontend.mcap"]
        assert changed[f"robots/{robot}/odometry.tum"] == own[f"robots/{robot}/odometry.tum"]
        assert changed[f"robots/{robot}/fused.ply"] != own[f"robots/{robot}/fused.ply"]
    assert changed["robots/bravo/trajectory.tum"] != own["robots/bravo/trajectory.tum"]


def test_rejected_matches_are_no_gap_to_the_centralized_answer(
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    """A third of the matches is false; what the robots reject is part of nobody's problem, and is counted."""
    wrong = "exchange.injection.false_matches=0.33"
    out = exchanged_again(small_run, small_recording, small_runs / "run_false_matches", wrong)
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
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    class KilledError(Exception):
        """In place of a signal."""

    def kill(part: str, done: int, total: int, shown: object) -> None:
        if (part, done) == ("training", total // 2):
            raise KilledError

    robot = small_runs / "killed_fusion" / "alpha"
    shutil.copytree(small_run / "robots" / "alpha", robot)
    log, result = Recording(small_recording).log("alpha"), read_session_result(robot / "session.npz")
    config, said = load_config(RunConfig, overrides=list(SMALL)), list[str]()
    for report in (kill, None):
        place = small_runs / "killed_fusion" / "checkpoints"
        save = Checkpoints(place, every_s=0.0, largest_share=math.inf, say=said.append, report=report)
        with suppress(KilledError):
            fuse_robot("alpha", log, robot, result, config=config, threads=2, checkpoints=save)
            assert report is None
    assert len(said) == 1
    assert said[0].startswith("training: goes on at ")
    for name in ("fused.mcap", "fused.ply", "refined.ply"):
        assert digest_file(robot / name) == digest_file(small_run / "robots" / "alpha" / name)


def test_something_is_stated_of_every_gaussian_of_a_final_map(
    small_runs: Path, small_recording: Path, small_run: Path
) -> None:
    folder = small_runs / "finer" / "alpha"
    shutil.copytree(small_run / "robots" / "alpha", folder)
    log, result = Recording(small_recording).log("alpha"), read_session_result(folder / "session.npz")
    config = load_config(
        RunConfig, overrides=[*SMALL, "fusion.finer=1.0", "fusion.finetune.steps_per_view=1"]
    )
    fuse_robot("alpha", log, folder, result, config=config, threads=2)
    robot = RobotRun("alpha", folder)
    final, fused = robot.refined_map, robot.fused_map.information
    assert final is not None
    assert fused is not None
    taken = final.information
    assert taken is not None, "bravo saw nothing finer"
    assert not np.isin(taken.ids, fused.ids).any()
    assert np.isin(final.gaussians.ids, np.concatenate([fused.ids, taken.ids])).all()
    sigma_m = stated_in_world(robot, final).sigma_m[np.isin(final.gaussians.ids, taken.ids)]
    assert np.isfinite(sigma_m).all()
    assert taken.stated_scale == fused.stated_scale
