"""A run that is killed goes on where it was: nothing that was finished is computed again, and no bit is other."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from duagc.converters.simulate.team import simulate
from duagc.pipeline.recording import content_digest
from duagc.pipeline.runs.digest import digest
from tests.fixtures.commands import ROOT

KILLS = 50
LARGEST_LOSS_S = 10.0
SETTINGS = (
    "frontend.mapping.max_gaussians=2000",
    "frontend.mapping.iterations=4",
    "frontend.mapping.final_iterations=4",
    "frontend.mapping.final_iterations_view=0",
    "exchange.max_rounds=400",
    "fusion.finetune.steps_per_view=2",
)

LONG = (
    "frontend.mapping.max_gaussians=20000",
    "frontend.mapping.final_iterations=400",
    "frontend.mapping.final_iterations_view=200",
)
"""Front ends that take half a minute, most of it the final optimization."""


def start(
    recording: Path, out: Path, lines: tuple[str, ...] = SETTINGS, *options: str
) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", "from duagc.pipeline.cli import main; main()", "run", str(recording)]
    settings = [word for line in lines for word in ("--set", line)]
    return subprocess.Popen(
        [*command, "--out", str(out), *settings, *options],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def entries(folder: Path) -> dict[str, int]:
    """Results of the store; a result that is computed again gets another inode."""
    found = (folder / ".duagc-store" / "entries").rglob("*.json")
    return {path.name: path.stat().st_ino for path in found}


@pytest.mark.slow
def test_a_killed_run_resumes_and_finished_stages_are_never_computed_again(tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    simulate(recording, robots=2, frames=12, size=(160, 120), seed=1, overlap=0.9, workers=1)
    moments = random.Random(0)
    undisturbed = tmp_path / "undisturbed"
    begin = time.monotonic()
    assert start(recording, undisturbed / "run").wait() == 0
    duration_s = time.monotonic() - begin
    expected, stages = digest(undisturbed / "run"), len(entries(undisturbed))
    kills = completed = 0
    while kills < KILLS:
        attempt = tmp_path / f"attempt{completed}"
        known: dict[str, int] = {}
        while not (attempt / "run").exists():
            process = start(recording, attempt / "run")
            try:
                process.wait(moments.uniform(0.0, 0.8 * duration_s))
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)  # workers as well, as a power failure does
                process.wait()
                kills += 1
            now = entries(attempt)
            assert {name: now.get(name) for name in known} == known
            known = now
        assert digest(attempt / "run") == expected
        assert len(known) == stages
        assert sorted(p.name for p in attempt.iterdir()) == [".duagc-store", "run"]
        shutil.rmtree(attempt)
        completed += 1
    assert completed


def last_saved_s(folder: Path) -> float:
    """When a front end has saved where it is, or one has ended: its results are kept, its checkpoints are not."""
    times, store = [0.0], folder / ".duagc-store"
    for path in (*(store / "checkpoints").rglob("*.[sd]*"), *(store / "entries").rglob("*.json")):
        with suppress(FileNotFoundError):
            times.append(path.stat().st_mtime)
    return max(times)


@pytest.mark.slow
def test_a_killed_front_end_loses_at_most_ten_seconds(tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    simulate(recording, robots=2, frames=60, size=(320, 240), seed=1, overlap=0.9, workers=1)
    options = ("--until", "frontend", "--workers", "1")
    moments, begin = random.Random(1), time.monotonic()
    assert start(recording, tmp_path / "undisturbed" / "run", LONG, *options).wait() == 0
    duration_s = time.monotonic() - begin
    attempt, losses_s, kills, spent_s = tmp_path / "attempt", [], 0, 0.0
    while not (attempt / "run").exists():
        begin, begin_s = time.monotonic(), time.time()
        process = start(recording, attempt / "run", LONG, *options)
        try:
            process.wait(moments.uniform(0.1, 0.4) * duration_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            losses_s.append(time.time() - max(last_saved_s(attempt), begin_s))
            kills += 1
        spent_s += time.monotonic() - begin
    print(f"undisturbed {duration_s:.1f} s; {kills} kills, lost {losses_s}; {spent_s:.1f} s in all")
    assert kills >= 3
    assert max(losses_s) <= LARGEST_LOSS_S
    assert spent_s <= duration_s + kills * (LARGEST_LOSS_S + 5.0)  # a process takes seconds to begin
    for log in sorted((tmp_path / "undisturbed" / "run").rglob("*.mcap")):
        again = attempt / "run" / log.relative_to(tmp_path / "undisturbed" / "run")
        assert content_digest(again) == content_digest(log)
    assert not list((attempt / ".duagc-store" / "checkpoints").iterdir())
