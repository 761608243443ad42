"""A disk that fills while a run writes: one line, exit code 1, nothing broken, and the same command goes on later."""

from __future__ import annotations

import resource
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from duagc.pipeline import cli
from duagc.pipeline.cache.store import Store
from duagc.pipeline.runs.digest import digest_file
from duagc.pipeline.runs.stages import FUSION
from tests.fixtures.small_run import SMALL

SETTINGS = [word for line in SMALL for word in ("--set", line)]


@contextmanager
def no_file_larger_than(limit: int) -> Iterator[None]:
    """Writing beyond this size fails as it does on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


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
