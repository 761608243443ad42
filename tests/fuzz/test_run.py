"""The runner itself notices what it is there for."""

import ctypes
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from duagc.pipeline.base.errors import DuagError
from tests.fuzz.cases import cases
from tests.fuzz.readers import Reader


def crash(src: Path, out: Path) -> None:
    raise ValueError("a bug")


def die(src: Path, out: Path) -> None:
    os.kill(os.getpid(), signal.SIGTERM)


def swell(src: Path, out: Path) -> None:
    bytearray(3 << 30)


def escape(src: Path, out: Path) -> None:
    (out.parent / "evil").write_text("x")


def change(src: Path, out: Path) -> None:
    (src / "file").unlink()


def edit(src: Path, out: Path) -> None:
    with (src / "file").open("r+b") as stream:
        stream.write(b"4")


def refuse(src: Path, out: Path) -> None:
    raise DuagError(f"{src}: found\ndamage, expected none")


def write(src: Path, out: Path) -> None:
    (out / "result").write_text("x")


def leave_open(src: Path, out: Path) -> None:
    LEFT.append((src / "file").open())


def start_thread(src: Path, out: Path) -> None:
    threading.Thread(target=time.sleep, args=[9], daemon=True).start()


def wait(src: Path, out: Path) -> None:
    os.read(os.pipe()[0], 1)


def doze(src: Path, out: Path) -> None:
    while True:
        time.sleep(0.005)


def work(src: Path, out: Path) -> None:
    while True:
        pass


def third_fails(src: Path, out: Path) -> None:
    LEFT.append(None)
    if len(LEFT) == 3:
        raise ValueError("too many")


LEFT: list[Any] = []
STARTED: list[str] = []


def fake(read: Callable[[Path, Path], None]) -> Reader:
    """A reader whose sound file is read, and damaged ones by `read`."""

    def after_the_seed(src: Path, out: Path) -> None:
        if src.name != "seed":
            read(src, out)

    def make(seed: Path) -> None:
        (seed / "file").write_text("1 2 3")

    return Reader("fake", make, after_the_seed, lambda path, rng: False)


@pytest.mark.parametrize(
    ("read", "kind", "words"),
    [
        (crash, "failed", "ValueError: a bug"),
        (die, "failed", "signal 15"),
        (swell, "failed", "MemoryError"),
        (escape, "failed", "changed outside its output: a/b/c/evil"),
        (change, "failed", "changed outside its output: a/b/c/src/file"),
        (edit, "failed", "changed outside its output: a/b/c/src/file"),
        (leave_open, "failed", "left open: "),
        (start_thread, "failed", "left threads: "),
        (refuse, "refused", "expected none"),
        (write, "read", ""),
    ],
)
def test_outcomes(read: Callable[[Path, Path], None], kind: str, words: str) -> None:
    outcomes = list(cases(fake(read), 3))
    assert [outcome.number for outcome in outcomes] == [0, 1, 2]
    for outcome in outcomes:
        assert (outcome.kind, words in outcome.text) == (kind, True), outcome.text


@pytest.mark.parametrize(
    ("read", "words"),
    [(wait, " in wait\n"), (doze, " in doze\n"), (wait, "\nwaits: slept"), (work, "more than 1 s")],
)
def test_hangs(read: Callable[[Path, Path], None], words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.fuzz.cases.CPU_S", 1)
    monkeypatch.setattr("tests.fuzz.cases.IDLE_S", 1)
    (outcome,) = cases(fake(read), 1)
    assert (outcome.kind, words in outcome.text) == ("failed", True), outcome.text


def test_no_lock_of_a_thread_that_reads_ahead_is_inherited() -> None:
    lock = threading.Lock()

    def hold() -> None:
        with lock:
            time.sleep(0.3)

    def read(src: Path, out: Path) -> None:
        if src.name == "seed":
            threading.Thread(target=hold).start()
        elif not lock.acquire(timeout=5.0):
            raise ValueError("locked")

    (outcome,) = cases(Reader("fake", fake(read).make, read, lambda path, rng: False), 1)
    assert outcome.kind == "read", outcome.text


def test_a_thread_that_has_been_joined_has_ended_for_the_system_too() -> None:
    libc, key = ctypes.CDLL(None), ctypes.c_uint()
    libc.pthread_key_create(ctypes.byref(key), libc.usleep)  # called after Python has let go of the thread

    def read(src: Path, out: Path) -> None:
        if src.name == "seed":
            thread = threading.Thread(target=lambda: libc.pthread_setspecific(key, ctypes.c_void_p(300_000)))
            thread.start()
            thread.join()
            STARTED.append(str(thread.native_id))
        elif STARTED.pop() in os.listdir(f"/proc/{os.getppid()}/task"):
            raise ValueError("copied while it ended")

    (outcome,) = cases(Reader("fake", fake(read).make, read, lambda path, rng: False), 1)
    assert outcome.kind == "read", outcome.text


def test_a_case_that_depends_on_those_before_it_is_named() -> None:
    outcomes = list(cases(fake(third_fails), 4))
    assert [outcome.kind for outcome in outcomes] == ["read", "read", "failed", "read"]
    assert "sound alone, but not after 0 to 1: " in outcomes[2].text


def test_errors_are_one_printable_line() -> None:
    assert str(DuagError("/a\nb\x1b[31m: found\r, expected ü")) == "/a\\nb\\x1b[31m: found\\r, expected ü"
