"""Reads logs: the checksums of the whole file are compared before the first message comes."""

from __future__ import annotations

import heapq
import struct
import weakref
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, MessageIndex
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary

from duagc import schemas
from duagc.pipeline import messages
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.workers import hand_down
from duagc.pipeline.recording.access import check_read
from duagc.pipeline.recording.identity import channel_identity, framed
from duagc.pipeline.recording.log_checksums import parsing, verify
from duagc.pipeline.recording.names import LOG_RECORD
from duagc.schemas.topics import Topic
from duagc.schemas.topics import find as find_topic

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_CHUNKS_KEPT = 4
LATEST_NS = 1 << 63  # what a signed 64-bit number can hold


@dataclass(frozen=True, slots=True)
class Record:
    """One message of a log as it stands there. `schema` is the full name of its schema."""

    path: Path
    topic: str
    schema: str
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes
    schema_data: bytes

    def proto(self) -> Any:
        """The protobuf message; by our classes where we have the schema, else by the description in the log."""
        try:
            return _class_of(self.schema, self.schema_data).FromString(self.data)
        except Exception as error:  # protobuf's DecodeError, and whatever a broken schema provokes
            where = f"{self.path}: {self.topic} at {self.log_time_ns} ns"
            raise DuagError(
                f"{where} has {len(self.data)} bytes that are no {self.schema} ({error})"
            ) from error

    def message(self) -> Any:
        """The dataclass of `duagc.pipeline.messages` if the schema has one, else the protobuf message."""
        try:
            return messages.unpack(self.proto())
        except DuagError as error:
            if str(error).startswith(str(self.path)):
                raise
            raise DuagError(f"{self.path}: {self.topic} at {self.log_time_ns} ns: {error}") from error


@lru_cache(maxsize=256)
def _class_of(schema: str, schema_data: bytes) -> Any:
    try:
        return schemas.message_class(schema)
    except KeyError:
        return schemas.message_class_from(schema, schema_data)


_PublishTimes = dict[tuple[str, int, int, int, str], dict[int, tuple[int, int, int]]]
_publish_times: _PublishTimes = {}


def _known() -> _PublishTimes:
    """What this process knows of files, as long as they are unchanged."""
    return dict(_publish_times)


def _learn(known: _PublishTimes) -> None:
    _publish_times.update(known)


hand_down(_known, _learn)


class LogFile:
    """An MCAP file that has been verified, with its summary in hand."""

    def __init__(self, path: str | Path) -> None:
        """Verify a log and read its summary.

        Args:
            path: of the log.
        """
        self.path = Path(path)
        verify(self.path)
        with parsing(self.path):
            self._stream = self.path.open("rb")
            weakref.finalize(self, self._stream.close)
            self._reader = SeekingReader(self._stream, validate_crcs=True)
            summary = self._reader.get_summary()
            if summary is None:
                raise DuagError(f"{self.path}: has no summary, expected a sound MCAP log")
            self.summary: Summary = summary
            ordered = sorted(summary.channels.values(), key=lambda c: c.id)
            self.channels: dict[str, Channel] = {}
            for channel in ordered:
                if self.channels.setdefault(channel.topic, channel) is not channel:
                    raise DuagError(f"{self.path}: {channel.topic} has two channels, expected one")
            self.identities = {
                topic: channel_identity(topic, *self.schema_of(channel))
                for topic, channel in self.channels.items()
            }
        self._chunks: OrderedDict[int, bytes] = OrderedDict()
        self._sound_chunks = set[int]()  # whose own checksum has been compared

    def __enter__(self) -> LogFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; nothing can be read afterward."""
        self._stream.close()

    def schema_of(self, channel: Channel) -> tuple[str, bytes]:
        """Full name and description of the schema of a channel; both empty if it has none.

        Args:
            channel: of this log.
        """
        if channel.schema_id == 0:
            return "", b""
        schema = self.summary.schemas[channel.schema_id]
        return schema.name, schema.data

    def records(self, topics: Sequence[str] | None) -> Iterator[Record]:
        """All messages of some topics, or of all, in the order of the log.

        Args:
            topics: full names; None: all.
        """
        for topic in self.channels if topics is None else topics:
            check_read(self.path, topic)
        with parsing(self.path, self._stream):
            for schema, channel, m in self._reader.iter_messages(topics=topics, log_time_order=True):
                name, data = (schema.name, schema.data) if schema else ("", b"")
                times = self._sound_time(m.log_time), self._sound_time(m.publish_time)
                yield Record(
                    self.path,
                    channel.topic,
                    name,
                    *times,
                    sequence=m.sequence,
                    data=m.data,
                    schema_data=data,
                )

    def metadata(self) -> list[tuple[str, dict[str, str]]]:
        """Metadata records: name and text."""
        with parsing(self.path, self._stream):
            return [(m.name, m.metadata) for m in self._reader.iter_metadata()]

    def attachments(self) -> list[bytes]:
        """Attachments, each as one string of bytes with its name and times."""
        with parsing(self.path, self._stream):
            return [
                framed(
                    a.name.encode(),
                    a.media_type.encode(),
                    struct.pack("<QQ", a.create_time, a.log_time),
                    a.data,
                )
                for a in self._reader.iter_attachments()
            ]

    def entries(self, topic: str) -> list[tuple[int, int, int]]:
        """(log time, start of the chunk in the file, offset in the chunk) of every message of a topic, in log order.

        Args:
            topic: full name; one that the log lacks has no entries.
        """
        check_read(self.path, topic)
        if topic not in self.channels:
            return []
        number = self.channels[topic].id
        out = []
        with parsing(self.path, self._stream):
            for chunk in self.summary.chunk_indexes:
                position = chunk.message_index_offsets.get(number)
                if position is None:
                    continue
                self._stream.seek(position + 9)  # opcode and length
                index = MessageIndex.read(ReadDataStream(self._stream))
                start = chunk.chunk_start_offset
                out += [(self._sound_time(time), start, offset) for time, offset in index.records]
        return sorted(out)

    def entries_by_time(self, topic: str, *others: str) -> dict[int, tuple[int, int, int]]:
        """The entry of every message of a topic by its publish time; of equal times the first.

        Only the messages themselves know their publish time, so all their chunks are unpacked; a process does it
        once per file and topic.

        Args:
            topic: full name.
            others: topics that will be asked for as well: their chunks are the same.
        """
        for t in (topic, *others):
            check_read(self.path, t)
        status = self.path.stat()
        file = str(self.path.resolve()), status.st_size, status.st_mtime_ns, status.st_ino
        if (*file, topic) not in _publish_times:
            found = {t: self.entries(t) for t in {topic, *others} if (*file, t) not in _publish_times}
            by_chunk = sorted((entry for entries in found.values() for entry in entries), key=lambda e: e[1:])
            times = {entry: self._publish_time(entry) for entry in by_chunk}
            for t, entries in found.items():
                _publish_times[(*file, t)] = {times[entry]: entry for entry in reversed(entries)}
        return _publish_times[(*file, topic)]

    def _publish_time(self, entry: tuple[int, int, int]) -> int:
        with parsing(self.path, self._stream):
            return self._sound_time(int(_MESSAGE.unpack_from(self._chunk(entry[1]), entry[2])[-1]))

    def _sound_time(self, time_ns: int) -> int:
        if time_ns >= LATEST_NS:
            raise DuagError(f"{self.path}: a message is of {time_ns} ns, expected less than {LATEST_NS}")
        return time_ns

    def record_at(self, topic: str, entry: tuple[int, int, int]) -> Record:
        """The message at an entry of `entries(topic)`; the last few chunks are kept unpacked.

        Args:
            topic: full name.
            entry: log time (ns), start of the chunk and offset in it, bytes.
        """
        check_read(self.path, topic)
        _, start, offset = entry
        with parsing(self.path, self._stream):
            data = self._chunk(start)
            _, length, number, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, offset)
            channel = self.channels[topic]
            if number != channel.id:
                raise DuagError(
                    f"{self.path}: {topic}: the index points at another topic, expected a sound MCAP log"
                )
            body = data[offset + _MESSAGE.size : offset + 9 + length]
            name, schema_data = self.schema_of(channel)
            times = self._sound_time(log_time), self._sound_time(publish_time)
            return Record(
                self.path, topic, name, *times, sequence=sequence, data=body, schema_data=schema_data
            )

    def _chunk(self, start: int) -> bytes:
        if start not in self._chunks:
            self._stream.seek(start + 9)
            chunk, new = Chunk.read(ReadDataStream(self._stream)), start not in self._sound_chunks
            stream, length = get_chunk_data_stream(chunk, validate_crc=new)
            self._sound_chunks.add(start)
            self._chunks[start] = stream.read(length)
            if len(self._chunks) > _CHUNKS_KEPT:
                self._chunks.popitem(last=False)
        self._chunks.move_to_end(start)
        return self._chunks[start]


def read_log(path: str | Path, topics: str | Topic | Iterable[str | Topic] | None = None) -> Iterator[Record]:
    """Yield the messages of a log, ordered by log time and then by position in the file.

    Args:
        path: an MCAP file; its checksums are compared before the first message comes.
        topics: only these, or this one; all if None. A row of the topic table stands for that topic of every robot in
            the log. A topic that the log does not have yields nothing.

    Raises:
        DuagError: the log is damaged, or the stage that runs did not declare a topic that it reads.
    """
    with LogFile(path) as log:
        if topics is None:
            yield from log.records(None)
            return
        wanted = {topics} if isinstance(topics, str | Topic) else set(topics)
        names = {t for t in wanted if isinstance(t, str)}
        names |= {t for t in log.channels if (row := find_topic(t)) is not None and row[0] in wanted}
        yield from log.records(sorted(names))


def merge(paths: Sequence[Path], topics: Iterable[str] | None = None) -> Iterator[Record]:
    """Yield the messages of several logs, ordered by log time, then by place in `paths`, then as in their log.

    Args:
        paths: of the logs.
        topics: full names; None: all.
    """
    wanted = topics if topics is None or isinstance(topics, str) else sorted(topics)

    def keyed(number: int, path: Path) -> Iterator[tuple[int, int, int, Record]]:
        for index, record in enumerate(read_log(path, wanted)):
            yield record.log_time_ns, number, index, record

    for *_, record in heapq.merge(
        *(keyed(number, path) for number, path in enumerate(paths)), key=lambda r: r[:3]
    ):
        yield record


def log_metadata(path: Path) -> dict[str, str]:
    """What was given to the writer of the log: the robot and the metadata given to `LogWriter`.

    Args:
        path: of the log.
    """
    with LogFile(path) as log:
        return dict(log.metadata()).get(LOG_RECORD, {})
