"""Golden runs: a few bytes that stand for a run, and what a run has other than they say."""

from __future__ import annotations

import json
import operator
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import new_file, read_text
from duagc.pipeline.comparison.summary import ORDER, RunSummary, TopicSummary, metrics_of, stage_of, summarize

RELATIVE_TOLERANCE = 1e-9  # of metrics: evaluation sums in one order, but its libraries may round otherwise


def store(golden: Path, run: Path) -> None:
    """Write a golden run: the file, for people, and its .npz, 16 bits a message.

    Args:
        golden: the file, .json.
        run: folder of a finished run.

    Raises:
        DuagError: it is no finished run, or the name is not one for a golden run.
    """
    if golden.suffix != ".json":
        raise DuagError(f"{golden}: is a name without .json, expected that of a golden run")
    for path in (golden, golden.with_suffix(".npz")):
        if path.exists() and not _is_golden(golden):
            raise DuagError(f"{path}: exists and is no golden run, expected one or a new name")
    found = summarize(run)
    if not found.files:
        raise DuagError(f"{run}: has no results of robots, expected a finished run")
    content = {
        "digest": found.digest,
        "libraries": found.libraries,
        "files": found.files,
        "topics": {
            file: {
                topic: {"schema": t.schema, "messages": len(t.messages), "fields": t.fields}
                for (of_file, topic), t in found.topics.items()
                if of_file == file
            }
            for file in dict.fromkeys(file for file, _ in found.topics)
        },
        "metadata": found.metadata,
        "metrics": metrics_of(run),
    }
    arrays: dict[str, Any] = {f"{file} {topic}": t.messages for (file, topic), t in found.topics.items()}
    golden.parent.mkdir(parents=True, exist_ok=True)
    with new_file(golden.with_suffix(".npz")) as arrays_part, new_file(golden) as part:
        with arrays_part.open("wb") as stream:
            np.savez_compressed(stream, **arrays)
        part.write_text(json.dumps(content, indent=1) + "\n")


def _is_golden(path: Path) -> bool:
    """Whether a golden run is there."""
    try:
        _read(path)
    except DuagError:
        return False
    return True


def _read(golden: Path) -> tuple[RunSummary, dict[str, object]]:
    """A golden run, and its metrics."""
    try:
        content = json.loads(read_text(golden, "a golden run"))
        with np.load(golden.with_suffix(".npz")) as arrays:
            topics = {
                (file, topic): TopicSummary(stored["schema"], stored["fields"], arrays[f"{file} {topic}"])
                for file, of_file in content["topics"].items()
                for topic, stored in of_file.items()
            }
        metrics, metadata = content["metrics"], content.get("metadata", {})
        libraries = content.get("libraries", {})
        tables = [content["files"], metrics, libraries, metadata, *metadata.values()]
        tables += [topic.fields for topic in topics.values()]
        if not all(isinstance(table, dict) for table in tables):
            raise TypeError("found a list or a value in place of a table")
        return RunSummary(content["digest"], content["files"], topics, metadata, libraries), metrics
    except (OSError, ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        raise DuagError(f"{golden}: {error}, expected a golden run (.json and .npz)") from error


def differences(golden: Path, run: Path) -> list[str]:
    """One line for every topic, metadata, file and metric that differs from what is stored; earlier stages first.

    Where any does, other versions of libraries come before them, which may be why.

    Args:
        golden: file of the golden run.
        run: folder of a finished run.

    Raises:
        DuagError: one of them is not there, or damaged.
    """
    stored, metrics = _read(golden)
    found = summarize(run)
    if not found.files:
        raise DuagError(f"{run}: has no results of robots, expected a finished run")
    files = sorted({*stored.files, *found.files}, key=lambda file: (ORDER.index(stage_of(file)), file))
    lines = []
    for file in files:
        if stored.files.get(file) == found.files.get(file):
            continue
        where = f"{stage_of(file)}: {file}"
        named = sorted({topic for f, topic in {**stored.topics, **found.topics} if f == file})
        of_topics = [
            f"{where}: {line}"
            for topic in named
            if (
                line := _topic_difference(
                    topic, stored.topics.get((file, topic)), found.topics.get((file, topic))
                )
            )
        ]
        of_metadata = [
            f"{where}: metadata {line}"
            for line in _table_differences(stored.metadata.get(file, {}), found.metadata.get(file, {}))
        ]
        lines += (of_topics + of_metadata) or [
            f"{where}: digest {found.files.get(file, 'absent')}, stored {stored.files.get(file, 'absent')}"
        ]
    lines += _metric_differences(metrics, metrics_of(run))
    if not (lines and stored.libraries and found.libraries):
        return lines
    return [f"library {line}" for line in _table_differences(stored.libraries, found.libraries)] + lines


def _topic_difference(topic: str, stored: Any, found: Any) -> str | None:
    """One line about one topic (`TopicSummary` or None), or None if it is the same."""
    if stored is None or found is None:
        return f"{topic}: {'not stored' if stored is None else 'not found'}"
    both = min(len(stored.messages), len(found.messages))
    unequal = (stored.messages[:both] != found.messages[:both]).nonzero()[0]
    names = {**stored.fields, **found.fields}
    fields = [f for f in names if stored.fields.get(f) != found.fields.get(f)]
    if len(stored.messages) == len(found.messages) and not fields and stored.schema == found.schema:
        return None
    parts = [topic]
    if stored.schema != found.schema:
        parts.append(f"schema {found.schema}, stored {stored.schema}")
    if len(stored.messages) != len(found.messages):
        parts.append(f"{len(found.messages)} messages, stored {len(stored.messages)}")
    first = int(unequal[0]) if len(unequal) else both
    if first < len(found.messages):
        parts.append(f"first message that differs: {first} at {found.times_ns[first]} ns")
    if fields:
        parts.append(f"fields {', '.join(fields)}")
    return "; ".join(parts)


def _metric_differences(stored: dict[str, object], found: dict[str, object]) -> list[str]:
    def close(old: object, new: object) -> bool:
        if isinstance(old, float) and isinstance(new, float):
            return old == new or abs(new - old) <= RELATIVE_TOLERANCE * abs(old)
        return old == new

    return [f"evaluation: {line}" for line in _table_differences(stored, found, close)]


def _table_differences(
    stored: Mapping[str, object],
    found: Mapping[str, object],
    same: Callable[[object, object], bool] = operator.eq,
) -> list[str]:
    """One line for every name whose value differs."""

    def text(table: Mapping[str, object], name: str) -> str:
        value = table.get(name, "absent")
        return f"{value:.9g}" if isinstance(value, float) else repr(value)

    return [
        f"{name}: {text(found, name)}, stored {text(stored, name)}"
        for name in sorted({*stored, *found})
        if not same(stored.get(name, "absent"), found.get(name, "absent"))
    ]
