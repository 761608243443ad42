"""A disk that fills while a run writes: one line, exit code 1, nothing broken, and the same command goes on later."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline import cli
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import save_array
from duagc.pipeline.cache.store import Store
from duagc.pipeline.runs.digest import digest, digest_file
from duagc.pipeline.runs.stages import FUSION
from tests.fixtures.commands import ROOT
from tests.fixtures.full_disks import no_file_larger_than
from tests.fixtures.recording_logs import write_camera
from tests.fixtures.small_run import SMALL

RUN = "from duagc.pipeline.cli import main; main()"
SETTINGS = [word for line in SMALL for word in ("--set", line)]
DISK = "1m"  # a run of the small recording needs several
ON_A_SMALL_DISK = """
set -u
mount -t tmpfs -o size="$1" none "$2" || exit 77
shift
where="$1"
shift
"$@"
echo "exit code $?" >&2
find "$where" -type f -printf '%P\\n'
mount -o remount,size=200m "$where"
"$@" 2>"$where/again.err" || exit 1
cp -a "$where/run" "$where.run"
"""


def has_room_line(err: str) -> bool:
    """Whether the last line says what failed, and none looks like a traceback."""
    return "Traceback" not in err and err.splitlines()[-1].startswith("duagc: ")


def test_fusion_that_finds_no_room_is_told_and_done_later(
    small_run: Path,
    small_recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    store, out = tmp_path / "store", tmp_path / "run"
    shutil.copytree(small_run.parent / ".duagc-store", store)
    for entry in Store(store).recent(FUSION.name, 10):
        Store(store).forget(entry.key)
    words = ["run", str(small_recording), "--out", str(out), "--store", str(store), "--until", "fusion"]
    monkeypatch.setattr(sys, "argv", ["duagc", *words, "--workers", "1", *SETTINGS])
    largest = (small_run / "robots" / "alpha" / "fused.ply").stat().st_size
    with no_file_larger_than(largest // 2), pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 1
    assert has_room_line(capsys.readouterr().err)
    assert not out.exists()
    assert not Store(store).recent(FUSION.name, 10)
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 0
    for name in ("robots/alpha/fused.ply", "robots/bravo/fused.mcap", "robots/bravo/fused.ply"):
        assert digest_file(out / name) == digest_file(small_run / name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "store"]


@pytest.mark.parametrize("frames", [4, 400])
def test_a_log_that_finds_no_room_is_named(tmp_path: Path, frames: int) -> None:
    """At the end, where all of it is in the buffer of the file, and before."""
    path = tmp_path / "alpha.mcap"
    with no_file_larger_than(2000), pytest.raises(OSError, match=r"/alpha\.mcap'$"):
        write_camera(path, frames)
    assert list(tmp_path.iterdir()) == []


def test_an_array_that_finds_no_room_is_named(tmp_path: Path) -> None:
    with no_file_larger_than(2000), pytest.raises(DuagError, match=r"/0\.npy: .*, expected room for it$"):
        save_array(tmp_path / "0.npy", np.zeros(10_000))


@pytest.mark.slow
def test_a_run_on_a_disk_that_fills_goes_on_when_there_is_room(
    small_run: Path, small_recording: Path, tmp_path: Path
) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    command = [sys.executable, "-c", RUN, "run", str(small_recording), "--out", str(disk / "run"), *SETTINGS]
    done = subprocess.run(
        ["unshare", "-Urm", "sh", "-c", ON_A_SMALL_DISK, "sh", DISK, str(disk), *command],
        cwd=ROOT,
        env={**os.environ, "TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    if "unshare" in done.stderr or done.returncode == 77:
        pytest.skip("no file system may be mounted here")
    assert done.returncode == 0, done.stderr
    *_, line, code = done.stderr.splitlines()
    assert (code, "Traceback" in done.stderr) == ("exit code 1", False)
    assert line.startswith("duagc: ")
    left = done.stdout.split()
    assert not [path for path in left if path.startswith("run/")]
    assert digest(tmp_path / "disk.run") == digest(small_run)
