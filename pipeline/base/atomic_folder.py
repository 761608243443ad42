"""A folder that appears under its name only when it is finished, and is one process's alone until then."""

import fcntl
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

from duagc.pipeline.base.errors import DuagError


class FolderKind(NamedTuple):
    """What a folder is, and what of it may be lost when it is replaced.

    Attributes:
        name: for messages.
        marks: files of which one marks such a folder.
        contents: names of what is in it, by patterns; that of a folder stands for all that it holds.
    """

    name: str
    marks: tuple[str, ...]
    contents: tuple[str, ...]


_OF_A_RUN = "config.toml manifest.json timing.json metrics.* *.mcap run.rrd report robots calibrated"
RUN = FolderKind("a run", ("manifest.json",), tuple(_OF_A_RUN.split()))
ANYTHING = RUN._replace(contents=("*",))
"""Of a run whose maker brings over what the earlier one in its place holds besides."""
RECORDING = FolderKind("a recording", ("recording.json",), ("recording.json", "*.mcap", "*.ply"))
DEMO = FolderKind(
    "a run",
    (*RUN.marks, "run/manifest.json"),
    (
        *RUN.contents,
        *(f"run/{name}" for name in RUN.contents),
        *(f"recording/{name}" for name in RECORDING.contents),
    ),
)


@contextmanager
def new_folder(out: Path, force: bool, kind: FolderKind = RUN) -> Iterator[Path]:
    """A folder next to `out` that takes its name when the block ends well, and is removed when it does not.

    Args:
        out: name of the finished folder.
        force: replace what is there, if it is empty or of this kind, and holds nothing else. A symbolic link stays,
            and the folder that it names is replaced.
        kind: what may be replaced.

    Yields:
        The folder to write to, empty.

    Raises:
        DuagError: `out` cannot be replaced, or another process writes it.
    """
    _check_out(out, force, kind)
    if out.is_symlink():
        out = out.resolve()  # renaming would move the link
    partial, replaced = (out.with_name(out.name + ending) for ending in (".part", ".replaced.part"))
    with _locked(partial):
        _settle(replaced, out)
        _check_out(out, force, kind)
        yield partial
        _check_out(out, force, kind)  # it may have appeared meanwhile
        if out.exists():
            out.rename(replaced)  # removing takes long: whoever is stopped in it leaves one whole folder
        partial.rename(out)
        _settle(replaced, out)


def check_apart(out: Path, inputs: Sequence[Path]) -> None:
    """Refuse a folder to write that is an input or holds one: replacing the folder would delete it.

    Args:
        out: the folder.
        inputs: files and folders that are read, or kept.

    Raises:
        DuagError: names the input, which lies there or is a link that leads back to itself.
    """
    place = resolved(out)
    for path in inputs:
        if resolved(path).is_relative_to(place):
            raise DuagError(f"{out}: found {path} in it, expected --out apart from what is read or kept")


def resolved(path: Path) -> Path:
    """Where a path leads, without links.

    Args:
        path: of a file or folder, or of what is to be one.

    Raises:
        DuagError: it is a link that leads back to itself.
    """
    try:
        return path.resolve()
    except (OSError, RuntimeError) as error:  # of Python before 3.13
        raise DuagError(f"{path}: a link that leads back to itself, expected a file or a folder") from error


def _settle(replaced: Path, out: Path) -> None:
    """Remove what was replaced; where the process was stopped before the new folder had its name, put it back."""
    if not replaced.exists():
        return
    if not out.exists():
        replaced.rename(out)
        return
    try:
        shutil.rmtree(replaced)
    except OSError as error:
        reason = error.strerror or error
        raise DuagError(
            f"{replaced}: {reason}, expected to remove what was replaced; {out} is whole"
        ) from error


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """An empty folder that is this process's alone; what a killed one has left in it is removed."""
    lock = _lock_of(folder)
    try:
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
        yield
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    finally:
        os.close(lock)


def _lock_of(folder: Path) -> int:
    """Make a folder and lock it, again where another process renames or removes it meanwhile."""
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = _opened(folder)
            if lock is not None and _is_taken(lock, folder):
                return lock
        except OSError as error:
            raise DuagError(f"{folder}: {error.strerror or error}, expected to write a folder") from error
        except KeyboardInterrupt:
            _remove_unlocked(folder)
            raise


def _is_taken(lock: int, folder: Path) -> bool:
    """Lock a folder that was opened; if it has lost its name meanwhile, close it."""
    try:
        _take(lock, folder)
        if _is_named(lock, folder):
            return True
    except BaseException:
        os.close(lock)
        raise
    os.close(lock)
    return False


def _remove_unlocked(folder: Path) -> None:
    """Remove a folder, if it is empty and no process writes it."""
    with suppress(OSError, DuagError):
        lock = os.open(folder, os.O_RDONLY)
        try:
            _take(lock, folder)
            folder.rmdir()
        finally:
            os.close(lock)


def _opened(folder: Path) -> int | None:
    try:
        return os.open(folder, os.O_RDONLY)
    except FileNotFoundError:  # it was there a moment ago
        return None


def _take(lock: int, folder: Path) -> None:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the kernel gives it up with the process
    except BlockingIOError as error:
        raise DuagError(f"{folder}: another process is writing it; wait, or choose another --out") from error


def _is_named(lock: int, folder: Path) -> bool:
    """Whether what is locked still has the name: its last owner may have given it another one, or removed it."""
    try:
        return os.path.samestat(os.fstat(lock), os.stat(folder))
    except FileNotFoundError:
        return False


def _check_out(out: Path, force: bool, kind: FolderKind) -> None:
    """Refuse to replace what is there, unless `force` and nothing of another kind would be lost."""
    if not out.name:
        raise DuagError(f"{out}: found a path without a name, expected the name of a new folder")
    if out.is_symlink() and not out.exists():
        raise DuagError(f"{out}: is a symbolic link to nothing, expected a folder or a new name")
    if not out.exists():
        return
    if not force:
        raise DuagError(f"{out}: exists already; choose another path or give --force")
    if not out.is_dir() or (any(out.iterdir()) and not any((out / mark).is_file() for mark in kind.marks)):
        raise DuagError(f"{out}: is not {kind.name}, expected one; --force replaces nothing else")
    for path in sorted(out.rglob("*")):
        if (path.is_symlink() or not path.is_dir()) and not _is_of(path.relative_to(out).parts, kind):
            raise DuagError(
                f"{path}: --force would remove it, though it is no part of {kind.name}; move it, or choose another name"
            )


def _is_of(parts: Sequence[str], kind: FolderKind) -> bool:
    """Whether a file, or the beginning of one, is among the contents, by the parts of its path in the folder."""
    *folders, name = parts
    names = (*folders, name.removesuffix(".part"))
    wanted = (pattern.split("/") for pattern in kind.contents)
    return any(len(names) >= len(words) and all(map(fnmatchcase, names, words)) for words in wanted)
