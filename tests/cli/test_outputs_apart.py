"""`--force` and `--store` never cost what is read: an output that holds an input is refused before any work."""

import json
from pathlib import Path

import pytest

from tests.fixtures.commands import assert_one_line, duagc_here


def state(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize(
    "words",
    [
        ("run", "{tmp}/x/recording", "--out", "{tmp}/x"),
        ("run", "{tmp}/x", "--out", "{tmp}/link"),
        ("run", "{tmp}/recording", "--out", "{tmp}/x", "--store", "{tmp}/x/store"),
        ("convert", "tum", "{tmp}/x/recording", "--out", "{tmp}/x"),
        ("convert", "tum", "{tmp}/x/recording", "--out", "{tmp}/x", "--calibrate"),
        ("convert", "tum", "{tmp}/recording", "--out", "{tmp}/x", "--mask", "alpha={tmp}/x/recording.json"),
        ("simulate", "--scene", "{tmp}/x/recording", "--out", "{tmp}/x"),
        ("recover", "{tmp}/x", "--out", "{tmp}/x"),
        ("export", "{tmp}/x", "--out", "{tmp}/x"),
    ],
    ids=" ".join,
)
def test_an_output_that_holds_an_input_is_one_line(tmp_path: Path, words: tuple[str, ...]) -> None:
    for folder in (tmp_path / "x" / "recording", tmp_path / "recording", tmp_path / "x"):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "recording.json").write_text("{}")
        (folder / "manifest.json").write_text("{}")
    (tmp_path / "link").symlink_to(tmp_path / "x")
    before = state(tmp_path)
    result = duagc_here(*(word.format(tmp=tmp_path) for word in words), "--force")
    assert_one_line(result, "expected --out apart from")
    assert state(tmp_path) == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "recording", "x"]


def test_a_run_does_not_replace_a_demo(tmp_path: Path) -> None:
    (tmp_path / "demo" / "run").mkdir(parents=True)
    (tmp_path / "demo" / "run" / "manifest.json").write_text("{}")
    recording = tmp_path / "recording"
    recording.mkdir()
    description = {
        "format": "duagc.recording",
        "schema": 1,
        "name": "r",
        "robots": {"alpha": {"log": "alpha.mcap"}},
    }
    (recording / "recording.json").write_text(json.dumps(description))
    before = state(tmp_path)
    result = duagc_here("run", recording, "--out", tmp_path / "demo", "--no-cache", "--force")
    assert_one_line(result, "demo: is not a run")
    assert state(tmp_path) == before
