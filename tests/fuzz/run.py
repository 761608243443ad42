"""Runs readers on damaged files, each in a process of its own with limits of memory and time.

    python -m tests.fuzz.run --count 5000 [READER ...]        # all of them by default

A reader may end with one error line (`DuagError`), or with a result that reads back whole. Everything else is a
failure: another exception, a signal, more memory or time, a file outside its output folder, a changed input.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import DuagError
from tests.fuzz import mutate
from tests.fuzz.readers import READERS, Reader

MEMORY_BYTES = 2 << 30
CPU_S = 10
WALL_S = 30  # of sleeping: machines are busy
FAILED = 3


@dataclass(frozen=True)
class Outcome:
    """Of one case: "read", "refused", or "failed"; text: the error line or what is wrong."""

    kind: str
    text: str
    what: str


@contextmanager
def seeded(reader: Reader) -> Iterator[Path]:
    """A folder with the undamaged files of a reader, which it must be able to read."""
    with tempfile.TemporaryDirectory(prefix=f"fuzz-{reader.name}-") as folder:
        root = Path(folder)
        (root / "seed").mkdir()
        reader.make(root / "seed")
        (root / "trial").mkdir()
        reader.read(root / "seed", root / "trial")  # imports everything, and must work
        yield root


def run_case(reader: Reader, root: Path, number: int) -> Outcome:
    """One damage, one process."""
    rng = np.random.default_rng([number, *reader.name.encode()])
    place = root / f"case-{number}" / "a" / "b" / "c"  # so that paths upwards stay within the case
    src = place / "src"
    shutil.copytree(root / "seed", src, copy_function=os.link)
    what = mutate.damage(src, rng, reader.special)
    (place / "out").mkdir()
    before = _state(place.parents[2], place / "out")
    try:
        kind, text = _in_process(reader, src, place / "out", root / f"case-{number}.txt")
        after = _state(place.parents[2], place / "out")
        if after != before:
            changed = sorted(set(after.items()) ^ set(before.items()))
            kind, text = "failed", f"changed outside its output: {changed[0][0]}"
    finally:
        shutil.rmtree(root / f"case-{number}", ignore_errors=True)
    return Outcome(kind, text, what)


def _state(root: Path, but: Path) -> dict[str, str]:
    """What is below a folder, but for one."""
    found = {}
    for path in sorted(root.rglob("*")):
        if path == but or but in path.parents:
            continue
        kind = "link" if path.is_symlink() else "folder" if path.is_dir() else "file"
        regular = kind == "file" and path.is_file()
        content = hashlib.sha1(path.read_bytes()).hexdigest() if regular else kind
        found[path.relative_to(root).as_posix()] = content
    return found


def _in_process(reader: Reader, src: Path, out: Path, said: Path) -> tuple[str, str]:
    child = os.fork()
    if child == 0:
        _child(reader, src, out, said)
    start = time.monotonic()
    while True:
        pid, status, used = os.wait4(child, os.WNOHANG)
        if pid:
            break
        if time.monotonic() - start > WALL_S:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "failed", f"slept for {WALL_S} s"
        time.sleep(0.002)
    text = said.read_text() if said.exists() else ""
    said.unlink(missing_ok=True)
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        hung = number in (signal.SIGXCPU, signal.SIGKILL)
        return "failed", f"more than {CPU_S} s" if hung else f"signal {number}: {text}"
    code = os.WEXITSTATUS(status)
    if used.ru_maxrss * 1024 > MEMORY_BYTES:
        return "failed", f"{used.ru_maxrss // 1024} MB of memory"
    return {0: "read", 1: "refused"}.get(code, "failed"), text


def _child(reader: Reader, src: Path, out: Path, said: Path) -> None:
    """Never returns."""
    code, text = FAILED, "no outcome"
    try:
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, hard))
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        null = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(null, stream)
        try:
            reader.read(src, out)
            code, text = 0, ""
        except DuagError as error:
            code, text = 1, str(error)
            if not text.isprintable():
                code, text = FAILED, f"an error of several lines: {text}"
        except BaseException:
            text = traceback.format_exc()
        said.write_text(text, errors="replace")
    finally:
        os._exit(code)


def run(reader: Reader, count: int, first: int = 0, echo: bool = False) -> tuple[Counter[str], list[str]]:
    """`count` cases; returns how many ended how, and one text for each kind of failure."""
    outcomes: Counter[str] = Counter()
    failures: dict[str, str] = {}
    with seeded(reader) as root:
        for number in range(first, first + count):
            outcome = run_case(reader, root, number)
            outcomes[outcome.kind] += 1
            if outcome.kind == "failed":
                place = [line for line in outcome.text.splitlines() if line.startswith('  File "')][-1:]
                key = outcome.text.splitlines()[-1][:60] + "".join(place) if outcome.text else "?"
                failures.setdefault(key, f"{reader.name} {number} ({outcome.what}): {outcome.text}")
            elif echo:
                print(number, outcome.kind, outcome.what, outcome.text[-150:])
    return outcomes, list(failures.values())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("readers", nargs="*", default=sorted(READERS))
    parser.add_argument("--count", type=int, default=5000)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--echo", action="store_true", help="print every case")
    arguments = parser.parse_args()
    failed = 0
    for name in arguments.readers:
        start = time.process_time(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        outcomes, failures = run(READERS[name], arguments.count, arguments.first, arguments.echo)
        spent = (
            resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - start[1] + time.process_time() - start[0]
        )
        print(f"{name}: {dict(sorted(outcomes.items()))}, {spent:.0f} s of CPU", flush=True)
        for text in failures:
            print(text, flush=True)
        failed += outcomes["failed"]
    return 1 if failed else 0


if __name__ == "__main__":
    from pipeline import numeric

    numeric.settle()
    sys.exit(main())
