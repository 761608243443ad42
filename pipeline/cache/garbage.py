"""Bounding a store: what was not used for longest goes first."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cache.publish import publish
from duagc.pipeline.cache.store import CHECKPOINTS, LEFTOVER_S, _read

LEFTOVER_NS = LEFTOVER_S * 1_000_000_000


@dataclass(frozen=True)
class Collected:
    """What became of a store.

    Attributes:
        entries: that were removed.
        freed_bytes: of objects and leftovers that were removed.
        kept_entries: that remain.
        kept_bytes: of their objects.
    """

    entries: int
    freed_bytes: int
    kept_entries: int
    kept_bytes: int


def collect(folder: Path, largest_bytes: int, dry: bool = False) -> Collected:
    """Remove entries until their objects fit, and what no entry needs.

    Runs may use the store meanwhile: a result that they miss is computed again. What is younger than an hour and named
    by no entry is kept, since somebody may be about to name it.

    Args:
        folder: of the store.
        largest_bytes: that the objects may have in all.
        dry: remove nothing, only count.

    Raises:
        DuagError: there is no store, or it cannot be written.
    """
    if not (folder / "entries").is_dir():
        raise DuagError(f"{folder}: has no entries, expected a store; see `--store` and $DUAGC_STORE")
    now_ns = _now_ns(folder)
    needed, entries = _by_use(folder)
    sizes = {path.name: found.st_size for path, found in _files(folder / "objects") if len(path.name) == 64}
    total, kept, users = 0, 0, dict[str, int]()
    removed: list[Path] = []
    for path in entries:  # last used first
        new = [raw for raw in set(needed[path]) if raw not in users]
        size = sum(sizes.get(raw, 0) for raw in new)
        if total + size > largest_bytes or removed:
            removed.append(path)
            continue
        total, kept = total + size, kept + 1
        users |= dict.fromkeys(new, 1)
    orphans = {raw for path in removed for raw in needed[path]} - set(users)
    freed = 0
    for path in removed:
        if not dry:
            path.unlink(missing_ok=True)
    for path, found in _files(folder):
        old = now_ns - found.st_mtime_ns > LEFTOVER_NS
        unnamed = path.parent.parent.name == "objects" and path.name not in users
        if (unnamed and (old or path.name in orphans)) or (path.suffix == ".part" and old):
            freed += found.st_size
            if not dry:
                path.unlink(missing_ok=True)
    for unfinished in (folder / CHECKPOINTS).glob("*"):
        states = [found for _, found in _files(unfinished)]
        if now_ns - max((found.st_mtime_ns for found in states), default=0) > LEFTOVER_NS:
            freed += sum(found.st_size for found in states)
            if not dry:
                shutil.rmtree(unfinished, ignore_errors=True)
    if not dry:
        _forget_files(folder)
        for claimed in (folder / "claims").glob("*.dead"):
            shutil.rmtree(claimed, ignore_errors=True)
    return Collected(len(removed), freed, kept, total)


def _now_ns(folder: Path) -> int:
    """The time by the clock of the disk, which is not that of this machine where the disk is elsewhere."""
    path = folder / "now"
    try:
        publish(path, b"")
        return path.stat().st_mtime_ns
    except OSError as error:
        raise DuagError(f"{folder}: {error.strerror or error}, expected a store to write to") from error


def _by_use(folder: Path) -> tuple[dict[Path, list[str]], list[Path]]:
    """Objects of every sound entry, and the entries, last used first; damaged ones come last and have none."""
    needed: dict[Path, list[str]] = {}
    used: dict[Path, int] = {}
    for path in (folder / "entries").rglob("*.json"):
        with suppress(FileNotFoundError):
            used[path] = path.stat().st_mtime_ns
            try:
                needed[path] = [digest.raw for digest in _read(path).files.values()]
            except (ValueError, KeyError, TypeError):
                needed[path], used[path] = [], -1
    return needed, sorted(used, key=lambda path: (-used[path], path.name))


def _files(folder: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Files with their sizes and times; other processes may remove some meanwhile."""
    for where, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):
                yield Path(where, name), Path(where, name).stat()


def _forget_files(folder: Path) -> None:
    """Digests of files that are gone."""
    import json

    for path in (folder / "files").glob("*.json"):
        try:
            gone = not Path(json.loads(path.read_bytes())["path"]).exists()
        except (OSError, ValueError, KeyError, TypeError):
            gone = True
        if gone:
            path.unlink(missing_ok=True)
