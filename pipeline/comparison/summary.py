"""What a run computed, in few bytes: a digest of every file, topic and field, and 16 bits of every message."""

import hashlib
import json
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.files import read_json
from duagc.pipeline.recording import log_metadata, read_log
from duagc.pipeline.runs.digest import digest, result_files

HEX = 16  # characters kept of a digest
ORDER = ("frontend", "information", "exchange", "fusion", "evaluation")
"""Stages, earlier ones first."""
STAGES = {
    "frontend.mcap": "frontend",
    "odometry.tum": "frontend",
    "information.mcap": "information",
    "exchange.mcap": "exchange",
    "consensus.mcap": "exchange",
    "metrics.json": "evaluation",
}
"""Stage that writes a file; every other file is fusion's."""


@dataclass
class TopicSummary:
    """One topic of one log.

    Attributes:
        fields: digest over all messages, by the name of the field (nested ones with dots).
        messages: CRC-16 of every message, times included, uint16 [count].
        times_ns: log time of every message, int64 [count]; only of runs that were read just now.
    """

    schema: str
    fields: dict[str, str]
    messages: NDArray[np.uint16]
    times_ns: list[int] = field(default_factory=list)


@dataclass
class RunSummary:
    """A whole run.

    Attributes:
        digest: of the run.
        files: digest of every result file.
        topics: of every log, by (file, topic).
        metadata: of every log, by file; what is JSON is opened into dotted names.
        libraries: versions of those that it was computed with, by name; empty: it does not say.
    """

    digest: str
    files: dict[str, str]
    topics: dict[tuple[str, str], TopicSummary]
    metadata: dict[str, dict[str, Any]]
    libraries: dict[str, str]


def stage_of(file: str) -> str:
    """The stage that writes a result file of a run.

    Args:
        file: relative to the run.
    """
    return STAGES.get(Path(file).name, "fusion")


def _fields(proto: Any, prefix: str = "") -> Iterator[tuple[str, bytes]]:
    """Name and bytes of every field that is set; a single nested message is opened, a repeated one is not."""
    for descriptor, value in proto.ListFields():
        name = prefix + descriptor.name
        single = not descriptor.is_repeated if hasattr(descriptor, "is_repeated") else descriptor.label != 3
        if descriptor.message_type is not None and single:
            yield from _fields(value, name + ".")
        elif descriptor.message_type is not None:
            yield name, b"".join(element.SerializeToString(deterministic=True) for element in value)
        elif isinstance(value, bytes):
            yield name, value
        else:
            yield name, repr(list(value) if not single else value).encode()


def summarize_log(path: Path) -> dict[str, TopicSummary]:
    """Every topic of a log.

    Args:
        path: of the log.
    """
    hashes: dict[str, dict[str, Any]] = {}
    crcs: dict[str, list[int]] = {}
    schemas: dict[str, str] = {}
    times: dict[str, list[int]] = {}
    for record in read_log(path):
        schemas[record.topic] = record.schema
        of_topic = hashes.setdefault(record.topic, {})
        number = len(times.setdefault(record.topic, []))
        times[record.topic].append(record.log_time_ns)
        stamp = f"{record.log_time_ns} {record.publish_time_ns} {record.sequence}".encode()
        crcs.setdefault(record.topic, []).append(zlib.crc32(record.data, zlib.crc32(stamp)) & 0xFFFF)
        for name, data in [("(times)", stamp), *_fields(record.proto())]:
            of_topic.setdefault(name, hashlib.sha256()).update(b"%d %d " % (number, len(data)) + data)
    return {
        topic: TopicSummary(
            schemas[topic],
            {name: h.hexdigest()[:HEX] for name, h in sorted(hashes[topic].items())},
            np.array(crcs[topic], dtype=np.uint16),
            times[topic],
        )
        for topic in sorted(hashes)
    }


def summarize(run: Path) -> RunSummary:
    """A finished run.

    Args:
        run: its folder.
    """
    files = {path.as_posix(): digest(run / path)[:HEX] for path in result_files(run)}
    topics = {
        (file, topic): found
        for file in files
        if file.endswith(".mcap")
        for topic, found in summarize_log(run / file).items()
    }
    metadata = {file: flat(log_metadata(run / file)) for file in files if file.endswith(".mcap")}
    return RunSummary(digest(run), files, topics, metadata, libraries_of(run))


def libraries_of(run: Path) -> dict[str, str]:
    """Versions of the libraries that a run was computed with, by name; empty if it does not say.

    Args:
        run: its folder.
    """
    path = run / "manifest.json"
    stated = read_json(path, "the manifest of a run").get("libraries") if path.is_file() else None
    return {str(name): str(version) for name, version in stated.items()} if isinstance(stated, dict) else {}


def flat(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Metadata as one table: dotted names to values. A text that is a JSON object counts as that object.

    Args:
        metadata: of a log.
    """
    table: dict[str, Any] = {}
    for name, value in metadata.items():
        if isinstance(value, str) and value.startswith("{"):
            value = json.loads(value)
        if isinstance(value, dict):
            table |= {f"{name}.{key}": inner for key, inner in flat(value).items()}
        else:
            table[name] = value
    return table


def metrics_of(run_folder: Path) -> dict[str, object]:
    """The metrics of a run as one flat table: dotted names to numbers, texts and None.

    Args:
        run_folder: of the run; empty if it was not evaluated.
    """
    path = run_folder / "metrics.json"
    if not path.is_file():
        return {}
    flat: dict[str, object] = {}

    def visit(name: str, value: object) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                visit(f"{name}.{key}" if name else key, inner)
        elif not isinstance(value, list):
            flat[name] = value

    visit("", read_json(path, "the metrics of a run"))
    return flat
