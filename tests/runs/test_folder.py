"""A run that is half there, or of another version, is one line before any work."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.evaluation import evaluate
from duagc.pipeline.preparation import way
from duagc.pipeline.replay import replay
from duagc.pipeline.report import write_report
from duagc.pipeline.runs.digest import ROBOT_RESULTS, TEAM_RESULTS, digest, result_files
from duagc.pipeline.runs.folder import RunFolder
from tests.fixtures import fake_run
from tests.fixtures.commands import assert_one_line, duagc_here


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> fake_run.FakeRun:
    fake = fake_run.make(tmp_path_factory.mktemp("fake"))
    evaluate(fake.run, fake.recording, progress=False)
    return fake


def remove_exchange(run: Path) -> None:
    (run / "exchange.mcap").unlink()


def remove_robot(run: Path) -> None:
    digests = {"alpha": "", "bravo": ""}
    (run / "manifest.json").write_text(json.dumps({"schema": 1, "inputs": digests}))
    shutil.rmtree(run / "robots" / "bravo")


def make_newer(run: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps(metrics | {"schema": 99}))


def cut_table(run: Path) -> None:
    (run / "metrics.parquet").write_bytes((run / "metrics.parquet").read_bytes()[:100])


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (remove_exchange, "exchange.mcap: not found"),
        (remove_robot, "robots/bravo: no such folder, expected the results that manifest.json names"),
        (make_newer, "metrics.json: schema is 99, expected 2"),
        (cut_table, "metrics.parquet: is no Parquet file that can be read"),
    ],
)
def test_a_report_is_of_a_whole_run(
    whole: fake_run.FakeRun, tmp_path: Path, damage: Callable[[Path], None], complaint: str
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole.run, run)
    damage(run)
    with pytest.raises(DuagError, match=complaint):
        write_report(run, whole.recording)
    assert not (run / "report").exists()


def test_a_replay_misses_results_before_it_computes_any(whole: fake_run.FakeRun, tmp_path: Path) -> None:
    run, said = tmp_path / "run", list[str]()
    shutil.copytree(whole.run, run)
    with pytest.raises(DuagError, match=r"robots/alpha/fused.ply: No such file"):
        replay(run, whole.recording, ["alpha"], said.append)
    remove_exchange(run)
    with pytest.raises(DuagError, match=r"exchange.mcap: not found; `duagc run` without --until writes it"):
        replay(run, whole.recording, ["alpha"], said.append)
    assert said == []


@pytest.mark.parametrize(
    ("command", "name"),
    [
        (("inspect", "--loop-closures"), "consensus.mcap"),
        (("inspect", "--round", "0"), "exchange.mcap"),
        (("evaluate",), "robots/alpha/trajectory.tum"),
        (("export", "--out", "{tmp}/maps"), "robots/alpha/fused.mcap"),
    ],
)
def test_a_run_that_was_stopped_before_a_stage_says_what_goes_on(
    whole: fake_run.FakeRun, tmp_path: Path, command: tuple[str, ...], name: str
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole.run, run)
    (run / name).unlink()
    words = [word.format(tmp=tmp_path) for word in command[1:]]
    there = ("--recording", whole.recording) if command[0] == "evaluate" else ()
    result = duagc_here(command[0], run, *words, *there)
    assert_one_line(result, f"{name}: not found; `duagc run` without --until writes it")


def test_a_run_that_is_not_there_says_so(tmp_path: Path) -> None:
    with pytest.raises(
        DuagError, match=r"manifest.json: no such file, expected the manifest of a finished run"
    ):
        _ = RunFolder(tmp_path / "nowhere").recording


def test_a_run_below_a_link_to_another_disk_finds_its_recording(tmp_path: Path) -> None:
    recording, disk = tmp_path / "project" / "recordings" / "room", tmp_path / "disk" / "deep" / "outputs"
    recording.mkdir(parents=True)
    disk.mkdir(parents=True)
    outputs = tmp_path / "project" / "outputs"
    outputs.symlink_to(disk)
    (outputs / "run").mkdir()
    named = {"schema": 1, "recording": way(outputs / "run", recording)}
    (outputs / "run" / "manifest.json").write_text(json.dumps(named))
    for folder in (outputs, disk):
        assert RunFolder(folder / "run").recording == recording.resolve()


def read_metrics(run: RunFolder) -> object:
    return run.metrics


def read_timing(run: RunFolder) -> object:
    return run.timing


def read_calibration(run: RunFolder) -> object:
    return run.calibration


def test_a_time_of_somebody_else_is_of_the_stage_that_its_label_names(tmp_path: Path) -> None:
    row = {"wall_s": 2.0, "cpu_s": 3.0, "peak_rss_mb": 100.0}
    stored = {"stage": "exchange", "robot": None, "executed": False}
    stages = {"frontend.alpha": row, "exchange": row | stored}
    (tmp_path / "timing.json").write_text(json.dumps({"stages": stages}))
    assert RunFolder(tmp_path).timing == {
        "frontend.alpha": row | {"stage": "frontend", "robot": "alpha", "executed": True},
        "exchange": row | stored,
    }


@pytest.mark.parametrize(
    ("name", "content", "read", "complaint"),
    [
        ("timing.json", {"stages": []}, read_timing, "found no table of wall_s"),
        ("timing.json", {"stages": {"exchange": {"wall_s": "1"}}}, read_timing, "found no table of wall_s"),
        ("metrics.json", {"schema": 2, "a": 1}, read_metrics, "found no table robots"),
        (
            "manifest.json",
            {"calibration": {"cameras": [1]}},
            read_calibration,
            r"calibration\.cameras has no summaries",
        ),
        ("manifest.json", {"calibration": {"cameras": 1}}, read_calibration, r"calibration\.cameras has no"),
    ],
)
def test_what_somebody_wrote_into_a_run_is_one_line(
    tmp_path: Path, name: str, content: object, read: Callable[[RunFolder], object], complaint: str
) -> None:
    (tmp_path / name).write_text(json.dumps(content))
    with pytest.raises(DuagError, match=f"{name}: {complaint}"):
        read(RunFolder(tmp_path))


def put(metrics: dict[str, Any], name: str, value: object) -> None:
    *tables, last = name.split(".")
    for table in tables:
        metrics = metrics[table]
    if value is None:
        del metrics[last]
    else:
        metrics[last] = value


@pytest.mark.parametrize(
    ("name", "value", "complaint"),
    [
        ("team", [1], "found no table team"),
        ("team.robots", None, "team.robots: found none"),
        ("robots.alpha", 3, "robots.alpha: found a int, expected a table"),
        ("robots.alpha.rendering", None, "robots.alpha.rendering: found none"),
        ("rendering.own.held_out", [], "rendering.own.held_out: found a list, expected a table"),
        (
            "rendering.own.held_out.psnr_db",
            "a",
            "rendering.own.held_out.psnr_db: found a str, expected a number",
        ),
        ("rendering.own", None, "rendering.own: found none"),
        ("robots.alpha", None, "robots.alpha: found none"),
        ("exchange.bytes_sent", None, "exchange.bytes_sent: found none"),
        ("protocol.initial_relative_poses", None, "protocol.initial_relative_poses: found none"),
    ],
)
def test_no_report_of_damaged_metrics(
    whole: fake_run.FakeRun, tmp_path: Path, name: str, value: object, complaint: str
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole.run, run)
    path = run / "metrics.json"
    metrics = json.loads(path.read_text())
    put(metrics, name, value)
    path.write_text(json.dumps(metrics))
    with pytest.raises(DuagError, match=rf"run/metrics\.json: {complaint}"):
        write_report(run, whole.recording)


def test_a_run_that_lacks_a_whole_robot_has_no_digest(whole: fake_run.FakeRun, tmp_path: Path) -> None:
    for robot in ("alpha", "bravo"):
        for name in ROBOT_RESULTS:
            path = tmp_path / "run" / "robots" / robot / name
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(whole.run / "exchange.mcap", path)
    for name in TEAM_RESULTS:
        shutil.copy(whole.run / "exchange.mcap", tmp_path / "run" / name)
    outputs = {path.as_posix(): "" for path in result_files(tmp_path / "run")}
    (tmp_path / "run" / "manifest.json").write_text(json.dumps({"outputs": outputs}))
    assert len(digest(tmp_path / "run")) == 64
    shutil.rmtree(tmp_path / "run" / "robots" / "bravo")
    with pytest.raises(DuagError, match=r"robots/bravo/.*: not found, expected every result"):
        digest(tmp_path / "run")
    (tmp_path / "run" / "manifest.json").write_text('{"outputs": []}')
    with pytest.raises(DuagError, match=r"manifest\.json: is damaged"):
        digest(tmp_path / "run")
