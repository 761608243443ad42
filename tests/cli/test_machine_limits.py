"""What a machine refuses to give, memory, open files, threads, ends a command with one line that says what to raise."""

import errno
import os
import sys

import cv2
import numpy as np
import pytest

from duagc.pipeline import cli

LIBRARY = "libscipy_openblas.so: failed to map segment from shared object"


def os_error(number: int) -> OSError:
    return OSError(number, os.strerror(number))


def array_memory_error() -> MemoryError:
    with pytest.raises(MemoryError) as caught:
        np.empty(1 << 60, np.uint8)
    return caught.value


def opencv_error(code: int) -> cv2.error:
    error = cv2.error("Failed to allocate 307200 bytes")
    error.code = code
    return error


@pytest.mark.parametrize(
    ("error", "found", "expected"),
    [
        (os_error(errno.EMFILE), "Too many open files", "ulimit -n"),
        (os_error(errno.EIO), "Input/output error", "can be read to its end"),
        (os_error(errno.ENFILE), "Too many open files in system", "ulimit -n"),
        (os_error(errno.ENOMEM), "Cannot allocate memory", "ulimit -v"),
        (os_error(errno.EAGAIN), "Resource temporarily unavailable", "ulimit -u"),
        (RuntimeError("can't start new thread"), "can't start new thread", "ulimit -u"),
        (ImportError(LIBRARY), "libscipy_openblas.so", "ulimit -v"),
        (MemoryError(), "out of memory", "ulimit -v"),
        (opencv_error(-4), "Failed to allocate", "ulimit -v"),
        (array_memory_error(), "Unable to allocate", "ulimit -v"),
    ],
    ids=str,
)
def test_a_limit_of_the_machine_is_one_line(
    error: Exception,
    found: str,
    expected: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def refused() -> None:
        raise error

    monkeypatch.setattr(cli, "app", refused)
    monkeypatch.setattr(sys, "argv", ["duagc"])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    [line] = capsys.readouterr().err.splitlines()
    assert stop.value.code == 1
    assert line.startswith("duagc: ")
    assert found in line
    assert expected in line


@pytest.mark.parametrize(
    "error", [RuntimeError("a bug"), ImportError("no module"), OSError("a bug")], ids=repr
)
def test_a_bug_is_told_as_one(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise error

    monkeypatch.setattr(cli, "app", broken)
    monkeypatch.setattr(sys, "argv", ["duagc"])
    with pytest.raises(type(error), match=str(error)):
        cli.main()
