"""What is not what it should be is refused in one line, and nothing of the user's is replaced."""

import json
import math
import shutil
from pathlib import Path

import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import new_file
from duagc.pipeline.comparison.compare import compare
from duagc.pipeline.experiments.carry_out import read_result
from duagc.pipeline.runs.digest import digest, digest_file
from duagc.pipeline.viewing.rerun_view import view
from tests.fixtures import fake_run
from tests.fixtures.commands import assert_one_line, duagc_here


@pytest.fixture
def fake(tmp_path: Path) -> fake_run.FakeRun:
    return fake_run.make(tmp_path / "fake")


def state(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def named_in_manifest(fake: fake_run.FakeRun) -> None:
    """The manifest of a real run has the digests of its logs."""
    path = fake.run / "manifest.json"
    manifest = json.loads(path.read_text()) if path.is_file() else {"schema": 1}
    manifest["inputs"] = {
        robot: digest_file(fake.recording / f"{robot}.mcap") for robot in ("alpha", "bravo")
    }
    path.write_text(json.dumps(manifest))


@pytest.mark.parametrize("command", ["evaluate", "report", "replay", "view"])
def test_another_recording_is_not_that_of_a_run(fake, tmp_path, command) -> None:
    named_in_manifest(fake)
    (fake.run / "run.rrd").unlink(missing_ok=True)
    other = tmp_path / "other"
    shutil.copytree(fake.recording, other)
    shutil.copy(other / "alpha.mcap", other / "bravo.mcap")
    before = state(fake.run)  # recording.json still has the digests of before
    words = ["--save", str(tmp_path / "x.rrd")] if command == "view" else []
    result = duagc_here(command, fake.run, "--recording", other, *words)
    assert_one_line(result, "bravo.mcap: has digest", "was made of")
    assert state(fake.run) == before


@pytest.mark.parametrize(
    "words",
    [
        ("golden", "update", "{run}", "{recording}/recording.json"),
        ("golden", "update", "{recording}", "{tmp}/golden.json"),
        ("golden", "update", "{run}", "{run}/manifest.json"),
        ("view", "{recording}", "--save", "{recording}/alpha.mcap"),
        ("view", "{recording}", "--save", ""),
        ("view", "{recording}", "--screenshot", "{tmp}/nothing/x.png"),
        ("recover", "{recording}/alpha.mcap", "--out", "{recording}/alpha.mcap", "--force"),
        ("simulate", "--out", "{tmp}/sim", "--preview", "{tmp}/mine.png"),
        ("info", "{tmp}/nested"),
        ("run", "{recording}", "--out", "{tmp}/run", "--set", "frontend.mapping.rates.means=nan"),
        ("run", "{recording}", "--out", "{tmp}/run", "--set", "seed=3\nfrontend=7"),
        ("run", "{recording}", "--out", "{tmp}/run", "--set", "frontend=" + 3000 * "["),
        ("run", "{recording}", "--out", "{tmp}/run", "--set", "frontend.mapping.window=-1"),
        ("run", "{recording}", "--out", "{tmp}/run", "--set", "frontend.tracking.strides=[0]"),
        ("run", "{recording}", "--out", "{tmp}/run", "--set", "frontend.tracking.registration.iterations=[]"),
        ("run", "{recording}", "--out", "{tmp}/run", "--set", f"frontend.mapping.iterations={10**24}"),
        ("run", "{recording}", "--out", "{tmp}/mine.png/run"),
        ("batch", "{tmp}/mine.png", "--out", "{tmp}/b"),
        ("experiment", "run", "h1_team", "--out", "{tmp}/e", "--store", "{tmp}/mine.png"),
    ],
    ids=lambda words: " ".join(words)[:60],
)
def test_nothing_of_the_user_is_replaced(fake, tmp_path, words) -> None:
    named_in_manifest(fake)
    (tmp_path / "mine.png").write_bytes(b"a picture")
    before = state(tmp_path)
    said = (word.format(tmp=tmp_path, run=fake.run, recording=fake.recording) for word in words)
    assert_one_line(duagc_here(*said))
    assert state(tmp_path) == before


def test_a_log_of_another_robot_is_found(fake) -> None:
    path = fake.recording / "recording.json"
    description = json.loads(path.read_text())
    description["robots"]["alpha"]["log"] = "bravo.mcap"
    path.write_text(json.dumps(description))
    assert_one_line(duagc_here("info", fake.recording), "is the log of bravo, expected that of alpha")
    checked = duagc_here("check", fake.recording)
    assert checked.returncode == 1
    assert "is the log of bravo" in checked.stdout


@pytest.mark.parametrize(
    ("key", "value"),
    [("recording", 3), ("inputs", None), ("outputs", []), ("config", 3), ("calibration", "x")],
)
def test_a_manifest_of_wrong_types_is_one_line(fake, key, value) -> None:
    path = fake.run / "manifest.json"
    content = json.loads(path.read_text()) if path.is_file() else {"schema": 1}
    path.write_text(json.dumps(content | {key: value}))
    assert_one_line(duagc_here("report", fake.run, "--recording", fake.recording), "manifest.json", key)


@pytest.mark.parametrize("text", ["", "[]", '{"robots": {}}'])
def test_a_recording_without_its_description_has_no_digest(fake, text) -> None:
    (fake.recording / "recording.json").write_text(text)
    assert_one_line(duagc_here("digest", fake.recording), "recording.json")


ROW = {"recording": "", "configuration": "team", "seed": 0, "values": {"a": 1.0, "b": None}, "reasons": {}}
RESULT = {
    "experiment": "mine", "rule_sha256": "0", "code_sha256": "0", "profile": "small", "seeds": [0],
    "recordings": [], "rows": [ROW],
}  # fmt: skip


def test_results_of_experiments_are_looked_at(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text(json.dumps(RESULT))
    assert read_result(path) == RESULT
    wrong = [
        {"rows": [{}]},
        {"rows": [ROW | {"values": {"a": math.nan}}]},
        {"rows": [ROW | {"values": {"a": math.inf}}]},
        {"rows": [ROW | {"values": {"a": "x"}}]},
        {"rows": [ROW | {"values": {"a": True}}]},
        {"seeds": 3},
        {"recordings": None},
        {"code_sha256": 3},
        {"profile": 3},
    ]
    for change in wrong:
        path.write_text(json.dumps(RESULT | change))
        with pytest.raises(DuagError, match="is no result of an experiment"):
            read_result(path)


@pytest.mark.parametrize("kind", ["a file", "a folder", "no such file or folder"])
def test_what_is_no_run_is_said(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "it"
    if kind == "a folder":
        path.mkdir()
    elif kind == "a file":
        path.write_text("text")
    with pytest.raises(DuagError, match=f"it: {kind}, expected a run"):
        view(path, save=tmp_path / "made.rrd")
    if kind != "a file":  # of which `digest` is that of its bytes
        for refused in (lambda: digest(path), lambda: compare(path, path)):
            with pytest.raises(DuagError, match=f"it: {kind}, expected a log, a recording"):
                refused()


def test_a_file_needs_a_name() -> None:
    with pytest.raises(DuagError, match="found a path without a name"), new_file(Path()):
        pytest.fail("there is no such file")
