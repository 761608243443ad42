"""`duagc recover`: a sound log from a damaged one, with every message that is certain, and what was lost.

A record is read where the one before ends. After damage the next chunk is found by the name of its compression. A
chunk counts only if its checksum agrees; of the last one of a file that is cut, what is still there counts. Nothing is
guessed: a message is kept as it was written or not at all.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import struct
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.summary import Summary

from duagc.pipeline.base.atomic_folder import RECORDING, check_apart, new_folder
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import check_file, new_file, read_bytes
from duagc.pipeline.base.progress import track
from duagc.pipeline.recording import RECORDING_FILE, RECORDING_FORMAT, RECORDING_SCHEMA, open_rgbd
from duagc.pipeline.recording.damaged_log import LARGEST_RECORD, Salvage, records_of
from duagc.pipeline.recording.identity import ContentDigest, channel_identity, framed
from duagc.pipeline.recording.names import DIGEST_RECORD, LIBRARY, LOG_RECORD, ROBOT_KEY
from duagc.pipeline.recording.write import mcap_writer

TRUTH = ".groundtruth.mcap"  # how the names of true logs end


def recover(source: Path, out: Path, force: bool = False) -> list[Salvage]:
    """Write what can be read of a log, or of a recording, into a new log or recording.

    Args:
        source: a damaged log, or a folder of logs.
        out: the new log or recording.
        force: replace what `out` names.

    Returns:
        What became of every log.

    Raises:
        DuagError: nothing can be read, or `out` exists.
    """
    source, out = Path(source), Path(out)
    if not source.exists():
        raise DuagError(f"{source}: no such file or folder, expected a log or a recording")
    if not source.is_dir():
        check_file(source, "a log or a recording")
    else:
        check_apart(out, [source])
        with new_folder(out, force, RECORDING) as folder:
            return _recover_recording(source, folder, out.resolve().name)
    if out.exists() and not force:
        raise DuagError(f"{out}: exists already; choose another --out or give --force")
    if out.is_dir():
        raise DuagError(f"{out}: is a folder, expected the name of a log")
    if out.exists() and out.samefile(source):
        raise DuagError(f"{out}: is the damaged log itself, expected another name")
    return [_recover_log(source, out)]


def _recover_log(source: Path, out: Path) -> Salvage:
    part = out.with_name(out.name + ".part")
    salvage = Salvage(source.name)
    try:
        with source.open("rb") as stream, part.open("wb") as target:
            copy = _Copy(target, salvage)
            summary = _summary_of(stream)
            if summary:
                copy.know([*summary.schemas.values(), *summary.channels.values()])
            records = records_of(stream, source.stat().st_size, salvage)
            count = summary.statistics.message_count if summary and summary.statistics else None
            for record in track(records, f"recover {source.name}", count):
                copy.add(record)
            if summary and summary.statistics:
                salvage.lost = max(0, summary.statistics.message_count - salvage.messages)
            elif not salvage.cut:
                salvage.damage.append("the index at the end was damaged")
            copy.finish()
        if not salvage.messages:
            raise DuagError(f"{source}: found no message that is whole, expected an MCAP log")
        os.replace(part, out)
    except OSError as error:
        raise DuagError(f"{source}: {error.strerror or error}, expected to recover it to {out}") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
    return salvage


def _summary_of(stream: IO[bytes]) -> Summary | None:
    """The end of the file, where that is left."""
    try:
        summary = SeekingReader(stream, record_size_limit=LARGEST_RECORD).get_summary()
    except Exception:  # whatever a reader stumbles over: it is damaged, and that is why we are here
        return None
    return summary


class _Copy:
    """Writes records into a new log, as `LogWriter` writes it: the digest of a log that lost nothing is the same."""

    def __init__(self, target: IO[bytes], salvage: Salvage) -> None:
        self._writer = mcap_writer(target)
        self._writer.start(profile="", library=LIBRARY)
        self._salvage = salvage
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._written: dict[int, tuple[int, bytes]] = {}  # channel in the source -> in the copy, identity
        self._copied_schemas: dict[int, int] = {}
        self._sequences: dict[int, int] = {}
        self._metadata: list[tuple[str, dict[str, str]]] = []
        self._attachments: list[bytes] = []
        self._content = ContentDigest()
        self._last_ns, self._in_order = 0, True

    def know(self, records: list[Schema | Channel]) -> None:
        """Take in schemas and channels that messages may need."""
        for record in records:
            if isinstance(record, Schema):
                self._schemas.setdefault(record.id, record)
            else:
                self._channels.setdefault(record.id, record)

    def add(self, record: Any) -> None:
        """Take in the next record of the source."""
        if isinstance(record, Schema | Channel):
            self.know([record])
        elif isinstance(record, Message):
            self._message(record)
        elif isinstance(record, Metadata) and record.name != DIGEST_RECORD:
            self._writer.add_metadata(record.name, record.metadata)
            self._metadata.append((record.name, record.metadata))
        elif isinstance(record, Attachment):
            times = (record.create_time, record.log_time)
            self._writer.add_attachment(*times, record.name, record.media_type, record.data)
            names = (record.name.encode(), record.media_type.encode())
            self._attachments.append(framed(*names, struct.pack("<QQ", *times), record.data))

    def _message(self, m: Message) -> None:
        channel = self._channels.get(m.channel_id)
        if channel is None or (channel.schema_id and channel.schema_id not in self._schemas):
            self._salvage.lost += 1
            said = f"what channel {m.channel_id} is was lost"
            if said not in self._salvage.damage:
                self._salvage.damage.append(said)
            return
        number, identity = self._open(channel)
        expected = self._sequences.get(m.channel_id, 0)
        if m.sequence > expected and self._ours(channel):
            self._salvage.lost += m.sequence - expected
        self._sequences[m.channel_id] = m.sequence + 1
        self._writer.add_message(number, m.log_time, m.data, m.publish_time, m.sequence)
        self._content.add(identity, m.log_time, m.publish_time, sequence=m.sequence, data=m.data)
        self._in_order &= m.log_time >= self._last_ns
        self._last_ns = m.log_time
        self._salvage.messages += 1

    def _ours(self, channel: Channel) -> bool:
        """Whether messages are numbered from 0 without gaps; other programs number as they like."""
        from duagc.schemas import topics

        return topics.find(channel.topic) is not None

    def _open(self, channel: Channel) -> tuple[int, bytes]:
        if channel.id not in self._written:
            number, name, data = 0, "", b""
            if channel.schema_id:
                schema = self._schemas[channel.schema_id]
                name, data = schema.name, schema.data
                if schema.id not in self._copied_schemas:
                    self._copied_schemas[schema.id] = self._writer.register_schema(
                        name, schema.encoding, data
                    )
                number = self._copied_schemas[schema.id]
            new = self._writer.register_channel(
                channel.topic, channel.message_encoding, number, channel.metadata
            )
            self._written[channel.id] = new, channel_identity(channel.topic, name, data)
        return self._written[channel.id]

    def finish(self) -> None:
        """Write the end of the log."""
        channels = [(identity, self._channels[id].metadata) for id, (_, identity) in self._written.items()]
        if self._in_order:
            self._salvage.digest = self._content.finish(channels, self._metadata, self._attachments)
            self._writer.add_metadata(DIGEST_RECORD, {"sha256": self._salvage.digest})
        self._writer.finish()


def _recover_recording(source: Path, folder: Path, name: str) -> list[Salvage]:
    """Every log of a folder that is or was to become a recording, and a description that agrees with them."""
    salvaged = list[Salvage]()
    try:
        description = json.loads(read_bytes(source / RECORDING_FILE, "the JSON of a recording"))
        rows = dict(description["robots"])
        warnings = list(description.get("warnings", []))
    except (DuagError, ValueError, KeyError, TypeError, RecursionError):
        description, rows = {"name": name, "source": {"folder": source.resolve().name}}, {}
        warnings = [f"{RECORDING_FILE} was lost and made again from the logs"]
        salvaged.append(Salvage(RECORDING_FILE, damage=["made again from the logs"]))
    salvaged += _recover_logs(source, folder, warnings)
    robots = {}
    for path in sorted(folder.glob("*.mcap")):
        if path.name.endswith(TRUTH):
            continue
        try:
            robot, row = _describe(path)
        except DuagError as error:
            warnings.append(f"{path.name} is no log of a robot's camera: {str(error).partition(': ')[2]}")
            continue
        recorded = rows.get(robot)
        robots[robot] = {**(recorded if isinstance(recorded, dict) else {"sensors": {}, "path": None}), **row}
    if not robots:
        raise DuagError(f"{source}: found no log of a robot with frames, expected one or more")
    geometry = description.get("geometry")
    if isinstance(geometry, str) and Path(geometry).name == geometry and (source / geometry).is_file():
        shutil.copyfile(source / geometry, folder / geometry)
    else:
        description["geometry"] = None
    kept = {RECORDING_FILE, description["geometry"]}
    for path in sorted(source.iterdir()):
        if path.name not in kept and ".mcap" not in path.suffixes and not path.name.startswith("."):
            salvaged.append(Salvage(path.name, damage=["is not carried over: no log, and nothing names it"]))
    description |= {"format": RECORDING_FORMAT, "schema": RECORDING_SCHEMA, "robots": robots}
    description["warnings"] = warnings
    with new_file(folder / RECORDING_FILE) as part:
        part.write_text(json.dumps(description, indent=2) + "\n")
    return salvaged


def _recover_logs(source: Path, folder: Path, warnings: list[str]) -> list[Salvage]:
    """Every log of a folder; of two that would have one name, that with more messages."""
    found = dict[str, Salvage]()  # by name of the recovered log
    others, said = list[Salvage](), dict[str, str]()  # and warnings, by name of the file
    for path in sorted(source.iterdir()):
        if not path.name.endswith((".mcap", ".mcap.part")) or path.is_dir():
            continue
        name = path.name.removesuffix(".part")
        try:
            if not path.is_file() or path.is_symlink():
                raise DuagError(f"{path}: is no file of this folder, expected a log")
            salvage = _recover_log(path, folder / path.name)
        except DuagError as error:
            cause = error.__cause__
            if (
                isinstance(cause, OSError) and cause.errno != errno.EINVAL
            ):  # the log may be whole: no room, no right
                raise
            reason = str(error).partition(": ")[2]
            said[path.name] = f"{path.name} is lost: {reason}"
            others.append(Salvage(path.name, damage=[reason]))
            continue
        before = found.get(name)
        if before is not None and before.messages >= salvage.messages:
            (folder / path.name).unlink()
            salvage, before = before, salvage
        elif path.name != name:
            os.replace(folder / path.name, folder / name)
        found[name] = salvage
        if before is not None:
            reason = f"is not carried over: {salvage.path} has {salvage.messages} messages"
            said[before.path] = f"{before.path} with {before.messages} messages {reason}"
            others.append(Salvage(before.path, before.messages, damage=[reason]))
    said |= {s.path: f"recovered: {s.line()}" for s in found.values() if not s.whole}
    warnings += [text for _, text in sorted(said.items())]
    return sorted([*found.values(), *others], key=lambda salvage: salvage.path)


def _describe(path: Path) -> tuple[str, dict[str, Any]]:
    """The robot of a log and what a recording says about it."""
    from duagc.pipeline.recording.read import LogFile

    with open_rgbd(path) as log:
        stamps = [color for color, _ in log.pairing.pairs]
        row: dict[str, Any] = {
            "log": path.name,
            "frames": len(log),
            "start_ns": stamps[0],
            "end_ns": stamps[-1],
            "longest_interval_ns": int(np.diff(stamps).max()) if len(stamps) > 1 else 0,
            "camera": asdict(log.camera),
            "depth_scale_m": float(log.depth_scale),
        }
        robot = log.robot
    truth = path.with_name(f"{robot}{TRUTH}")
    row["groundtruth"] = truth.name if truth.is_file() else None
    row["digests"] = {}
    for file in (path, truth):
        if file.is_file():
            with LogFile(file) as log_file:
                found = dict(log_file.metadata())
            row["digests"][file.name] = found.get(DIGEST_RECORD, {}).get("sha256", "")
            if file == path:
                written = found.get(LOG_RECORD, {})
                row["sensors"] = {key: value for key, value in written.items() if key != ROBOT_KEY}
    return robot, row
