"""Paths that begin with `~`: the shell expands no `--out=~/room`, and nothing in quotes."""

import json
import os
from pathlib import Path

import pytest
import typer

from duagc.pipeline import cli
from duagc.pipeline.cache.store import default_store
from duagc.pipeline.cli.common import Commands
from tests.fixtures.commands import assert_one_line, duagc_here
from tests.fixtures.recording_logs import write_recording


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The home of the user; the current folder is another."""
    (tmp_path / "home").mkdir()
    (tmp_path / "here").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "home"


def test_options_and_arguments_begin_at_home(home: Path) -> None:
    write_recording(home / "rec", robots=1)
    assert json.loads(duagc_here("info", "~/rec", "--json").stdout)
    size = ("--frames", "2", "--robots", "1", "--width", "32", "--height", "32", "--workers", "1")
    done = duagc_here("simulate", *size, "--out=~/simulated")
    assert done.returncode == 0, done.stderr
    assert (home / "simulated" / "recording.json").is_file()
    assert list(Path().iterdir()) == []


def test_paths_that_are_part_of_a_text_begin_at_home(home: Path) -> None:
    def refused(*arguments: str, word: str) -> None:
        assert_one_line(duagc_here(*arguments), str(home / word))

    refused("convert", "~/own.py", str(home), "--out", "x", word="own.py")
    refused("simulate", "--scene=~/meshes", "--out", "x", word="meshes")
    for mask in ("~/mask.png", "alpha=~/mask.png"):
        refused("convert", "tum", str(home), "--out", "x", f"--mask={mask}", word="mask.png")
    refused("experiment", "run", "compaction", "--recording=room=~/room", "--out=~/out", word="room")


def test_the_store_of_the_environment_begins_at_home(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DUAGC_STORE", "~/store")
    assert default_store(Path("run")) == home / "store"


def test_a_name_that_libraries_cannot_take_is_refused(tmp_path: Path) -> None:
    refused = duagc_here("run", tmp_path, "--out", tmp_path / os.fsdecode(b"run\xff"))
    assert_one_line(refused, r"run\udcff: is no name in UTF-8", "a locale such as C.UTF-8")


def test_every_group_of_commands_reads_paths_so() -> None:
    groups = [cli.app, *(group.typer_instance for group in cli.app.registered_groups)]
    assert len(groups) >= 4
    assert all(isinstance(group, Commands) and isinstance(group, typer.Typer) for group in groups)
