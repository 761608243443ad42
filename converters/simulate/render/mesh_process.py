"""Reads meshes in a process of their own, `layouts.mesh_reader`: whatever ends it becomes one line about a file."""

import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track

Answer = dict[str, str]
Process = subprocess.Popen[bytes]

COMPOUND = (".obj", ".gltf")  # may take materials, buffers and textures from other files
OTHERS = (".mtl", ".bin", ".png", ".jpg", ".jpeg")
IDLE_S = 4  # without any work: it waits for something that does not come


def read(files: list[Path], up: str, cache: Path) -> None:
    """Read meshes and write them as one scene into `cache`, an empty folder.

    Args:
        files: of the meshes, all in one folder.
        up: the axis that is up in them, "y" or "z".
        cache: an existing folder, gets the arrays.
    Raises:
        DuagError: a file that cannot be read, or not within the limits of `duagc.converters.layouts.mesh_reader`.
    """
    with _started() as (process, answers_fd, reader_fd):
        job = {"tell": reader_fd, "files": _with_sizes(files), "up": up, "cache": str(cache)}
        assert process.stdin is not None
        with suppress(BrokenPipeError):  # its end is noticed below
            process.stdin.write(json.dumps(job).encode() + b"\n")
        answers = _answers(process, answers_fd)
        for path in track(files, "read meshes"):
            _check(next(answers), path)
        _check(next(answers), files[0].parent)


@contextmanager
def _started() -> Iterator[tuple[Process, int, int]]:
    """The process, a pipe from it, and the number of the other end there; it is gone afterward."""
    answers_fd, reader_fd = os.pipe()
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(os.path.abspath(entry) for entry in sys.path),
        "MALLOC_ARENA_MAX": "2",  # each takes 64 MB of the address space, which is limited
    }
    try:
        try:
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", "duagc.converters.layouts.mesh_reader"],
                bufsize=0,
                stdin=subprocess.PIPE,  # it ends when this does
                stdout=subprocess.DEVNULL,  # libraries write there what is said in one line here
                stderr=subprocess.DEVNULL,
                pass_fds=[reader_fd],
                env=environment,
            )
        finally:
            os.close(reader_fd)
        with process:
            try:
                yield process, answers_fd, reader_fd
            finally:
                process.kill()
    finally:
        os.close(answers_fd)


def _with_sizes(files: list[Path]) -> list[tuple[str, int]]:
    """Every file with the number of bytes that belong to it: the limits grow with them."""
    other_bytes = 0
    if any(path.suffix.lower() in COMPOUND for path in files):
        for folder, _, names in os.walk(files[0].parent):
            paths = (os.path.join(folder, name) for name in names if name.lower().endswith(OTHERS))
            other_bytes += sum(os.path.getsize(path) for path in paths if os.path.isfile(path))
    return [
        (str(path), path.stat().st_size + (other_bytes if path.suffix.lower() in COMPOUND else 0))
        for path in files
    ]


def _answers(process: Process, answers_fd: int) -> Iterator[Answer]:
    """What the process reports; {"end": ...} when it ended, or had to be, without a word."""
    rest, idle_s, before = b"", 0, -1
    while True:
        if not select.select([answers_fd], [], [], 1.0)[0]:
            asleep, work = _state(process.pid)
            idle_s, before = (idle_s + 1 if asleep and work == before else 0), work
            if idle_s >= IDLE_S:
                yield {"end": "waits for something that does not come (is a texture a pipe?)"}
            continue
        data = os.read(answers_fd, 1 << 16)
        if not data:
            yield {"end": _end(process.wait())}
        idle_s, (*lines, rest) = 0, (rest + data).split(b"\n")
        yield from map(json.loads, lines)


def _state(pid: int) -> tuple[bool, int]:
    """Whether a process sleeps (not for a disc or for its turn), and how long it has worked, in ticks."""
    try:
        state, *numbers = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:  # a system without
        return False, 0
    return state == "S", int(numbers[10]) + int(numbers[11])


def _end(code: int) -> str:
    if code == -signal.SIGXCPU:
        return "takes longer to read than any sound mesh of its size"
    name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return f"ends the library that reads meshes by {name}"


def _check(answer: Answer, path: Path) -> None:
    """Raise what an answer says, if it is bad."""
    if "error" in answer:
        raise DuagError(answer["error"])
    if "end" in answer:
        raise DuagError(f"{path}: {answer['end']}, expected a sound mesh")
    if "bug" in answer:
        raise RuntimeError(f"{path}: {answer['bug']}")
