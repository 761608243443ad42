"""The runner itself notices what it is there for."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.errors import DuagError
from tests.fuzz.readers import Reader
from tests.fuzz.run import run


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


def refuse(src: Path, out: Path) -> None:
    raise DuagError(f"{src}: found\ndamage, expected none")


def write(src: Path, out: Path) -> None:
    (out / "result").write_text("x")


@pytest.mark.parametrize(
    ("read", "kind", "words"),
    [
        (crash, "failed", "ValueError: a bug"),
        (die, "failed", "signal 15"),
        (swell, "failed", "MemoryError"),
        (escape, "failed", "changed outside its output: a/b/c/evil"),
        (change, "failed", "changed outside its output: a/b/c/src/file"),
        (refuse, "refused", ""),
        (write, "read", ""),
    ],
)
def test_outcomes(read: Callable[[Path, Path], None], kind: str, words: str) -> None:
    sound = True

    def after_the_seed(src: Path, out: Path) -> None:
        nonlocal sound
        if not sound:
            read(src, out)
        sound = False

    def make(seed: Path) -> None:
        (seed / "file").write_text("1 2 3")

    outcomes, failures = run(Reader("fake", make, after_the_seed, lambda path, rng: False), 1)
    assert dict(outcomes) == {kind: 1}
    assert words in "".join(failures)


def test_errors_are_one_printable_line() -> None:
    assert str(DuagError("/a\nb\x1b[31m: found\r, expected ü")) == "/a\\nb\\x1b[31m: found\\r, expected ü"
