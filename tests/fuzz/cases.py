"""Runs a reader on damaged files, within limits of memory and time.

Cases run one after the other in a process that ends after `BATCH` of them, or with the first that fails. What comes
before a case must not decide how it ends: a failed one runs again in a process of its own, and is said to depend on
others if it is sound there.
"""

from __future__ import annotations

import faulthandler
import gc
import hashlib
import json
import os
import resource
import select
import shutil
import signal
import stat
import tempfile
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np

from duagc.pipeline.base.errors import DuagError
from tests.fuzz import mutate
from tests.fuzz.readers import Reader

MEMORY_BYTES = 2 << 30
CPU_S = 10
IDLE_S = 10  # without work; a machine that has no time for a process does not count
AWAKE = 0.05  # share of a processor that is no work: who waits for the interpreter's lock looks 200 times a second
BATCH = 100
LONG_AGO = (10**9, 10**9)  # s; whatever is written later has another time
SHARED_MEMORY = "/dev/shm"  # no disc waits there


@dataclass(frozen=True)
class Outcome:
    """Of one case: "read", "refused", or "failed"; text: the error line or what is wrong; what: was done to it."""

    number: int
    kind: str
    text: str
    what: str


@contextmanager
def seeded(reader: Reader) -> Iterator[Path]:
    """A folder with the undamaged files of a reader, which it must be able to read and must leave as they are."""
    threads = _threads()
    place = SHARED_MEMORY if os.access(SHARED_MEMORY, os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix=f"fuzz-{reader.name}-", dir=place) as folder:
        root = Path(folder)
        (root / "seed").mkdir()
        reader.make(root / "seed")
        for path in (root / "seed").rglob("*"):
            os.utime(path, LONG_AGO)
        (root / "trial").mkdir()
        before = _contents(root / "seed")
        reader.read(root / "seed", root / "trial")  # imports everything, and must work
        shutil.rmtree(root / "trial")
        # a lock that another thread holds would be locked for ever in the processes of the batches
        _settle_threads(threads)
        gc.collect()
        gc.freeze()
        yield root
        assert _contents(root / "seed") == before, "a case has changed files of others"


def _contents(root: Path) -> dict[str, str]:
    files = [path for path in sorted(root.rglob("*")) if path.is_file()]
    return {path.as_posix(): hashlib.sha1(path.read_bytes()).hexdigest() for path in files}


def run_case(reader: Reader, root: Path, number: int) -> Iterator[str]:
    """One damage in this process: yields "damage" and what it is, then how the case ended and the text."""
    rng = np.random.default_rng([number, *reader.name.encode()])
    case = root / f"case-{number}"
    place = case / "a" / "b" / "c"  # so that paths upwards stay within the case
    src, out = place / "src", place / "out"
    try:
        shutil.copytree(root / "seed", src, copy_function=os.link)
        yield f"damage {mutate.damage(src, rng, reader.special)}"
        out.mkdir()
        _settle(src)
        before, open_before = _state(case, out), _open_files()
        kind, text = _ended(reader, src, out)
        changed = sorted(_state(case, out) ^ before)
        if changed:
            kind, text = "failed", f"changed outside its output: {changed[0][0]}"
        if os.path.lexists(mutate.EVIL):
            kind, text = "failed", f"wrote {mutate.EVIL}"
        if _open_files() != open_before:
            gc.collect()
            ends = time.monotonic() + 2.0
            # threads that read ahead are not waited for: they end by themselves
            while (more := sorted(set(_open_files()) - set(open_before))) and time.monotonic() < ends:
                time.sleep(0.01)
            if more:
                kind, text = "failed", f"left open: {more}"
        _end_threads()  # what is about to end is not left
        if threading.active_count() > 1:
            kind, text = "failed", f"left threads: {threading.enumerate()}"
        yield f"{kind} {text}"
    finally:
        shutil.rmtree(case, ignore_errors=True)


def _end_threads() -> None:
    """Wait for threads that read ahead, which nobody else waits for."""
    for thread in threading.enumerate():
        if thread is not threading.main_thread():
            thread.join(timeout=1.0)


def _settle_threads(before: int) -> None:
    """Wait until there are no more threads than before for the system too. One that Python has joined may still hold a
    lock of OpenCV, which frees what belongs to the thread: a copy of the process would never get it."""
    _end_threads()
    ends = time.monotonic() + 60.0
    while (now := _threads()) > before:
        if time.monotonic() > ends:
            raise RuntimeError(f"found {now} threads, expected {before}: {threading.enumerate()}")
        time.sleep(0.001)


def _threads() -> int:
    """How many threads this process has; a list of /proc/self/task may miss some while others end."""
    return int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[17])


def _ended(reader: Reader, src: Path, out: Path) -> tuple[str, str]:
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, hard))
    spent = int(time.process_time()) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (spent + CPU_S, resource.RLIM_INFINITY))
    try:
        reader.read(src, out)
        kind, text = "read", ""
    except DuagError as error:
        kind, text = "refused", str(error)
        if not text.isprintable():
            kind, text = "failed", f"an error of several lines: {text}"
    except BaseException:
        kind, text = "failed", traceback.format_exc()
    resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    if peak * 1024 > MEMORY_BYTES:
        kind, text = "failed", f"{peak // 1024} MB of memory"
    return kind, text


def _settle(root: Path) -> None:
    """Make what was damaged old, as all else is."""
    for path in root.rglob("*"):
        if stat.S_ISREG(path.lstat().st_mode):
            os.utime(path, LONG_AGO)


def _state(root: Path, but: Path) -> set[tuple[Any, ...]]:
    """What is below a folder, but for one: names, kinds, inodes, sizes and times. Whoever changes a file changes one of
    them, since all files are old."""
    found: set[tuple[Any, ...]] = set()
    for folder, folders, files in os.walk(root):
        if folder == str(but.parent):
            folders.remove(but.name)
        for name in (*folders, *files):
            path = os.path.join(folder, name)
            seen = os.lstat(path)
            content = (seen.st_size, seen.st_mtime_ns) if stat.S_ISREG(seen.st_mode) else None
            found.add((path[len(str(root)) + 1 :], seen.st_mode, seen.st_ino, content))
    return found


def _open_files() -> list[str]:
    """What this process holds open, but for the folder that says so."""
    names = []
    for number in os.listdir("/proc/self/fd"):
        with suppress(FileNotFoundError):
            names.append(f"{number}: {os.readlink(f'/proc/self/fd/{number}')}")
    return names


def _batch(reader: Reader, root: Path, numbers: range) -> Iterator[Outcome]:
    """Cases in one process, up to the first that fails."""
    stated, tell = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(stated)
        _work(reader, root, numbers, tell)
    os.close(tell)
    what, number, outcome = "", numbers.start, None
    with open(stated, "rb", buffering=0) as pipe:
        for line in _lines(pipe, child, root / "crash"):
            key, _, text = json.loads(line).partition(" ")
            if key == "damage":
                what = text
            else:
                outcome = Outcome(number, key, text, what)
                yield outcome
                what, number = "", number + 1
    os.killpg(child, signal.SIGKILL)  # no process is left that one of the cases has started
    _, status = os.waitpid(child, 0)
    if number < numbers.stop and not (outcome and outcome.kind == "failed"):
        yield Outcome(number, "failed", _crash(status, root / "crash"), what)
        shutil.rmtree(root / f"case-{number}", ignore_errors=True)


def _lines(pipe: BinaryIO, child: int, trace: Path) -> Iterator[bytes]:
    """What a child states, until it ends, or waits for `IDLE_S` for something that does not come; then it writes to
    `trace` where."""
    rest, idle_s, before, awake = b"", 0, 0, AWAKE * os.sysconf("SC_CLK_TCK")
    while idle_s < IDLE_S:
        if not select.select([pipe], [], [], 1.0)[0]:
            asleep, work = _session(child)
            idle_s, before = (idle_s + 1 if asleep and work - before <= awake else 0), work
            continue
        data = pipe.read(1 << 16)
        if not data:
            return
        idle_s, (*lines, rest) = 0, (rest + data).split(b"\n")
        yield from lines
    _tell_where(child, trace)


def _tell_where(child: int, trace: Path) -> None:
    """Have a child write to `trace` where its threads are; until there is something, and for a second no more."""
    os.kill(child, signal.SIGUSR1)
    ends, size, same = time.monotonic() + 30.0, 0, 0
    while same < 2 and time.monotonic() < ends:
        time.sleep(0.5)
        before, size = size, trace.stat().st_size if trace.exists() else 0
        same = same + 1 if size == before > 0 else 0


def _session(leader: int) -> tuple[bool, int]:
    """Whether all processes of a session sleep (not for a disc or for their turn), and how long they have worked."""
    states, work = "", 0
    for entry in os.listdir("/proc"):
        if entry.isdecimal():
            with suppress(OSError):
                state, *numbers = Path(f"/proc/{entry}/stat").read_text().rpartition(")")[2].split()
                if int(numbers[2]) == leader:
                    states += state
                    work += sum(map(int, numbers[10:14]))
    return bool(states) and set(states) <= set("SZ"), work


def _crash(status: int, trace: Path) -> str:
    """Why a process ended that had not finished a case."""
    if not os.WIFSIGNALED(status):
        return f"ended with {os.WEXITSTATUS(status)}"
    number, where = os.WTERMSIG(status), trace.read_text(errors="replace") if trace.exists() else ""
    if number == signal.SIGKILL:
        return f"{where}\nwaits: slept for {IDLE_S} s"
    if number == signal.SIGXCPU:
        return f"more than {CPU_S} s"
    return f"{where}\nsignal {number}"


def _work(reader: Reader, root: Path, numbers: range, tell: int) -> NoReturn:
    """What the process of a batch does."""
    try:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        null = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(null, stream)
        with (root / "crash").open("w") as trace:
            faulthandler.enable(trace)
            faulthandler.register(signal.SIGUSR1, trace)
            for number in numbers:
                for line in run_case(reader, root, number):
                    os.write(tell, json.dumps(line).encode() + b"\n")
                if line.startswith("failed "):
                    break
    except BaseException:
        os.write(tell, json.dumps(f"failed {traceback.format_exc()}").encode() + b"\n")
    finally:
        os._exit(0)


def cases(reader: Reader, count: int, first: int = 0) -> Iterator[Outcome]:
    """Damage `count` times, from number `first` on."""
    with seeded(reader) as root:
        number, last = first, first + count
        while number < last:
            start = number
            for outcome in _batch(reader, root, range(start, min(start + BATCH, last))):
                number = outcome.number + 1
                if outcome.kind == "failed" and outcome.number > start:
                    (alone,) = _batch(reader, root, range(outcome.number, number))
                    after = f"sound alone, but not after {start} to {number - 2}: {outcome.text}"
                    outcome = alone if alone.kind == "failed" else replace(outcome, text=after)
                yield outcome
