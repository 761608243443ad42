"""Reads logs: the checksums of the whole file are compared before the first message comes."""

from __future__ import annotations

import heapq
import struct
import weakref
import zlib
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Header, MessageIndex
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary

from duagc import schemas
from duagc.pipeline import messages
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track
from duagc.pipeline.base.workers import hand_down
from duagc.pipeline.recording.access import check_read
from duagc.pipeline.recording.identity import channel_identity, framed
from duagc.pipeline.recording.names import LIBRARY, LOG_RECORD, MAGIC
from duagc.schemas.topics import Topic
from duagc.schemas.topics import find as find_topic

_FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary start, summary offset start, CRC of the summary
_DATA_END = struct.Struct("<BQI")  # opcode, length, CRC of everything before
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_PIECE_BYTES = 1 << 20
_CHUNKS_KEPT = 4
_LONG_BYTES = 1 << 30  # takes long enough that somebody wonders
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


@contextmanager
def parsing(path: Path, stream: IO[bytes] | None = None) -> Iterator[None]:
    """Turn whatever a reader stumbles over in a broken file, or in one that was closed, into one line."""
    try:
        yield
    except (DuagError, GeneratorExit):
        raise
    except OSError as error:
        raise DuagError(f"{path}: {error.strerror or error}, expected an MCAP log") from error
    except Exception as error:
        if stream is not None and stream.closed:
            raise DuagError(f"{path}: the log was closed, expected it open while it is read") from error
        raise DuagError(
            f"{path}: found {type(error).__name__} ({error}), expected a sound MCAP log"
        ) from error


def _crc_of(stream: IO[bytes], start: int, stop: int) -> int:
    stream.seek(start)
    crc = 0
    pieces = range(start, stop, _PIECE_BYTES)
    long = stop - start > _LONG_BYTES
    for at in track(pieces, "compare checksums, MB") if long else pieces:
        crc = zlib.crc32(stream.read(min(stop - at, _PIECE_BYTES)), crc)
    return crc


_Verified = set[tuple[str, int, int, int]]
_PublishTimes = dict[tuple[str, int, int, int, str], dict[int, tuple[int, int, int]]]
_verified: _Verified = set()
_publish_times: _PublishTimes = {}


def _known() -> tuple[_Verified, _PublishTimes]:
    """What this process knows of files, as long as they are unchanged."""
    return set(_verified), dict(_publish_times)


def _learn(known: tuple[_Verified, _PublishTimes]) -> None:
    _verified.update(known[0])
    _publish_times.update(known[1])


hand_down(_known, _learn)


def verify(path: Path) -> None:
    """Read a log once and compare all its checksums, unless this process has done so and the file is unchanged.

    Args:
        path: of the log.

    Raises:
        DuagError: missing, empty, no MCAP file, cut short, or any byte that differs from what was written.
    """
    path = Path(path)
    with parsing(path):
        status = path.stat()
        if not (path.is_file() or path.is_dir()):  # a pipe might never end
            raise DuagError(f"{path}: is no regular file, expected an MCAP log")
        key = (str(path.resolve()), status.st_size, status.st_mtime_ns, status.st_ino)
        if key not in _verified:
            with path.open("rb") as stream:
                _verify_stream(path, stream, status.st_size)
            _verified.add(key)


def _verify_stream(path: Path, stream: IO[bytes], size: int) -> None:
    if size == 0:
        raise DuagError(f"{path}: the file is empty, expected an MCAP log")
    if stream.read(len(MAGIC)) != MAGIC:
        raise DuagError(f"{path}: does not begin with the magic bytes of MCAP, expected an MCAP log")
    tail = _FOOTER.size + len(MAGIC)
    stream.seek(max(0, size - tail))
    footer = stream.read(tail)
    if size < len(MAGIC) + tail or not footer.endswith(MAGIC):
        raise DuagError(
            f"{path}: is cut short after {size} bytes: no magic bytes at the end, expected an MCAP log"
        )
    opcode, length, summary_start, _, summary_crc = _FOOTER.unpack_from(footer)
    data_end_start = summary_start - _DATA_END.size
    sound = opcode == Opcode.FOOTER and length == _FOOTER.size - 9
    if not sound or not len(MAGIC) <= data_end_start <= size - tail - _DATA_END.size:
        raise DuagError(f"{path}: found no summary where the footer says, expected a sound MCAP log")
    ours = _library(stream).startswith(LIBRARY.split("/")[0])
    found = _crc_of(stream, summary_start, size - len(MAGIC) - 4)
    if found != summary_crc and (summary_crc or ours):
        raise DuagError(f"{path}: the summary has checksum {found:08x}, expected {summary_crc:08x}")
    stream.seek(data_end_start)
    opcode, length, data_crc = _DATA_END.unpack(stream.read(_DATA_END.size))
    if opcode != Opcode.DATA_END or length != 4:
        raise DuagError(f"{path}: found no end of the data before the summary, expected a sound MCAP log")
    found = _crc_of(stream, 0, data_end_start)
    if found != data_crc and (data_crc or ours):
        raise DuagError(f"{path}: the data has checksum {found:08x}, expected {data_crc:08x}")


def _library(stream: IO[bytes]) -> str:
    """What wrote the file. Other programs than ours may leave checksums out, as zero."""
    stream.seek(len(MAGIC))
    opcode, _ = struct.unpack("<BQ", stream.read(9))
    if opcode != Opcode.HEADER:
        raise ValueError(f"first record has opcode {opcode}, not that of a header")
    return Header.read(ReadDataStream(stream)).library


class LogFile:
    """An MCAP file that has been verified, with its summary in hand."""

    def __init__(self, path: Path) -> None:
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
        self._stream.close()

    def schema_of(self, channel: Channel) -> tuple[str, bytes]:
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
        once per file and topic. others: topics that will be asked for as well: their chunks are the same.
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


def read_log(path: Path, topics: str | Topic | Iterable[str | Topic] | None = None) -> Iterator[Record]:
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
    """Yield the messages of several logs, ordered by log time, then by place in `paths`, then as in their log."""
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
