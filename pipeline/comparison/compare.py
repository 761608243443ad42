"""Two runs, recordings or logs, message by message; the first difference of each topic with both values."""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import check_file, kind_of_path, read_json, read_toml
from duagc.pipeline.comparison.fields import Unequal, unequal
from duagc.pipeline.comparison.recordings import description_of, files_of, made_otherwise, points_of
from duagc.pipeline.comparison.summary import ORDER, libraries_of, stage_of
from duagc.pipeline.comparison.tolerances import Tolerances
from duagc.pipeline.recording import RECORDING_FILE, Record, log_metadata, read_log
from duagc.pipeline.runs.digest import digest_file, result_files

SCHEMA = 1
METRICS = "metrics.json"
NOTHING = Tolerances()


@dataclass(frozen=True)
class Difference:
    """Something that differs.

    Attributes:
        stage: that computed it; "recording" or "log" where there is none.
        file: relative to the run or recording.
        where: topic, or "" of a file that has none.
        text: what differs, in words.
        index: of the first message that differs; None if none does.
        time_ns: its log time.
        fields: of that message, dotted, with both values.
    """

    stage: str
    file: str
    where: str
    text: str
    index: int | None = None
    time_ns: int | None = None
    fields: tuple[dict[str, Any], ...] = ()

    def line(self) -> str:
        """In one line."""
        return ": ".join(part for part in (self.stage, self.file, self.where, self.text) if part)


@dataclass
class Compared:
    """What was found.

    Attributes:
        first: what was compared.
        second: with what.
        differences: earlier stages first.
        messages: that were compared.
        files: that were compared.
        tolerated: values that differ within a tolerance.
        notes: what may explain differences, and is none itself.
    """

    first: str
    second: str
    differences: list[Difference] = field(default_factory=list)
    messages: int = 0
    files: int = 0
    tolerated: int = 0
    notes: list[str] = field(default_factory=list)

    @property
    def equal(self) -> bool:
        """Whether nothing differs by more than its tolerance."""
        return not self.differences

    def plain(self) -> dict[str, Any]:
        """As plain values."""
        rows = [vars(d) | {"fields": list(d.fields)} for d in self.differences]
        return {"schema": SCHEMA, "equal": self.equal} | vars(self) | {"differences": rows}

    def text(self) -> str:
        """For people."""
        lines = [*(f"note: {note}" for note in self.notes), *(d.line() for d in self.differences)]
        counts = f"{self.files} files, {self.messages} messages"
        tolerated = f", {self.tolerated} values within their tolerance" if self.tolerated else ""
        verdict = "equal" if self.equal else f"{len(self.differences)} differences"
        return "\n".join([*lines, f"{verdict}: {counts}{tolerated}"])


def compare(first: Path, second: Path, tolerances: Tolerances = NOTHING) -> Compared:
    """Compare two runs, two recordings or two logs.

    Args:
        first: folder of a run or of a recording, or a log.
        second: another one of the same kind.
        tolerances: how far values may be apart.

    Raises:
        DuagError: they are of different kinds, or are none of these.
    """
    kinds = [_kind(path) for path in (first, second)]
    if kinds[0] != kinds[1]:
        raise DuagError(f"{second}: is {kinds[1]}, expected {kinds[0]} as {first}")
    out = Compared(str(first), str(second))
    if kinds[0] == "a log":
        out.files = 1
        _compare_logs(out, first, second, stage="log", name="", tolerances=tolerances)
        return out
    files = [_files(path, kinds[0]) for path in (first, second)]
    names = sorted({*files[0], *files[1]}, key=lambda name: (ORDER.index(stage_of(name)), name))
    if kinds[0] == "a run":
        out.notes += _settings(first, second) + _libraries(first, second)
    else:
        out.notes += made_otherwise(first, second)
    for name in names:
        stage = stage_of(name) if kinds[0] == "a run" else "recording"
        missing = [str(path) for path, found in zip((first, second), files, strict=True) if name not in found]
        if missing:
            out.differences.append(Difference(stage, name, "", f"not in {missing[0]}"))
            continue
        out.files += 1
        _compare_files(out, first / name, second / name, stage=stage, name=name, tolerances=tolerances)
    return out


def _kind(path: Path) -> str:
    if path.is_file():
        return "a log"
    if (path / RECORDING_FILE).is_file():
        return "a recording"
    if (path / "robots").is_dir():
        return "a run"
    found = kind_of_path(path)
    raise DuagError(f"{path}: {found}, expected a log, a recording (recording.json) or a run (robots/)")


def _files(path: Path, kind: str) -> list[str]:
    if kind == "a recording":
        return files_of(path)
    found = [p.as_posix() for p in result_files(path)]
    return [*found, METRICS] if (path / METRICS).is_file() else found


def _settings(first: Path, second: Path) -> list[str]:
    """Settings that differ: they explain differences, and are none."""
    tables = []
    for run in (first, second):
        path = run / "config.toml"
        if not path.is_file():
            return []
        tables.append(read_toml(path, "the configuration of a run"))
    return [f"setting {found.text()}" for found in unequal(tables[0], tables[1])]


def _libraries(first: Path, second: Path) -> list[str]:
    """Versions of libraries that differ: LAPACK of another numpy rounds otherwise."""
    tables = [libraries_of(run) for run in (first, second)]
    return [f"library {found.text()}" for found in unequal(tables[0], tables[1])] if all(tables) else []


def _compare_files(
    out: Compared, first: Path, second: Path, *, stage: str, name: str, tolerances: Tolerances
) -> None:
    if name.endswith(".mcap"):
        _compare_logs(out, first, second, stage=stage, name=name, tolerances=tolerances)
        return
    if digest_file(first) == digest_file(second):
        return
    read = _content_of_recording if stage == "recording" else _content
    found = unequal(read(first), read(second))
    beyond = _beyond(out, name, found, tolerances)
    if name == METRICS:
        out.differences += [Difference(stage, name, "", f.text(), fields=(_plain(f),)) for f in beyond]
    elif beyond:
        text = "; ".join(f.text() for f in beyond)
        out.differences.append(Difference(stage, name, "", text, fields=tuple(map(_plain, beyond))))
    elif not found and name != RECORDING_FILE:
        out.differences.append(Difference(stage, name, "", "other bytes, equal values"))


def _content(path: Path) -> dict[str, Any]:
    """Values of a file that is no log, by name."""
    if path.suffix == ".ply":
        from duagc.pipeline.splat.ply import read_ply

        return {name: value for name, value in vars(read_ply(path)).items() if name not in ("ids", "anchors")}
    if path.suffix == ".tum":
        from duagc.pipeline.geometry.trajectory import read_tum

        trajectory = read_tum(path)
        return {"stamps_ns": trajectory.stamps_ns, "poses": trajectory.poses}
    return read_json(path, "a result of a run")


def _content_of_recording(path: Path) -> dict[str, Any]:
    return description_of(path.parent) if path.name == RECORDING_FILE else points_of(path)


def _beyond(out: Compared, where: str, found: list[Unequal], tolerances: Tolerances) -> list[Unequal]:
    beyond = [f for f in found if not tolerances.allow(where, f)]
    out.tolerated += sum(f.count for f in found) - sum(f.count for f in beyond)
    return beyond


def _compare_logs(
    out: Compared, first: Path, second: Path, *, stage: str, name: str, tolerances: Tolerances
) -> None:
    check_file(first, "a log")
    check_file(second, "a log")
    metadata = unequal(_opened(log_metadata(first)), _opened(log_metadata(second)))
    out.differences += [Difference(stage, name, "metadata", found.text()) for found in metadata]
    sides = [_by_topic(path) for path in (first, second)]
    for topic in sorted({*sides[0], *sides[1]}):
        one, other = (side.get(topic, []) for side in sides)
        out.messages += min(len(one), len(other))
        texts = [] if len(one) == len(other) else [f"{len(one)} and {len(other)} messages"]
        at: int | None = None
        fields: list[Unequal] = []
        number = 0
        for index, (a, b) in enumerate(zip(one, other, strict=False)):
            if (found := _beyond(out, topic, _unequal_messages(a, b), tolerances)) and at is None:
                at, fields = index, found
            number += bool(found)
        if at is not None:
            texts.append(f"message {at} of {len(one)} at {one[at].log_time_ns} ns: {_text(fields)}")
            if number > 1:
                texts.append(f"{number} messages differ")
        if texts:
            time_ns = None if at is None else one[at].log_time_ns
            plain = tuple(map(_plain, fields))
            text = "; ".join(texts)
            out.differences.append(
                Difference(stage, name, topic, text, index=at, time_ns=time_ns, fields=plain)
            )


def _text(fields: list[Unequal], most: int = 4) -> str:
    more = f"; {len(fields) - most} more fields" if len(fields) > most else ""
    return "; ".join(f.text() for f in fields[:most]) + more


def _plain(found: Unequal) -> dict[str, Any]:
    finite = found.largest is None or np.isfinite(found.largest)
    plain = {name: value for name, value in vars(found).items() if name not in ("gaps", "sizes")}
    return plain | {"largest": found.largest if finite else None}


def _opened(metadata: Any) -> dict[str, Any]:
    """Metadata without digests, with texts of JSON opened."""
    out: dict[str, Any] = {}
    for name, text in metadata.items():
        out[name] = json.loads(text) if isinstance(text, str) and text.startswith("{") else text
    return out


def _by_topic(path: Path) -> dict[str, list[Record]]:
    out = defaultdict(list)
    for record in read_log(path):
        out[record.topic].append(record)
    return dict(out)


def _unequal_messages(first: Record, second: Record) -> list[Unequal]:
    """Fields that differ; the time and the kind of a message are fields as well."""
    out = []
    for name in ("log_time_ns", "publish_time_ns", "sequence", "schema"):
        one, other = getattr(first, name), getattr(second, name)
        if one != other:
            out.append(Unequal(name, "", str(one), str(other)))
    if first.data == second.data:
        return out
    if first.schema != second.schema:
        return out
    return out + (
        unequal(first.message(), second.message())
        or unequal(first.proto(), second.proto())
        or [Unequal("bytes", "", f"{len(first.data)} bytes", f"{len(second.data)} bytes")]
    )
