"""One cell of a suite, in a process of its own: `python -m duagc.pipeline.batch.cell SUITE --out DIR --cell NAME`.

What it comes to stands in `cells/<name>.json`, what it says in `cells/<name>.log`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import traceback
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from duagc.pipeline.base import determinism
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.machine import processors
from duagc.pipeline.base.said_lines import say_line
from duagc.pipeline.base.stop_signals import ending_as_interrupts
from duagc.pipeline.cache.claims import has_ended, this_process

RUNS, CELLS = "runs", "cells"
State = Literal["waiting", "running", "done", "failed"]


@dataclass(frozen=True)
class CellState:
    """How far a cell is.

    Attributes:
        state: "waiting", "running", "done", "failed".
        attempts: how often it was begun.
        wall_s: that the last attempt took.
        error: the line of the last failure; "".
        process: that runs it, as `claims.this_process` says; {} otherwise.
    """

    state: State = "waiting"
    attempts: int = 0
    wall_s: float = 0.0
    error: str = ""
    process: dict[str, object] = field(default_factory=dict)


def run_folder(out: Path, name: str) -> Path:
    """Folder of the run of a cell.

    Args:
        out: folder of the batch.
        name: of the cell.
    """
    return out / RUNS / name


def read_state(out: Path, name: str) -> CellState:
    """How far a cell is; one that was begun on this machine by a process that has ended waits again.

    Args:
        out: folder of the batch.
        name: of the cell.
    """
    try:
        content = json.loads((out / CELLS / f"{name}.json").read_bytes())
        state = CellState(**content)
        if state.state == "running" and has_ended(state.process):
            return CellState(attempts=state.attempts)
        return state
    except (OSError, ValueError, TypeError, AttributeError):
        return CellState()


def write_state(out: Path, name: str, state: CellState) -> None:
    """Say how far a cell is.

    Args:
        out: folder of the batch.
        name: of the cell.
        state: of it.
    """
    from duagc.pipeline.cache.publish import publish

    publish(out / CELLS / f"{name}.json", json.dumps(asdict(state)).encode())


def run_cell(suite_path: Path, out: Path, name: str, store: Path) -> str:
    """Run a cell, and say what it came to.

    Args:
        suite_path: of the suite.
        out: folder of the batch.
        name: of the cell.
        store: of results.

    Returns:
        The line of what went wrong; "" if nothing did.
    """
    begin = time.monotonic()
    attempts = read_state(out, name).attempts + 1
    write_state(out, name, CellState("running", attempts, process=this_process()))
    error = ""
    try:
        _run(suite_path, out, name, store)
    except DuagError as failure:
        error = str(failure)
    except Exception as failure:  # one cell must not take the others with it
        traceback.print_exc()
        error = f"{type(failure).__name__}: {failure}"
    if error:
        say_line(f"duagc: {error}")
    wall_s = round(time.monotonic() - begin, 3)
    write_state(out, name, CellState("failed" if error else "done", attempts, wall_s, error))
    return error


def _run(suite_path: Path, out: Path, name: str, store: Path) -> None:
    from duagc.pipeline.batch.suite import read_suite
    from duagc.pipeline.existing_run import is_up_to_date, measured_otherwise
    from duagc.pipeline.recording import Recording
    from duagc.pipeline.run_plan import RunPlan
    from duagc.pipeline.runner import run

    def say(line: str) -> None:
        say_line(f"duagc: {line}")

    cell = read_suite(suite_path).cells[name]
    folder = run_folder(out, name)
    folder.parent.mkdir(parents=True, exist_ok=True)
    workers = max(1, min(2, processors()))
    if folder.exists():
        plan = RunPlan(workers, store=store, until=cell.until)
        try:
            if is_up_to_date(Recording(cell.folder), folder, cell.config, plan, log=say):
                changed = measured_otherwise(folder, store)
                if not changed:
                    say(f"{folder}: up to date")
                    return
                say(f"{folder / changed}: is not what was computed; taken from the store")
        except DuagError as error:  # the suite is another one than it was; its runs are ours to replace
            say(str(error))
    run(
        cell.folder,
        folder,
        cell.config,
        workers=workers,
        force=folder.exists(),
        store=store,
        until=cell.until,
        log=say,
    )


def enter(arguments: Mapping[str, str], processors: tuple[int, ...] = ()) -> None:
    """Be the process of a cell; its exit code is 1 if the cell failed.

    Args:
        arguments: `suite`, `out`, `cell`, `store`.
        processors: that it may use; empty: all.
    """
    if processors:
        os.sched_setaffinity(0, processors)
    out, name = Path(arguments["out"]), arguments["cell"]
    (out / CELLS).mkdir(parents=True, exist_ok=True)
    log = os.open(out / CELLS / f"{name}.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(log, 1)
    os.dup2(log, 2)
    try:
        with ending_as_interrupts():
            error = run_cell(Path(arguments["suite"]), out, name, Path(arguments["store"]))
    except KeyboardInterrupt:
        error = "interrupted"
        say_line(f"duagc: {error}")
    sys.exit(1 if error else 0)


def main() -> None:
    """Entry point of `python -m duagc.pipeline.batch.cell`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("suite")
    parser.add_argument("--out", required=True)
    parser.add_argument("--store", required=True)
    parser.add_argument("--cell", help="its name")
    parser.add_argument("--index", type=int, help="its place in the suite, as a task of an array has it")
    arguments = parser.parse_args()
    name = arguments.cell
    if name is None:
        from duagc.pipeline.batch.suite import read_suite

        name = list(read_suite(Path(arguments.suite)).cells)[arguments.index]
    enter({"suite": arguments.suite, "out": arguments.out, "cell": name, "store": arguments.store})


if __name__ == "__main__":
    determinism.configure_determinism()
    main()
