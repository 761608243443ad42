"""Stages of a run that are computed once: taken from a store where that has them, else computed and kept."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

from duagc.pipeline.base.checkpoints import Checkpoints, StepReport
from duagc.pipeline.cache.file_digests import FileDigest, FileDigests
from duagc.pipeline.cache.stage_key import StageKey
from duagc.pipeline.cache.store import DamagedEntryError, Store, StoredResults
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.runs.declared_settings import DeclaredSettings
from duagc.pipeline.runs.stages import Stage
from duagc.pipeline.runs.timing import Timing, label

CHANGED = "source that changed meanwhile"
"""Stands among the modules of a key where nobody knows what code the results are of: no other key is like it."""


class NotStoredError(Exception):
    """A stage would have to be computed."""

    def __init__(self, key: StageKey) -> None:
        """Name the stage, and its robot if it has one, in the message.

        Args:
            key: of the stage that the store does not have.
        """
        super().__init__(label(key.stage, key.robot))
        self.key = key


@dataclass(frozen=True)
class Carried:
    """A stage that is done.

    Attributes:
        entry: its results.
        executed: whether it was computed now.
    """

    entry: StoredResults
    executed: bool

    @property
    def label(self) -> str:
        """Name of the stage, and of the robot."""
        return label(self.entry.key.stage, self.entry.key.robot)

    def content(self, name: str) -> str:
        """Content digest of a file.

        Args:
            name: of it, in the folder of the run.
        """
        return self.entry.files[name].content


@dataclass
class Carrier:
    """Carries out stages in the folder of a run.

    Attributes:
        folder: of the run.
        config: of the run.
        store: of results; None: everything is computed, nothing is kept.
        again: names of stages that are computed whatever the store has.
        say: gets a line when something is unusual.
        looking: only look whether the results are there; nothing is copied or computed.
        earlier: what an earlier run in the same place has, by label; `place` is its folder.
        found: gets every stage that is there while only looking.
        begun: called before a stage is computed, or, with True, when it was taken from the store.
    """

    folder: Path
    config: RunConfig
    store: Store | None
    say: Callable[[str], None]
    again: frozenset[str] = frozenset()
    looking: bool = False
    earlier: Mapping[str, Any] = field(default_factory=dict)
    place: Path | None = None
    found: Callable[[Carried], None] = lambda carried: None
    begun: Callable[[StageKey, bool], None] = lambda key, stored: None

    def settings_of(self, stage: Stage) -> RunConfig:
        """The settings that a stage declares; reading any other one is an error.

        Args:
            stage: of the run.
        """
        return cast(RunConfig, DeclaredSettings(self.config, stage.name, stage.settings))

    def key(self, stage: Stage, robot: str | None, inputs: Mapping[str, str]) -> StageKey:
        """What the results of a stage depend on.

        Args:
            stage: of the run.
            robot: whose; None: the team's.
            inputs: content digests, by what they are of.
        """
        if self.store is None:
            return StageKey(stage.name, robot, {}, {}, {}, {})
        code = self.store.code.version_of(stage.code)
        settings = DeclaredSettings(self.config, stage.name, stage.settings).plain()
        return StageKey(stage.name, robot, code.modules, code.libraries, settings, dict(inputs))

    def carry(
        self,
        stage: Stage,
        robot: str | None,
        inputs: Mapping[str, str],
        compute: Callable[[Timing], Any],
        *,
        files: Callable[[], Iterator[Path]] | None = None,
    ) -> Carried:
        """Do a stage, once.

        Args:
            stage: of the run.
            robot: whose; None: the team's.
            inputs: content digests, by what they are of.
            compute: does it, measured, and returns plain values that belong to its results.
            files: that it has written, when it is done; by default those that it declares.

        Raises:
            NotStoredError: it would have to be computed, and `looking` forbids that.
            DuagError: as the stage.
        """
        key = self.key(stage, robot, inputs)
        if self.looking:
            entry = self._find(key)
            if entry is None:
                raise NotStoredError(key)
            carried = Carried(entry, False)
            self.found(carried)
            return carried
        if (entry := self._take(key)) is not None:
            return Carried(entry, False)
        if self.store is None:
            return Carried(self._compute(key, stage, compute, files), True)
        with self.store.claimed(key, lambda: self.say(f"{words(key)}: another process computes it; waiting")):
            if (entry := self._take(key)) is not None:
                return Carried(entry, False)
            if key.stage in self.again:
                self.store.forget_checkpoints(key)
            entry = self._compute(key, stage, compute, files)
            if self.store.code.has_changed(stage.code):
                self.say(f"warning: {words(key)}: its source changed while it was computed; not kept")
                entry = replace(entry, key=replace(key, code={**key.code, CHANGED: "unknown"}))
                self.store.forget_checkpoints(key)
            elif self._keep(entry):
                self.store.forget_checkpoints(key)
            return Carried(entry, True)

    def checkpoints(self, key: StageKey, report: StepReport | None = None) -> Checkpoints:
        """Where a stage saves how far it is, and from where it goes on.

        Args:
            key: of the stage.
            report: gets every step of it.
        """
        folder = None if self.store is None else self.store.checkpoints(key)
        return Checkpoints(folder, say=lambda line: self.say(f"{words(key)}: {line}"), report=report)

    def changes(self, key: StageKey, earlier: str | None = None) -> list[str]:
        """What is other than in stored results, in words.

        Args:
            key: of a stage.
            earlier: digest of the key of these results; None: those that are most like it.
        """
        if self.store is None:
            return ["there is no store"]
        stored = self.store.latest(key) if earlier is None else self.store.earlier(key, earlier)
        if stored is None:
            return [
                "it was never computed"
                if earlier is None
                else "its key differs, and the store forgot that one"
            ]
        return key.changes(stored.key)

    def _find(self, key: StageKey) -> StoredResults | None:
        if self.store is None or key.stage in self.again:
            return None
        stored, earlier = self.store.find(key, self.say), self._of_earlier_run(key)
        if stored is None or earlier is None:
            return stored or earlier
        if earlier.result != stored.result:  # somebody has written into that manifest
            return stored
        # Another run may have computed the same again: in this place, the times that its report shows are its own.
        return earlier if self.looking else replace(stored, timing=earlier.timing)

    def _of_earlier_run(self, key: StageKey) -> StoredResults | None:
        row = self.earlier.get(label(key.stage, key.robot), {})
        try:
            if row["key"] != key.digest:
                return None
            files = {name: FileDigest(**digest) for name, digest in row["files"].items()}
            return StoredResults(key, files, row["result"], row["timing"])
        except (KeyError, TypeError, AttributeError):  # somebody has written into that manifest
            return None

    def _take(self, key: StageKey) -> StoredResults | None:
        """Results of the store, or of the earlier run, in the folder of this one; None if there are none."""
        entry = self._find(key)
        if entry is None or self.store is None:
            return None
        try:
            self.store.take(entry, self.folder, self.place)
        except DamagedEntryError as error:
            self.say(f"{error}; {words(key)} is computed again")
            self.store.forget(key)
            return None
        self.store.forget_checkpoints(key)
        self.begun(key, True)
        return entry

    def _compute(
        self,
        key: StageKey,
        stage: Stage,
        compute: Callable[[Timing], Any],
        files: Callable[[], Iterator[Path]] | None,
    ) -> StoredResults:
        timing = Timing()
        self.begun(key, False)
        result = compute(timing)
        written = self._declared(stage, key.robot) if files is None else files()
        digests = FileDigests(None) if self.store is None else self.store.files
        found = {path.relative_to(self.folder).as_posix(): digests.of(path) for path in sorted(written)}
        return StoredResults(key, found, result, timing.stages[label(key.stage, key.robot)])

    def _declared(self, stage: Stage, robot: str | None) -> Iterator[Path]:
        folder = self.folder if robot is None else self.folder / "robots" / robot
        for pattern in stage.writes_files:
            yield from folder.glob(pattern)

    def _keep(self, entry: StoredResults) -> bool:
        """Keep results, if the store has room for them; the run goes on anyway."""
        assert self.store is not None
        before = self.store.find(entry.key) if entry.key.stage in self.again else None
        if before is not None and (other := differing(before, entry)):
            self.say(
                f"warning: {words(entry.key)}: {other[0]} has digest {_content(entry, other[0])[:12]}, "
                f"expected {_content(before, other[0])[:12]} as computed before from the same"
            )
        try:
            self.store.keep(entry, self.folder)
        except OSError as error:
            self.say(
                f"warning: {self.store.folder}: {error.strerror or error}; {words(entry.key)} is not kept"
            )
            return False
        return True


def intact(folder: Path, entry: StoredResults, digests: FileDigests) -> str:
    """The first file of results that is not in a folder as it was computed; "" if all are.

    Args:
        folder: of a run.
        entry: the results.
        digests: of files.
    """
    for name, digest in entry.files.items():
        path = folder / name
        if not path.is_file() or os.path.getsize(path) != digest.size or digests.raw(path) != digest.raw:
            return name
        digests.keep(path, digest)
    return ""


def differing(first: StoredResults, second: StoredResults) -> list[str]:
    """Names of the files that two computations of the same made otherwise, sorted.

    Args:
        first: results of one.
        second: of the other; views do not count, for Rerun gives their chunks random numbers.
    """
    names = sorted(name for name in {*first.files, *second.files} if not name.endswith(".rrd"))
    return [name for name in names if _content(first, name) != _content(second, name)]


def _content(entry: StoredResults, name: str) -> str:
    return entry.files[name].content if name in entry.files else "nothing"


def words(key: StageKey) -> str:
    """A stage and whose it is.

    Args:
        key: of the stage.
    """
    return f"{key.stage} of {key.robot}" if key.robot else key.stage
