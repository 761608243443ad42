"""All cells of a suite: started, tried again once, gathered."""

from __future__ import annotations

import fcntl
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.batch.cell import CELLS, CellState, read_state, write_state
from duagc.pipeline.batch.engines import Engine
from duagc.pipeline.batch.suite import Suite

ATTEMPTS = 2


def run_batch(
    suite: Suite, out: Path, store: Path, engine: Engine, *, log: Callable[[str], None]
) -> Mapping[str, CellState]:
    """Run every cell of a suite; one that fails is tried again once, and does not stop the others.

    Args:
        suite: the suite.
        out: folder of the batch.
        store: of results, shared by all cells.
        engine: where they run.
        log: gets a line when a cell has ended, with the time that is left.

    Returns:
        What became of each, by name.

    Raises:
        DuagError: another process runs a batch there.
    """
    with _alone(out):
        return _run(suite, out, store, engine, log=log)


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Be the one process that runs a batch in a folder; the kernel gives the lock up with the process."""
    (out / CELLS).mkdir(parents=True, exist_ok=True)
    with (out / CELLS / ".lock").open("ab") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise DuagError(
                f"{out}: another process runs a batch there; wait, or choose another --out"
            ) from error
        yield


def _run(
    suite: Suite, out: Path, store: Path, engine: Engine, *, log: Callable[[str], None]
) -> Mapping[str, CellState]:
    for name in suite.cells:
        write_state(out, name, CellState())
    waiting, running = list(suite.cells), set[str]()
    attempts = dict.fromkeys(suite.cells, 0)
    out_of = {"suite": str(suite.path), "out": str(out), "store": str(store)}
    begin, ended = time.monotonic(), 0
    while waiting or running:
        while waiting and len(running) < engine.slots:
            name = waiting.pop(0)
            attempts[name] += 1
            running.add(name)
            engine.submit(name, out_of | {"cell": name})
        name = engine.wait()
        running.remove(name)
        state = read_state(out, name)
        if state.state != "done":
            error = state.error or "its process ended before it did, expected it to finish"
            state = replace(state, state="failed", error=error, attempts=attempts[name])
            write_state(out, name, state)
            if attempts[name] < ATTEMPTS:
                log(f"{name}: failed, tried again: {error}")
                waiting.append(name)
                continue
        ended += 1
        left = (time.monotonic() - begin) / ended * (len(suite.cells) - ended)
        what = f"{state.wall_s:.1f} s" if state.state == "done" else f"failed: {state.error}"
        log(f"{name}: {what} ({ended} of {len(suite.cells)}, {left:.0f} s left)")
    return {name: read_state(out, name) for name in suite.cells}


def status_text(suite: Suite, out: Path) -> str:
    """How far every cell is, for people.

    Args:
        suite: the suite.
        out: folder of the batch.
    """
    states = {name: read_state(out, name) for name in suite.cells}
    width = max(map(len, states))
    lines = []
    for name, state in states.items():
        more = f"{state.wall_s:9.1f} s" if state.state in ("done", "failed") else ""
        tries = f"  attempt {state.attempts}" if state.attempts > 1 else ""
        error = f"  {state.error}" if state.error else ""
        lines.append(f"{name:<{width}}  {state.state:<8}{more}{tries}{error}".rstrip())
    counts = [
        f"{count} {word}"
        for word in ("done", "running", "waiting", "failed")
        if (count := sum(state.state == word for state in states.values()))
    ]
    return "\n".join([*lines, ", ".join(counts)])
