"""Digests of files that are read again only after they changed."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from duagc.pipeline.base.files import digest_of_bytes
from duagc.pipeline.cache.publish import publish

_TICK_NS, _COARSE_TICK_NS = 20_000_000, 2_000_000_000
"""For so long a file may change again without getting another time: a tick of the kernel, or of a coarse disk."""


@dataclass(frozen=True)
class FileDigest:
    """What a file is.

    Attributes:
        content: as `duagc digest` prints it: of a log over its messages.
        raw: SHA-256 of its bytes.
        size: in bytes.
    """

    content: str
    raw: str
    size: int


class FileDigests:
    """Digests by path. A file whose size, times and inode are those of the last time is not read again."""

    def __init__(self, folder: Path | None) -> None:
        """Take the folder in which digests are kept; no file is read yet.

        Args:
            folder: where digests are kept between processes; None: nothing is kept.
        """
        self._folder = folder

    def of(self, path: Path) -> FileDigest:
        """The digests of a file.

        Args:
            path: of the file.

        Raises:
            DuagError: it cannot be read, or is a damaged log.
        """
        from duagc.pipeline.runs.digest import digest_file

        path = Path(os.path.abspath(path))
        state = _state(path)
        if state is not None and (found := self._stored(path, state)) is not None:
            return found
        content = digest_file(path)
        raw = digest_of_bytes(path) if path.suffix == ".mcap" else content
        found = FileDigest(content, raw, path.stat().st_size)
        if state is not None and state == _state(path):
            self._keep(path, state, found)
        return found

    def raw(self, path: Path) -> str:
        """SHA-256 of the bytes of a file.

        Args:
            path: of the file.
        """
        path = Path(os.path.abspath(path))
        state = _state(path)
        known = None if state is None else self._stored(path, state)
        return digest_of_bytes(path) if known is None else known.raw

    def keep(self, path: Path, digest: FileDigest) -> None:
        """Remember the digests of a file that was just written from known bytes.

        Args:
            path: of the file.
            digest: what it is.
        """
        path = Path(os.path.abspath(path))
        if (state := _state(path)) is not None:
            self._keep(path, state, digest)

    def _file(self, path: Path) -> Path | None:
        if self._folder is None:
            return None
        return self._folder / f"{hashlib.sha256(os.fsencode(path)).hexdigest()[:32]}.json"

    def _stored(self, path: Path, state: list[int]) -> FileDigest | None:
        file = self._file(path)
        try:
            content = json.loads(file.read_bytes()) if file is not None else None
            if content is None or content["state"] != state or content["path"] != str(path):
                return None
            return FileDigest(**content["digest"])
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def _keep(self, path: Path, state: list[int], digest: FileDigest) -> None:
        file = self._file(path)
        if file is None:
            return
        with suppress(OSError):  # a store that can only be read
            publish(file, json.dumps({"path": str(path), "state": state, "digest": vars(digest)}).encode())
            changed_ns = max(state[2:])
            tick_ns = _TICK_NS if changed_ns % 1_000_000_000 else _COARSE_TICK_NS
            if file.stat().st_mtime_ns - changed_ns < tick_ns:  # the clock of the disk gave both times
                file.unlink()


def _state(path: Path) -> list[int] | None:
    """Size, times and inode; None if there is no such file."""
    try:
        found = path.stat()
    except OSError:
        return None
    return [found.st_size, found.st_ino, found.st_mtime_ns, found.st_ctime_ns]
