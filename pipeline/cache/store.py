"""A store of results by what they were computed from; one for many runs and processes.

    objects/<2 hex>/<64 hex>              bytes of a result, named by their SHA-256
    entries/<stage>/<robot>/<64 hex>.json results of a computation, named by its key
    claims/<64 hex>/                      computations that somebody does now
    checkpoints/<64 hex>/                 where a computation is that was not finished (`base.checkpoints`)
    files/*.json, code.json               digests of files and of code, so that they are not read twice

Everything appears by rename, and every object is compared with its name when it is used. Nothing needs a lock.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cache.claims import claim
from duagc.pipeline.cache.code_identity import CodeReader
from duagc.pipeline.cache.file_digests import FileDigest, FileDigests
from duagc.pipeline.cache.publish import publish, temporary
from duagc.pipeline.cache.stage_key import StageKey

ENVIRONMENT, FOLDER = "DUAGC_STORE", ".duagc-store"
CHECKPOINTS = "checkpoints"
SCHEMA = 1
TEAM = "team"  # in place of a robot, which cannot be named so in a folder of entries of a stage of the team
LEFTOVER_S = 3600  # a file without its final name that is older was left by a process that is dead
_CHUNK = 1 << 20


class DamagedEntryError(Exception):
    """A stored result is not what its digest says, or is gone."""


@dataclass(frozen=True)
class StoredResults:
    """The results of one computation.

    Attributes:
        key: what it was computed from.
        files: digests of its files, by path in the folder of the run.
        result: what it returned, as plain values.
        timing: what it took when it was computed.
    """

    key: StageKey
    files: Mapping[str, FileDigest]
    result: Any = None
    timing: Mapping[str, Any] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """As plain values."""
        files = {name: vars(digest) for name, digest in self.files.items()}
        return {
            "schema": SCHEMA,
            "key": self.key.plain(),
            "files": files,
            "result": self.result,
            "timing": dict(self.timing),
        }


PARTS = frozenset(("checkpoints", "claims", "code.json", "entries", "files", "objects"))
"""What a store consists of, as far as it was needed."""


def default_store(out: Path) -> Path:
    """Where results are kept: $DUAGC_STORE, else a folder next to the run.

    Args:
        out: folder of the run.
    """
    named = os.environ.get(ENVIRONMENT)
    return Path(os.path.expanduser(named)) if named else Path(os.path.abspath(out)).parent / FOLDER


class Store:
    """Results by key."""

    def __init__(self, folder: Path) -> None:
        """Open a store; it is made when something is kept.

        Args:
            folder: of the store.

        Raises:
            DuagError: something else is there, or it cannot be read.
        """
        self.folder = Path(folder)
        if self.folder.exists() and not self.folder.is_dir():
            raise DuagError(f"{folder}: is no folder, expected that of a store")
        try:
            names = {path.name for path in self.folder.iterdir()} if self.folder.is_dir() else set()
        except OSError as error:
            raise DuagError(f"{folder}: {error.strerror or error}, expected a store") from error
        if names and not names & PARTS:
            raise DuagError(f"{folder}: holds {min(names)}, expected a store or an empty folder")
        self.files = FileDigests(self.folder / "files")
        self.code = CodeReader(self.folder / "code.json")

    def find(self, key: StageKey, say: Callable[[str], None] = lambda line: None) -> StoredResults | None:
        """The results for a key; None if there are none.

        Args:
            key: of the computation.
            say: gets a line if an entry is damaged, which is then removed, or cannot be read.
        """
        path = self._entry(key)
        try:
            entry = _read(path)
        except FileNotFoundError:
            return None
        except OSError as error:  # of this process: others may still read it
            say(f"{path}: {error.strerror or error}, expected a stored result; computed again")
            return None
        except (ValueError, KeyError, TypeError) as error:
            say(f"{path}: is damaged ({error}); computed again")
            with suppress(OSError):
                path.unlink()
            return None
        with suppress(OSError):
            os.utime(path)  # `gc` removes what was not used for longest
        return entry

    def take(self, entry: StoredResults, folder: Path, also: Path | None = None) -> None:
        """Copy the files of an entry, and compare them with their digests.

        Args:
            entry: of this store.
            folder: of the run.
            also: folder of a run that may have them, if the store does not.

        Raises:
            DamagedEntryError: a file is not what it was; it is removed from the store.
            OSError: they cannot be written.
        """
        for name, digest in entry.files.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            stored = self._object(digest.raw)
            source = also / name if also is not None and not stored.is_file() else stored
            part = temporary(target)
            try:
                with part.open("wb") as stream:
                    found = _copy_digest(source, stream.write)
                if found != digest.raw:
                    if source == stored:
                        with suppress(OSError):
                            source.unlink()
                    raise DamagedEntryError(f"{source}: has digest {found[:12]}, expected {digest.raw[:12]}")
                os.replace(part, target)
            except OSError as error:  # of a full disk, none says where
                raise OSError(error.errno, error.strerror, error.filename or str(target)) from error
            finally:
                part.unlink(missing_ok=True)
            self.files.keep(target, digest)

    def keep(self, entry: StoredResults, folder: Path) -> None:
        """Store results: the files first, so that an entry names what is there.

        Args:
            entry: what was computed.
            folder: of the run that has its files.

        Raises:
            OSError: there is no room, or the store can only be read.
        """
        for name, digest in entry.files.items():
            self._keep_object(folder / name, digest)
        content = json.dumps(entry.plain(), sort_keys=True)
        whole = hashlib.sha256(content.encode()).hexdigest()
        publish(self._entry(entry.key), f"{whole}\n{content}\n".encode())

    def forget(self, key: StageKey) -> None:
        """Remove an entry.

        Args:
            key: of it.
        """
        with suppress(OSError):
            self._entry(key).unlink()

    def checkpoints(self, key: StageKey) -> Path:
        """The folder in which a computation saves where it is.

        Args:
            key: of the computation.
        """
        return self.folder / CHECKPOINTS / key.digest

    def forget_checkpoints(self, key: StageKey) -> None:
        """Remove them.

        Args:
            key: of the computation, which is finished or begins anew.
        """
        shutil.rmtree(self.checkpoints(key), ignore_errors=True)

    @contextmanager
    def claimed(self, key: StageKey, waiting: Callable[[], None]) -> Iterator[bool]:
        """Be the one process that computes something, while the block runs.

        Args:
            key: of the computation.
            waiting: called once if another process does it.

        Yields:
            Whether it is this process; if not, another one has finished it meanwhile.
        """
        folder = self.folder / "claims" / key.digest
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            taken = claim(folder, lambda: self._entry(key).is_file(), waiting)
        except OSError:
            yield True  # a store that can only be read keeps nothing, and nobody waits for it
            return
        if taken is None:
            yield False
            return
        with taken:
            yield True

    def latest(self, key: StageKey) -> StoredResults | None:
        """The entry of the same stage and robot whose key is most like another one; of equals the last one used.

        Args:
            key: that has no entry, or whose entry is not meant.
        """
        best: tuple[int, StoredResults] | None = None
        for entry in _newest(self._entry(key).parent.glob("*.json"), 50):
            distance = key.distance(entry.key)
            if distance and (best is None or distance < best[0]):
                best = distance, entry
        return None if best is None else best[1]

    def recent(self, stage: str, most: int) -> list[StoredResults]:
        """Results of a stage, last used first; damaged ones are left out.

        Args:
            stage: its name.
            most: how many.
        """
        return list(_newest((self.folder / "entries" / stage).glob("*/*.json"), most))

    def earlier(self, key: StageKey, digest: str) -> StoredResults | None:
        """The results of the same stage and robot for another key; None if they are gone.

        Args:
            key: of the stage and robot.
            digest: of the other key.
        """
        try:
            return _read(self._entry(key).with_name(f"{digest}.json"))
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def _entry(self, key: StageKey) -> Path:
        return self.folder / "entries" / key.stage / (key.robot or TEAM) / f"{key.digest}.json"

    def _object(self, raw: str) -> Path:
        return self.folder / "objects" / raw[:2] / raw

    def _keep_object(self, source: Path, digest: FileDigest) -> None:
        target = self._object(digest.raw)
        with suppress(OSError):
            if target.stat().st_size == digest.size:
                os.utime(target)  # `gc` leaves alone what is about to be named
                return
        target.parent.mkdir(parents=True, exist_ok=True)
        part = temporary(target)
        try:
            shutil.copyfile(source, part)
            os.replace(part, target)
        except OSError:
            with suppress(OSError):
                part.unlink(missing_ok=True)
            raise


def _newest(paths: Iterable[Path], most: int) -> Iterator[StoredResults]:
    """Sound entries, last used first; other processes may remove some meanwhile."""
    used = []
    for path in paths:
        with suppress(OSError):
            used.append((path.stat().st_mtime_ns, path))
    for _, path in sorted(used, reverse=True)[:most]:
        with suppress(OSError, ValueError, KeyError, TypeError):
            yield _read(path)


def _read(path: Path) -> StoredResults:
    """An entry, compared with the digest in its first line."""
    digest, _, content = path.read_text(encoding="utf-8").partition("\n")
    if hashlib.sha256(content.rstrip("\n").encode()).hexdigest() != digest:
        raise ValueError("other digest")
    plain = json.loads(content)
    if plain["schema"] != SCHEMA:
        raise ValueError(f"schema {plain['schema']}, expected {SCHEMA}")
    files = {name: FileDigest(**digest) for name, digest in plain["files"].items()}
    return StoredResults(StageKey(**plain["key"]), files, plain["result"], plain["timing"])


def _copy_digest(source: Path, write: Callable[[bytes], Any]) -> str:
    whole = hashlib.sha256()
    try:
        stream = source.open("rb")
    except OSError as error:
        raise DamagedEntryError(f"{source}: {error.strerror or error}") from error
    with stream:
        while chunk := stream.read(_CHUNK):
            whole.update(chunk)
            write(chunk)
    return whole.hexdigest()
