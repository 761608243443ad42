"""What a user sees when something is wrong: one line, exit code 1, nothing half-written."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline import cli
from duagc.pipeline.base.atomic_folder import new_folder
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import new_file
from duagc.pipeline.cli import runs as commands
from duagc.pipeline.splat.ply import write_ply
from tests.fixtures import fake_run
from tests.fixtures.commands import ROOT, assert_one_line, duagc, duagc_here, listen_to_interrupts
from tests.fixtures.noisy_wall import wall
from tests.fixtures.recording_logs import write_camera
from tests.fixtures.ros_bags import Ros, still


def test_help_is_there_for_every_command() -> None:
    commands = cli.app.registered_commands
    names = [c.name or c.callback.__name__.replace("_", "-") for c in commands if c.callback]
    assert len(names) >= 10
    text = duagc("--help").stdout
    assert all(name in text for name in names)
    assert "Example" in duagc_here("run", "--help").stdout


def test_help_is_there_on_a_terminal_that_does_not_know_its_width(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "0")
    assert "simulate" in duagc("--help").stdout


def test_a_map_without_gaussians_is_not_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    some = wall()
    for robot, gaussians in (("alpha", some.select(np.arange(0))), ("bravo", some)):
        (tmp_path / "robots" / robot).mkdir(parents=True)
        write_ply(tmp_path / "robots" / robot / "refined.ply", gaussians)
    commands._print_outputs(tmp_path)
    assert capsys.readouterr().out.split() == ["map", str(tmp_path / "robots" / "bravo" / "refined.ply")]


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", "{tmp}/absent", "--out", "{tmp}/out"),
        ("run", "{tmp}/empty", "--out", "{tmp}/out"),
        ("convert", "7scenes", "{tmp}/absent", "--out", "{tmp}/out"),
        ("convert", "7scenes", "{tmp}/empty", "--out", "{tmp}/out"),
        ("convert", "9scenes", "{tmp}/empty", "--out", "{tmp}/out"),
        ("info", "{tmp}/absent"),
        ("digest", "{tmp}/empty"),
        ("replay", "{tmp}/empty"),
        ("evaluate", "{tmp}/empty"),
        ("report", "{tmp}/absent"),
        ("simulate", "--scene", "moon", "--out", "{tmp}/out"),
        ("config", "check", "{tmp}/absent.toml"),
        ("config", "show", "--set", "frontend.no_such_thing=1"),
        ("simulate", "--out", "/"),
        ("demo", "--out", "/", "--force"),
    ],
    ids=" ".join,
)
def test_bad_input_is_one_line(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    (tmp_path / "empty").mkdir()
    assert_one_line(duagc_here(*(a.format(tmp=tmp_path) for a in arguments)))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty"]


def test_an_existing_output_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "keep").write_text("mine")
    assert_one_line(duagc("demo", "--out", tmp_path / "out"), "exists already")
    assert (tmp_path / "out" / "keep").read_text() == "mine"


def test_force_replaces_only_what_a_run_has_written(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.tex").write_text("mine")
    with pytest.raises(DuagError, match="is not a run"), new_folder(out, force=True):
        pass
    assert (out / "thesis.tex").read_text() == "mine"
    (out / "thesis.tex").rename(out / "manifest.json")
    with new_folder(out, force=True) as folder:
        (folder / "new").write_text("")
    assert [p.name for p in out.iterdir()] == ["new"]


def test_a_file_in_the_way_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for command in (("demo",), ("simulate",)):
        assert_one_line(duagc_here(*command, "--out", tmp_path / "file", "--force"), "file")
        assert_one_line(duagc_here(*command, "--out", tmp_path / "file" / "out"), "Not a directory")
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize(
    "terminal",
    [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}],
)
def test_a_letter_that_the_terminal_lacks_is_replaced(terminal: dict[str, str]) -> None:
    code = "from duagc.pipeline import cli; cli.app = lambda: print('sigma\\u00e9 \\u03c3'); cli.main()"
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
        env=os.environ | terminal,
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, "sigma? ?\n", "")


def test_standard_streams_may_be_closed(tmp_path: Path) -> None:
    r, out = Ros(1), tmp_path / "rec"
    words = ["convert", "ros", str(r.write(tmp_path / "bag", still(r), "plain")), "--out", str(out)]
    main = [sys.executable, "-c", "from duagc.pipeline.cli import main; main()"]
    command = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *main, *words]
    assert subprocess.run(command, cwd=ROOT, check=False).returncode == 0
    assert (out / "recording.json").is_file()


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="such links are taken for links to nothing")
def test_a_link_that_leads_back_to_itself_is_no_output(tmp_path: Path) -> None:
    out, source = tmp_path / "out", tmp_path / "source"
    out.symlink_to(out)
    for words in (["simulate"], ["convert", "ros", source], ["run", source], ["export", source]):
        assert_one_line(duagc_here(*words, "--out", out), "out: a link that leads back to itself")


def test_a_full_disk_is_one_line() -> None:
    command = "lambda: open('/dev/full', 'wb', buffering=0).write(b'a log')"
    code = f"from duagc.pipeline import cli; cli.app = {command}; cli.main()"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert_one_line(result, "No space left on device", "expected room for the output")


def test_a_file_appears_only_when_it_is_finished(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    path.write_text("before")

    def fail_half_way() -> None:
        with new_file(path) as part:
            part.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert [p.read_text() for p in tmp_path.iterdir()] == ["before"]
    with new_file(path) as part:
        part.write_text("after")
        assert path.read_text() == "before"
    assert [p.read_text() for p in tmp_path.iterdir()] == ["after"]
    with (
        pytest.raises(DuagError, match=r"out.txt/in.txt: Not a directory"),
        new_file(path / "in.txt") as part,
    ):
        part.write_text("nowhere")


def test_two_processes_do_not_write_one_output(tmp_path: Path) -> None:
    with new_folder(tmp_path / "out", force=False) as folder:
        (folder / "mine").write_text("")
        assert_one_line(duagc("demo", "--out", tmp_path / "out"), "out.part", "another process")
        assert (folder / "mine").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_what_a_killed_run_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / "out.part" / "robots").mkdir(parents=True)
    (tmp_path / "out.part" / "config.toml").write_text("")
    with new_folder(tmp_path / "out", force=False) as folder:
        (folder / "new").write_text("")
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "new"]


def test_an_output_that_appeared_meanwhile_is_kept(tmp_path: Path) -> None:
    def write_beside_another() -> None:
        with new_folder(tmp_path / "out", force=False):
            (tmp_path / "out").mkdir()
            (tmp_path / "out" / "keep").write_text("mine")

    with pytest.raises(DuagError, match="exists already"):
        write_beside_another()
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "keep"]


@pytest.mark.parametrize(
    ("stop", "send"),
    [
        (signal.SIGINT, os.killpg),  # as a terminal does: parent and workers
        (signal.SIGTERM, os.kill),
        (signal.SIGHUP, os.kill),
        (signal.SIGHUP, os.killpg),
    ],
)
def test_an_interrupted_command_is_one_line(
    tmp_path: Path, stop: signal.Signals, send: Callable[[int, int], None]
) -> None:
    command = [sys.executable, "-c", "from duagc.pipeline.cli import main; main()", "simulate", "--out"]
    process = subprocess.Popen(
        [*command, str(tmp_path / "out")],
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        start_new_session=True,
        preexec_fn=listen_to_interrupts,
    )
    deadline = time.monotonic() + 60
    while not list(tmp_path.iterdir()) and time.monotonic() < deadline:
        time.sleep(0.05)
    send(process.pid, stop)
    assert process.communicate(timeout=60)[1].splitlines() == ["duagc: interrupted"]
    assert process.returncode == 1
    assert list(tmp_path.iterdir()) == []


def test_usage_errors_exit_with_2() -> None:
    assert duagc("run").returncode == 2
    assert duagc_here("convert", "7scenes").returncode == 2


def test_a_folder_appears_only_when_it_is_finished(tmp_path: Path) -> None:
    out = tmp_path / "out"

    def fail_half_way() -> None:
        with new_folder(out, force=False) as folder:
            (folder / "half").write_text("")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert list(tmp_path.iterdir()) == []
    with new_folder(out, force=False) as folder:
        (folder / "whole").write_text("")
        assert not out.exists()
    assert [p.name for p in out.iterdir()] == ["whole"]


def test_recover_exits_with_3_if_something_was_lost(tmp_path: Path) -> None:
    whole = write_camera(tmp_path / "whole.mcap", frames=2500)  # chunks of 1 MiB
    result = duagc_here("recover", whole, "--out", tmp_path / "copy.mcap")
    assert (result.returncode, result.stderr) == (0, "")
    assert "nothing lost" in result.stdout
    cut = tmp_path / "cut.mcap"
    data = whole.read_bytes()
    cut.write_bytes(data[: len(data) * 3 // 4])
    result = duagc("recover", cut, "--out", tmp_path / "saved.mcap")
    assert result.returncode == 3
    assert "lost in between, and all after the cut" in result.stdout
    assert (tmp_path / "saved.mcap").is_file()


def test_a_user_finds_why_a_loop_closure_was_rejected(tmp_path: Path) -> None:
    fake = fake_run.make(tmp_path)
    result = duagc("inspect", fake.run, "--loop-closures", "--robot", "bravo")
    assert result.returncode == 0, result.stderr
    lines = [line.split() for line in result.stdout.splitlines()]
    assert lines[0][:3] == ["Robot", "Peer", "Keyframes"]
    rejected = next(line for line in lines if "inconsistent" in line)
    assert rejected[:2] == ["alpha", "bravo"]
    assert rejected[-5:] == ["30", "of", "50", "matches", "agree"]
    listed = json.loads(duagc_here("inspect", fake.run, "--loop-closures", "--json").stdout)
    assert listed["verdicts"] == {"outvoted": 1, "kept": 1, "inconsistent": 1, "few_matches": 1}
    assert listed["candidates"][1]["weight"] == 1.0
    assert_one_line(duagc_here("inspect", fake.run, "--loop-closures", "--robot", "zulu"), "no robot 'zulu'")


def test_a_command_leaves_the_signals_as_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program may call it, as tests do."""
    before = [signal.getsignal(name) for name in (signal.SIGTERM, signal.SIGHUP)]
    monkeypatch.setattr(sys, "argv", ["duagc", "--version"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 0
    assert [signal.getsignal(name) for name in (signal.SIGTERM, signal.SIGHUP)] == before
