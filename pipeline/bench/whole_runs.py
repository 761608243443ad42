"""Whole runs as a user starts them, on parts of a recording, with so many processors; and what they took."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import new_file
from duagc.pipeline.recording import RECORDING_FILE, LogWriter, Recording
from duagc.pipeline.recording.read import LogFile, log_metadata
from duagc.schemas import topics

SECOND = 1e-9
THIS = (sys.executable, "-c", "from duagc.pipeline.cli import main; main()")
"""The command of this very code."""


@dataclass(frozen=True)
class Finished:
    """A whole run.

    Attributes:
        stages: rows of timing.json, by label.
        metrics: content of metrics.json; empty if nothing was measured.
        wall_s: from start to end of the command.
    """

    stages: dict[str, dict[str, Any]]
    metrics: dict[str, Any]
    wall_s: float


def execute(
    command: Sequence[str], recording: Path, out: Path, *, processors: int, options: Sequence[str] = ()
) -> Finished:
    """Run all stages in a process of its own that may use so many processors, with nothing from any store.

    Args:
        command: `duagc`, of this or of another version.
        recording: folder of the recording.
        out: folder of the run; a store that the command makes is next to it.
        processors: that it may use.
        options: more words of the command.

    Raises:
        DuagError: the machine has fewer processors, or the command failed; with the last line that it said.
    """
    usable = sorted(os.sched_getaffinity(0))
    if processors > len(usable):
        raise DuagError(f"--threads {processors}: found {len(usable)} processors, expected {processors}")
    allowed = usable[:processors]
    words = [*command, "run", str(recording), "--out", str(out), "--workers", str(processors), *options]
    began_s = time.perf_counter()
    done = subprocess.run(
        words,
        capture_output=True,
        text=True,
        env=os.environ | {"DUAGC_STORE": str(out.with_name(f"{out.name}.store"))},
        preexec_fn=lambda: os.sched_setaffinity(0, allowed),
    )
    wall_s = time.perf_counter() - began_s
    if done.returncode:
        said = done.stderr.strip().splitlines() or ["nothing"]
        raise DuagError(
            f"{command[0]}: said {said[-1]!r} and ended with {done.returncode}, expected a whole run"
        )
    timing, metrics = out / "timing.json", out / "metrics.json"
    return Finished(
        json.loads(timing.read_text())["stages"],
        json.loads(metrics.read_text()) if metrics.is_file() else {},
        wall_s,
    )


def seconds_of(recording: Recording) -> dict[str, float]:
    """Length of the color of every robot's log, seconds.

    Args:
        recording: with the logs.
    """
    out = {}
    for robot in recording.robots:
        row = recording.description["robots"][robot]
        out[robot] = (row["end_ns"] - row["start_ns"]) * SECOND
    return out


def part_of(recording: Recording, robots: int, until_s: float | None, folder: Path) -> Recording:
    """The first robots of a recording, and of their logs what comes until a time; whole logs are linked.

    Args:
        recording: that it is a part of; it stays as it is.
        robots: how many, by name.
        until_s: after the first color image of each; None: all of it.
        folder: to write, new.

    Raises:
        DuagError: the recording has fewer robots.
    """
    if robots > len(recording.robots):
        raise DuagError(f"{recording.path}: has {len(recording.robots)} robots, expected {robots} or more")
    folder.mkdir(parents=True)
    description = deepcopy(recording.description)
    description["robots"] = rows = {name: description["robots"][name] for name in recording.robots[:robots]}
    if (geometry := recording.geometry()) is not None:
        (folder / geometry.name).symlink_to(geometry.resolve())
    for name, row in rows.items():
        truth = recording.groundtruth(name)
        for path in (recording.log(name), *([] if truth is None else [truth])):
            target = folder / path.name
            if until_s is None:
                target.symlink_to(path.resolve())
            else:
                end_ns = row["start_ns"] + round(until_s / SECOND)
                row.setdefault("digests", {})[path.name] = _cut(path, target, end_ns)
        if until_s is not None:
            row["end_ns"] = min(row["end_ns"], row["start_ns"] + round(until_s / SECOND))
            with LogFile(folder / row["log"]) as log:
                row["frames"] = sum(1 for _ in log.records([topics.COLOR.of(name)]))
    with new_file(folder / RECORDING_FILE) as part:
        part.write_text(json.dumps(description, indent=2))
    return Recording(folder)


def _cut(path: Path, target: Path, end_ns: int) -> str:
    """Copy what a log has until a time; the digest of the copy."""
    with LogFile(path) as log, LogWriter(target, metadata=log_metadata(path)) as writer:
        for record in log.records(None):
            if record.log_time_ns <= end_ns:
                writer.copy(log, record)
    return writer.digest
