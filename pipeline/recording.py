"""Logs in, logs out: MCAP files that are checked whole before they are believed, and the recordings made of them.

Order of a log: by log time, then by position in the file. `log_time` is when a message was received, `publish_time`
when it was produced, `sequence` counts per topic from 0; all in the time of the recording, never the wall clock.
The identity of a log is its content digest: the bytes of the file depend on the version of the compressor.
"""

from __future__ import annotations

import hashlib
import heapq
import json
import math
import os
import struct
import weakref
import zlib
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Header, MessageIndex
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import CompressionType, IndexType, Writer
from numpy.typing import NDArray

import schemas
from pipeline import __version__, messages
from pipeline.errors import DuagError
from pipeline.geometry.camera import PinholeCamera
from schemas import topics as topic_table

MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 1 << 20
LIBRARY = f"duagc/{__version__}"
DIGEST_RECORD = "duagc.digest"  # metadata record with the content digest; itself not part of it
LOG_RECORD = "duagc.log"  # metadata record with what the writer was told about the log
ROBOT_KEY = "robot"
DEPTH_SCALE_KEY = "depth_scale"
RECORDING_FILE = "recording.json"
RECORDING_FORMAT = "duagc.recording"
RECORDING_SCHEMA = 1

_FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary start, summary offset start, CRC of the summary
_DATA_END = struct.Struct("<BQI")  # opcode, length, CRC of everything before
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_PIECE_BYTES = 1 << 20
_CHUNKS_KEPT = 4


# --- writing -----------------------------------------------------------------------------------------------------


class LogWriter:
    """Writes one log; use it as a context manager.

    The file has its final name only when it is complete: it is written as `<name>.part`, renamed on a clean exit and
    removed on any other. `digest` is the content digest once the writer is closed.
    """

    def __init__(self, path: Path, robot: str = "", metadata: Mapping[str, str] | None = None) -> None:
        """Args:
        path: the file.
        robot: whose log it is; "" if of the whole team.
        metadata: further text about the log, for example its configuration; part of the content digest.
        """
        self.path = Path(path)
        self.digest = ""
        self._metadata = {ROBOT_KEY: robot, **(metadata or {})}
        self._part = self.path.with_name(self.path.name + ".part")
        self._stream: IO[bytes] | None = None
        self._channels: dict[str, _OpenChannel] = {}
        self._schema_ids: dict[str, int] = {}
        self._content = _ContentDigest()
        self._last_log_time_ns = 0

    def __enter__(self) -> LogWriter:
        try:
            self._stream = self._part.open("wb")
        except OSError as error:
            raise DuagError(f"{self._part}: {error.strerror or error}, expected to write a log") from error
        self._writer = Writer(
            self._stream,
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            index_types=IndexType.ALL,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._writer.start(profile="", library=LIBRARY)
        self._writer.add_metadata(LOG_RECORD, dict(sorted(self._metadata.items())))
        return self

    def channel(self, topic: str, schema: str, metadata: Mapping[str, str] | None = None) -> None:
        """Open a topic with channel metadata, before its first message; without metadata this is not needed."""
        if topic in self._channels:
            raise ValueError(f"{topic} is open already")
        row = topic_table.find(topic)
        if row is None or row[0].schema != schema:
            expected = row[0].schema if row else "a topic of schemas/topics.py"
            raise ValueError(f"{topic} carries {schema}, expected {expected}")
        descriptors = schemas.descriptor_set(schema)
        if schema not in self._schema_ids:
            self._schema_ids[schema] = self._writer.register_schema(schema, "protobuf", descriptors)
        text = dict(sorted((metadata or {}).items()))
        number = self._writer.register_channel(topic, "protobuf", self._schema_ids[schema], text)
        identity = _channel_identity(topic, schema, descriptors)
        self._channels[topic] = _OpenChannel(number, schema, identity, text)

    def write(self, topic: str, message: Any, log_time_ns: int, publish_time_ns: int | None = None) -> None:
        """Append one message.

        Args:
            topic: a topic of schemas/topics.py.
            message: a dataclass of `pipeline.messages` or a protobuf message of the topic's schema.
            log_time_ns: when it was received; never earlier than that of the message before.
            publish_time_ns: when it was produced; the log time if not given.
        """
        proto = message.pack() if hasattr(message, "pack") else message
        schema = proto.DESCRIPTOR.full_name
        if topic not in self._channels:
            self.channel(topic, schema)
        channel = self._channels[topic]
        if schema != channel.schema:
            raise ValueError(f"{topic} carries {schema}, expected {channel.schema}")
        log_time_ns = int(log_time_ns)
        publish_time_ns = log_time_ns if publish_time_ns is None else int(publish_time_ns)
        if log_time_ns < self._last_log_time_ns or publish_time_ns < 0:
            raise ValueError(
                f"{topic} at {log_time_ns} ns comes after {self._last_log_time_ns} ns in {self.path.name}"
            )
        self._last_log_time_ns = log_time_ns
        data = proto.SerializeToString(deterministic=True)
        self._writer.add_message(channel.number, log_time_ns, data, publish_time_ns, channel.sequence)
        self._content.add(channel.identity, log_time_ns, publish_time_ns, channel.sequence, data)
        channel.sequence += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._stream is not None
        try:
            if kind is None:
                channels = [(c.identity, c.metadata) for c in self._channels.values()]
                log = {LOG_RECORD: self._metadata}
                self.digest = self._content.finish(channels, sorted(log.items()), [])
                self._writer.add_metadata(DIGEST_RECORD, {"sha256": self.digest})
                self._writer.finish()
                self._stream.close()
                os.replace(self._part, self.path)
        finally:
            self._stream.close()
            self._part.unlink(missing_ok=True)


@dataclass
class _OpenChannel:
    number: int
    schema: str
    identity: bytes
    metadata: dict[str, str]
    sequence: int = 0


# --- identity ----------------------------------------------------------------------------------------------------


def _framed(*parts: bytes) -> bytes:
    """Parts with their lengths before them, so that no two lists of parts give the same bytes."""
    return b"".join(struct.pack("<Q", len(part)) + part for part in parts)


def _channel_identity(topic: str, schema: str, schema_data: bytes) -> bytes:
    schema_digest = hashlib.sha256(schema_data).digest()
    return hashlib.sha256(_framed(topic.encode(), schema.encode(), schema_digest)).digest()


class _ContentDigest:
    """SHA-256 over messages in log order, then over channel metadata, metadata records and attachments, sorted."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def add(
        self, identity: bytes, log_time_ns: int, publish_time_ns: int, sequence: int, data: bytes
    ) -> None:
        self._hash.update(identity + struct.pack("<QQIQ", log_time_ns, publish_time_ns, sequence, len(data)))
        self._hash.update(data)

    def finish(
        self,
        channels: Iterable[tuple[bytes, Mapping[str, str]]],
        metadata: Iterable[tuple[str, Mapping[str, str]]],
        attachments: Iterable[bytes],
    ) -> str:
        named = [("", identity.hex(), text) for identity, text in channels]
        named += [("metadata", name, text) for name, text in metadata]
        rows = sorted((kind, name, sorted(text.items())) for kind, name, text in named)
        self._hash.update(_framed(json.dumps(rows).encode(), *sorted(attachments)))
        return self._hash.hexdigest()


def content_digest(path: Path) -> str:
    """64 hex characters that name what a log says, however its file is chunked and compressed."""
    with _LogFile(path) as log:
        content = _ContentDigest()
        for record in log.records(None):
            identity = log.identities[record.topic]
            content.add(identity, record.log_time_ns, record.publish_time_ns, record.sequence, record.data)
        channels = [(log.identities[topic], channel.metadata) for topic, channel in log.channels.items()]
        metadata = [(name, text) for name, text in log.metadata() if name != DIGEST_RECORD]
        return content.finish(channels, metadata, log.attachments())


# --- reading -----------------------------------------------------------------------------------------------------


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
        """The dataclass of `pipeline.messages` if the schema has one, else the protobuf message."""
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
def _parsing(path: Path) -> Iterator[None]:
    """Turn whatever a reader stumbles over in a broken file into one line."""
    try:
        yield
    except (DuagError, GeneratorExit):
        raise
    except OSError as error:
        raise DuagError(f"{path}: {error.strerror or error}, expected an MCAP log") from error
    except Exception as error:
        raise DuagError(
            f"{path}: found {type(error).__name__} ({error}), expected a sound MCAP log"
        ) from error


def _crc_of(stream: IO[bytes], start: int, stop: int) -> int:
    stream.seek(start)
    crc, left = 0, stop - start
    while left > 0:
        piece = stream.read(min(left, _PIECE_BYTES))
        if not piece:
            break
        crc, left = zlib.crc32(piece, crc), left - len(piece)
    return crc


_verified: set[tuple[str, int, int, int]] = set()


def verify(path: Path) -> None:
    """Read a log once and compare all its checksums, unless this process has done so and the file is unchanged.

    Raises:
        DuagError: missing, empty, no MCAP file, cut short, or any byte that differs from what was written.
    """
    path = Path(path)
    with _parsing(path):
        status = path.stat()
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


class _LogFile:
    """An MCAP file that has been verified, with its summary in hand."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        verify(self.path)
        with _parsing(self.path):
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
                topic: _channel_identity(topic, *self.schema_of(channel))
                for topic, channel in self.channels.items()
            }
        self._chunks: OrderedDict[int, bytes] = OrderedDict()

    def __enter__(self) -> _LogFile:
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
        """All messages of some topics, or of all, in the order of the log."""
        with _parsing(self.path):
            for schema, channel, m in self._reader.iter_messages(topics=topics, log_time_order=True):
                name, data = (schema.name, schema.data) if schema else ("", b"")
                yield Record(
                    self.path, channel.topic, name, m.log_time, m.publish_time, m.sequence, m.data, data
                )

    def metadata(self) -> list[tuple[str, dict[str, str]]]:
        """Metadata records: name and text."""
        with _parsing(self.path):
            return [(m.name, m.metadata) for m in self._reader.iter_metadata()]

    def attachments(self) -> list[bytes]:
        """Attachments, each as one string of bytes with its name and times."""
        with _parsing(self.path):
            return [
                _framed(
                    a.name.encode(),
                    a.media_type.encode(),
                    struct.pack("<QQ", a.create_time, a.log_time),
                    a.data,
                )
                for a in self._reader.iter_attachments()
            ]

    def entries(self, topic: str) -> list[tuple[int, int, int]]:
        """(log time, start of the chunk in the file, offset in the chunk) of every message of a topic, in log order."""
        if topic not in self.channels:
            return []
        number = self.channels[topic].id
        out = []
        with _parsing(self.path):
            for chunk in self.summary.chunk_indexes:
                position = chunk.message_index_offsets.get(number)
                if position is None:
                    continue
                self._stream.seek(position + 9)  # opcode and length
                index = MessageIndex.read(ReadDataStream(self._stream))
                out += [(time, chunk.chunk_start_offset, offset) for time, offset in index.records]
        return sorted(out)

    def record_at(self, topic: str, entry: tuple[int, int, int]) -> Record:
        """The message at an entry of `entries(topic)`; the last few chunks are kept unpacked."""
        _, start, offset = entry
        with _parsing(self.path):
            data = self._chunk(start)
            _, length, number, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, offset)
            channel = self.channels[topic]
            if number != channel.id:
                raise DuagError(
                    f"{self.path}: {topic}: the index points at another topic, expected a sound MCAP log"
                )
            body = data[offset + _MESSAGE.size : offset + 9 + length]
            name, schema_data = self.schema_of(channel)
            return Record(self.path, topic, name, log_time, publish_time, sequence, body, schema_data)

    def _chunk(self, start: int) -> bytes:
        if start not in self._chunks:
            self._stream.seek(start + 9)
            stream, length = get_chunk_data_stream(
                Chunk.read(ReadDataStream(self._stream)), validate_crc=True
            )
            self._chunks[start] = stream.read(length)
            if len(self._chunks) > _CHUNKS_KEPT:
                self._chunks.popitem(last=False)
        self._chunks.move_to_end(start)
        return self._chunks[start]


def read_log(path: Path, topics: Iterable[str] | None = None) -> Iterator[Record]:
    """Yield the messages of a log, ordered by log time and then by position in the file.

    Args:
        path: an MCAP file; its checksums are compared before the first message comes.
        topics: only these; all if None. A topic that the log does not have yields nothing.
    """
    with _LogFile(path) as log:
        yield from log.records(None if topics is None else sorted(topics))


def merge(paths: Sequence[Path], topics: Iterable[str] | None = None) -> Iterator[Record]:
    """Yield the messages of several logs, ordered by log time, then by place in `paths`, then as in their log."""
    wanted = None if topics is None else sorted(topics)

    def keyed(number: int, path: Path) -> Iterator[tuple[int, int, int, Record]]:
        for index, record in enumerate(read_log(path, wanted)):
            yield record.log_time_ns, number, index, record

    for *_, record in heapq.merge(
        *(keyed(number, path) for number, path in enumerate(paths)), key=lambda r: r[:3]
    ):
        yield record


def log_metadata(path: Path) -> dict[str, str]:
    """What the writer was told about the log: the robot and the metadata given to `LogWriter`."""
    with _LogFile(path) as log:
        return dict(log.metadata()).get(LOG_RECORD, {})


# --- colour and depth --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RgbdFrame:
    """One colour image with its depth.

    index: position in the log. stamp_ns: when both were taken. color: uint8 [H, W, 3], RGB.
    depth: float32 [H, W], metres along z, 0 where nothing was measured.
    """

    index: int
    stamp_ns: int
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]


class RgbdLog:
    """Registered colour and depth of one robot; frames are paired by equal publish time.

    `robot`, `camera`, `depth_scale` (metres per unit). Reads what is asked for and keeps no more than a few frames.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._log = _LogFile(self.path)
        try:
            self._open()
        except BaseException:
            self._log.close()
            raise

    def _open(self) -> None:
        found = [(row[1], topic) for topic in self._log.channels if (row := topic_table.find(topic))]
        robots = sorted({robot for robot, topic in found if topic == topic_table.COLOR.of(robot)})
        if len(robots) != 1:
            pattern = topic_table.COLOR.pattern
            raise DuagError(f"{self.path}: {pattern} found for robots {robots}, expected exactly one robot")
        self.robot = robots[0]
        self._color_topic = topic_table.COLOR.of(self.robot)
        self._depth_topic = topic_table.DEPTH.of(self.robot)
        self._color = self._log.entries(self._color_topic)
        self._depth = self._log.entries(self._depth_topic)
        if not self._color and not self._depth:
            raise DuagError(f"{self.path}: {self._color_topic} has no message, expected images")
        if len(self._color) != len(self._depth):
            raise DuagError(self._unpaired())
        self.camera = self._read_camera()
        self.depth_scale = self._read_depth_scale()

    def _unpaired(self) -> str:
        """The line that names the first image without a partner."""
        stamps = {
            topic: {r.publish_time_ns for r in self._log.records([topic])}
            for topic in (self._color_topic, self._depth_topic)
        }
        color, depth = stamps[self._color_topic], stamps[self._depth_topic]
        for stamp in sorted(color ^ depth):
            here, there = self._color_topic, self._depth_topic
            if stamp in depth:
                here, there = there, here
            return f"{self.path}: {here} has an image at {stamp} ns, expected one in {there} at the same time"
        counts = f"{len(self._color)} and {len(self._depth)}"
        return (
            f"{self.path}: {self._color_topic} and {self._depth_topic} have {counts} images, expected as many"
        )

    def _read_camera(self) -> PinholeCamera:
        topic = topic_table.CALIBRATION.of(self.robot)
        cameras = []
        for entry in self._log.entries(topic):
            record = self._log.record_at(topic, entry)
            try:
                cameras.append((record.log_time_ns, messages.unpack_calibration(record.proto())))
            except DuagError as error:
                raise DuagError(f"{self.path}: {topic}: {error}") from error
        if not cameras:
            raise DuagError(f"{self.path}: {topic} has no message, expected the calibration of the camera")
        if cameras[0][0] > self._color[0][0]:
            first, image = cameras[0][0], self._color[0][0]
            raise DuagError(
                f"{self.path}: {topic} begins at {first} ns, expected no later than the images ({image} ns)"
            )
        for time, camera in cameras:
            if camera != cameras[0][1]:
                raise DuagError(
                    f"{self.path}: {topic} changes at {time} ns to {camera}, expected {cameras[0][1]}"
                )
        return cameras[0][1]

    def _read_depth_scale(self) -> float:
        text = self._log.channels[self._depth_topic].metadata.get(DEPTH_SCALE_KEY)
        try:
            scale = float(text or "missing")
        except ValueError:
            scale = math.nan
        if not (math.isfinite(scale) and scale > 0):
            where = f"{self.path}: {self._depth_topic}: channel metadata {DEPTH_SCALE_KEY}"
            raise DuagError(f"{where} is {text!r}, expected metres per unit, for example '0.001'")
        return scale

    def __len__(self) -> int:
        return len(self._color)

    def __enter__(self) -> RgbdLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._log.close()

    def frames(self) -> Iterator[RgbdFrame]:
        """Every frame in order of time."""
        for index in range(len(self)):
            yield self.frame(index)

    def frame(self, index: int) -> RgbdFrame:
        """Frame `index`, 0 <= index < len(self)."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        color = self._log.record_at(self._color_topic, self._color[index])
        depth = self._log.record_at(self._depth_topic, self._depth[index])
        if color.publish_time_ns != depth.publish_time_ns:
            raise DuagError(
                f"{self.path}: {depth.topic} number {index} is of {depth.publish_time_ns} ns, "
                f"expected {color.publish_time_ns} ns as in {color.topic}"
            )
        return RgbdFrame(index, color.publish_time_ns, self._decode_color(color), self._decode_depth(depth))

    def _decode_color(self, record: Record) -> NDArray[np.uint8]:
        import cv2

        data = np.frombuffer(record.proto().data, np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
        if image is None:
            where = f"{self.path}: {record.topic} at {record.publish_time_ns} ns"
            raise DuagError(f"{where} has {len(data)} bytes that no decoder reads, expected JPEG or PNG")
        self._check_size(record, image.shape[1], image.shape[0])
        return np.ascontiguousarray(image[:, :, ::-1])

    def _decode_depth(self, record: Record) -> NDArray[np.float32]:
        raw = messages.unpack_depth(
            record.proto(), f"{self.path}: {record.topic} at {record.publish_time_ns} ns"
        )
        self._check_size(record, raw.shape[1], raw.shape[0])
        return raw.astype(np.float32) * np.float32(self.depth_scale)

    def _check_size(self, record: Record, width: int, height: int) -> None:
        if (width, height) != (self.camera.width, self.camera.height):
            raise DuagError(
                f"{self.path}: {record.topic} at {record.publish_time_ns} ns is {width}x{height}, "
                f"expected {self.camera.width}x{self.camera.height} as in the calibration"
            )


def open_rgbd(path: Path) -> RgbdLog:
    """Open the log of one robot's camera; see `RgbdLog`."""
    return RgbdLog(path)


# --- recordings --------------------------------------------------------------------------------------------------


class Recording:
    """A folder with one log per robot and a `recording.json` that says what they are."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.description = _read_description(self.path / RECORDING_FILE)
        self.name: str = self.description["name"]
        self._robots: dict[str, dict[str, Any]] = self.description["robots"]

    @property
    def robots(self) -> list[str]:
        """Names of the robots, sorted."""
        return sorted(self._robots)

    def log(self, robot: str) -> Path:
        """The log of a robot's sensors."""
        path = self.path / self._robot(robot)["log"]
        if not path.is_file():
            raise DuagError(f"{path}: no such file, expected the log of {robot} that {RECORDING_FILE} names")
        return path

    def groundtruth(self, robot: str) -> Path | None:
        """The log of a robot's ground truth, for evaluation only; None where there is none, listed or not."""
        name = self._robot(robot).get("groundtruth")
        return self.path / name if name and (self.path / name).is_file() else None

    def geometry(self) -> Path | None:
        """The true geometry of the scene, for evaluation only; None where there is none."""
        name = self.description.get("geometry")
        return self.path / name if name and (self.path / name).is_file() else None

    def _robot(self, robot: str) -> dict[str, Any]:
        if robot not in self._robots:
            raise DuagError(
                f"{self.path}: found robots {', '.join(self.robots)}, expected {robot!r} among them"
            )
        return self._robots[robot]


def _read_description(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise DuagError(f"{path}: no such file, expected a recording (a folder with {RECORDING_FILE})")
    try:
        description = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DuagError(f"{path}: {error}, expected the JSON of a recording") from error
    if not isinstance(description, dict) or description.get("format") != RECORDING_FORMAT:
        found = description.get("format") if isinstance(description, dict) else type(description).__name__
        raise DuagError(f"{path}: format is {found!r}, expected {RECORDING_FORMAT!r}")
    if description.get("schema") != RECORDING_SCHEMA:
        raise DuagError(f"{path}: schema is {description.get('schema')!r}, expected {RECORDING_SCHEMA}")
    robots = description.get("robots")
    if not isinstance(robots, dict) or not robots or not isinstance(description.get("name"), str):
        raise DuagError(f"{path}: found no name or no robots, expected both")
    _check_file_name(path, "geometry", description.get("geometry"))
    for robot, row in robots.items():
        if not isinstance(row, dict) or not isinstance(row.get("log"), str):
            raise DuagError(f"{path}: robot {robot!r} has no log, expected the name of one")
        _check_file_name(path, f"{robot}.log", row["log"])
        _check_file_name(path, f"{robot}.groundtruth", row.get("groundtruth"))
    return description


def _check_file_name(path: Path, field: str, name: Any) -> None:
    """Files of a recording lie in its folder: no path leads out of it."""
    if name is not None and (not isinstance(name, str) or not name or Path(name).name != name):
        raise DuagError(f"{path}: {field} is {name!r}, expected the name of a file in the same folder")


# --- what is in it ---------------------------------------------------------------------------------------------------

GAP_RATIO = 1.5  # an interval this much longer than the median one is a gap


def info(path: Path) -> dict[str, Any]:
    """What is in a log, a recording or a run: topics, counts, rates, times, extents, gaps, digests, warnings.

    Returns:
        Plain numbers and text, ready for JSON; "kind" is "log", "recording" or "run". What is not known is None.
    """
    path = Path(path)
    if path.is_file():
        return {"kind": "log", **_log_info(path)}
    if (path / RECORDING_FILE).is_file():
        return _recording_info(path)
    logs = sorted(p for p in path.rglob("*.mcap")) if path.is_dir() else []
    if not logs:
        found = "a folder without logs" if path.is_dir() else "no such file or folder"
        raise DuagError(f"{path}: {found}, expected a log, a recording or a run")
    return {"kind": "run", "logs": {p.relative_to(path).as_posix(): _log_info(p) for p in logs}}


def _log_info(path: Path) -> dict[str, Any]:
    with _LogFile(path) as log:
        metadata = dict(log.metadata())
        topics = {topic: _topic_info(log, topic) for topic in sorted(log.channels)}
        times = [t[key] for t in topics.values() for key in ("start_ns", "end_ns") if t["messages"]]
        warnings = [f"{topic}: {w}" for topic, t in topics.items() for w in t.pop("warnings")]
        return {
            "robot": metadata.get(LOG_RECORD, {}).get(ROBOT_KEY) or None,
            "bytes": path.stat().st_size,
            "messages": sum(t["messages"] for t in topics.values()),
            "start_ns": min(times, default=None),
            "end_ns": max(times, default=None),
            "digest": metadata.get(DIGEST_RECORD, {}).get("sha256"),
            "topics": topics,
            "warnings": warnings,
        }


def _topic_info(log: _LogFile, topic: str) -> dict[str, Any]:
    channel = log.channels[topic]
    times = np.array([time for time, _, _ in log.entries(topic)], dtype=np.int64)
    statistics = log.summary.statistics
    count = statistics.channel_message_counts.get(channel.id, 0) if statistics else len(times)
    warnings = []
    if count != len(times):
        warnings.append(f"{count} messages, of which the index knows {len(times)}")
    out: dict[str, Any] = {
        "schema": log.schema_of(channel)[0] or None,
        "messages": count,
        "start_ns": int(times[0]) if len(times) else None,
        "end_ns": int(times[-1]) if len(times) else None,
        "rate_hz": None,
        "metadata": channel.metadata,
        "warnings": warnings,
    }
    intervals = np.diff(times)
    if len(intervals) and times[-1] > times[0]:
        out["rate_hz"] = len(intervals) / (int(times[-1] - times[0]) * 1e-9)
        row = topic_table.find(topic)
        gaps = intervals[intervals > GAP_RATIO * np.median(intervals)]
        if len(gaps) and row is not None and row[0].scope is topic_table.Scope.SENSOR:
            warnings.append(f"{len(gaps)} gaps, the longest {gaps.max() * 1e-9:.3f} s")
    return out


def _recording_info(path: Path) -> dict[str, Any]:
    recording = Recording(path)
    out: dict[str, Any] = {"kind": "recording", **recording.description, "robots": {}}
    out["warnings"] = warnings = list(recording.description.get("warnings", []))
    for robot in recording.robots:
        row = dict(recording.description["robots"][robot])
        log = _log_info(recording.log(robot))
        recorded = row.get("digests", {}).get(row["log"])
        if recorded and log["digest"] != recorded:
            warnings.append(f"{robot}: {row['log']} has digest {log['digest']}, expected {recorded}")
        if recording.groundtruth(robot) is None:
            row["groundtruth"] = None
        warnings += [f"{robot}: {w}" for w in log["warnings"]]
        out["robots"][robot] = {
            **row,
            "bytes": log["bytes"],
            "messages": log["messages"],
            "topics": log["topics"],
        }
    return out


def format_info(content: Mapping[str, Any]) -> str:
    """The result of `info` as text for people."""
    if content["kind"] == "log":
        lines = _log_lines(content)
    elif content["kind"] == "run":
        lines = [
            line for name, log in content["logs"].items() for line in (f"{name}", *_log_lines(log, "  "))
        ]
    else:
        source = " ".join(str(v) for v in content["source"].values() if isinstance(v, str) and v)
        lines = [f"recording {content['name']}: {source}, {len(content['robots'])} robots"]
        for robot, row in content["robots"].items():
            lines += _robot_lines(robot, row)
    return "\n".join([*lines, *(f"warning: {w}" for w in content.get("warnings", []))])


def _robot_lines(robot: str, row: Mapping[str, Any]) -> list[str]:
    c = row["camera"]
    seconds = (row["end_ns"] - row["start_ns"]) * 1e-9
    lines = [
        f"  {robot}: {row['frames']} frames in {seconds:.2f} s, {row['bytes'] / 1e6:.1f} MB",
        f"    camera {c['width']}x{c['height']}, focal length {c['fx']:g} {c['fy']:g} px, "
        f"centre {c['cx']:g} {c['cy']:g} px, depth in {row['depth_scale_m']:g} m",
        f"    ground truth: {row['groundtruth'] or 'none'}",
    ]
    if row.get("path"):
        span = ", ".join(
            f"{low:.2f}..{high:.2f}"
            for low, high in zip(row["path"]["low_m"], row["path"]["high_m"], strict=True)
        )
        lines.append(f"    path {row['path']['length_m']:.2f} m within {span} m")
    return lines + _topic_lines(row["topics"], "    ")


def _log_lines(log: Mapping[str, Any], indent: str = "") -> list[str]:
    span = "no messages"
    if log["start_ns"] is not None:
        span = f"{log['messages']} messages, {log['start_ns'] * 1e-9:.3f} to {log['end_ns'] * 1e-9:.3f} s"
    size, digest = f"{log['bytes'] / 1e6:.1f} MB", log["digest"] or "not recorded"
    first = f"{indent}{log['robot'] or 'team'}: {span}, {size}, digest {digest}"
    return [first, *_topic_lines(log["topics"], indent + "  ")]


def _topic_lines(topics: Mapping[str, Any], indent: str) -> list[str]:
    width = max((len(t) for t in topics), default=0)
    return [
        f"{indent}{topic:<{width}}  {t['messages']:>7}  "
        + (f"{t['rate_hz']:8.2f} Hz" if t["rate_hz"] else " " * 11)
        + f"  {t['schema'] or 'no schema'}"
        for topic, t in topics.items()
    ]
