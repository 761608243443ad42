"""A run that is half there, or of another version, is one line before any work."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.evaluation import evaluate
from duagc.pipeline.preparation import way
from duagc.pipeline.replay import replay
from duagc.pipeline.report import write_report
from duagc.pipeline.runs.folder import RunFolder
from tests.fixtures import fake_run


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
    with pytest.raises(DuagError, match=r"exchange.mcap: No such file"):
        replay(run, whole.recording, ["alpha"], said.append)
    assert said == []


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
