"""MCAP files of any program: messages of ROS 1 and ROS 2, and Foxglove's in protobuf or JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from mcap.reader import SeekingReader, Summary
from mcap.records import Channel, Chunk, Message, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk

from duagc import schemas
from duagc.converters.logs import foxglove, ros_json
from duagc.converters.logs.entries import (
    Entry,
    InvalidMessage,
    LogTopic,
    reason,
    ros_type,
    sound_time,
    stamp_ns,
)
from duagc.converters.logs.mcap_chunks import Chunks
from duagc.converters.logs.ros_messages import RosMessages
from duagc.converters.logs.rosbag_file import LARGEST_CHUNK, reading
from duagc.converters.logs.topic_types import as_one
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import check_file
from duagc.pipeline.recording.names import MAGIC, is_mcap

WANTED = "a sound MCAP log"


class McapFile:
    """An MCAP file. Without an index it is read from its beginning, in the order of the file."""

    def __init__(self, path: Path) -> None:
        """Open a file and read its summary.

        Args:
            path: of the file.

        Raises:
            DuagError: it is missing or broken.
        """
        self.path = path
        self.topics: dict[str, LogTopic] = {}
        self._decoders: dict[int, _Decoder] = {}
        self._kinds: dict[int, str] = {}  # of their messages, as `LogTopic` has it
        check_file(path, WANTED)
        with reading(path, WANTED):
            self._stream = path.open("rb")
            try:
                self._open()
            except BaseException:
                self._stream.close()
                raise

    def _open(self) -> None:
        if not is_mcap(self.path):
            raise DuagError(f"{self.path}: is no MCAP, expected {WANTED}")
        self._stream.seek(-len(MAGIC), 2)
        if self._stream.read() != MAGIC:
            raise DuagError(f"{self.path}: is cut short; what it holds can be saved with `duagc recover`")
        self._stream.seek(0)
        reader = SeekingReader(self._stream, validate_crcs=True, record_size_limit=LARGEST_CHUNK)
        summary = reader.get_summary()
        statistics = summary.statistics if summary else None
        self._indexed = bool(
            summary
            and statistics
            and summary.chunk_indexes
            and all(chunk.message_index_offsets for chunk in summary.chunk_indexes)
            and _is_complete(summary, statistics)
        )
        if summary and statistics and self._indexed:
            self._chunks = Chunks(self._stream, summary.chunk_indexes)
            for index in summary.chunk_indexes:
                self._check_size(self._beginning(index.chunk_start_offset))
            counts = Counter(statistics.channel_message_counts)
            channels, schemas = summary.channels, summary.schemas
        else:
            channels, schemas, counts = {}, {}, Counter()
            for record in self._records():
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    counts[record.channel_id] += 1
        self._channels = channels
        for number, channel in sorted(channels.items()):
            self._add(channel, schemas.get(channel.schema_id), counts[number])

    def _add(self, channel: Channel, schema: Schema | None, count: int) -> None:
        """Make a channel known: the type of its messages by ROS's name, and how they are read."""
        encoding, name = channel.message_encoding, schema.name if schema else ""
        plain = foxglove.plain_name(name)
        kind = foxglove.ROS_TYPES.get(plain)
        if schema and encoding in ("cdr", "ros1"):
            kind = kind or ros_type(name)
            text, is_idl = schema.data.decode(errors="replace"), schema.encoding == "ros2idl"
            self._decoders[channel.id] = RosMessages(name, encoding, text, is_idl=is_idl)
        elif schema and kind and encoding in ("protobuf", "json"):
            self._decoders[channel.id] = _Foxglove(schema, encoding)
        elif schema and encoding == "json" and ros_json.is_read(ros_type(name)):
            kind = ros_type(name)
            self._decoders[channel.id] = _RosJson(kind)
        else:  # nothing that is read here; still shown to people
            kind = f"{name or 'no schema'} as {encoding or 'nothing known'}"
            self._decoders[channel.id] = _Unknown(kind)
        stated = dict(channel.metadata)
        topic = LogTopic(channel.topic, kind, name, encoding, count, stated)
        known = self.topics.get(channel.topic)
        self.topics[channel.topic] = as_one([known, topic]) if known else topic
        self._kinds[channel.id] = kind

    def _records(self) -> Iterator[Any]:
        """Schemas, channels and messages in the order of the file; several may be on their way."""
        with self.path.open("rb") as stream:
            for record in StreamReader(stream, emit_chunks=True, record_size_limit=LARGEST_CHUNK).records:
                if isinstance(record, Chunk):
                    self._check_size(record)
                    yield from breakup_chunk(record, validate_crc=True)
                else:
                    yield record

    def _beginning(self, offset: int) -> Chunk:
        """A chunk with no more of its records than tell their unpacked size."""
        self._stream.seek(offset)
        head = self._stream.read(256)
        length = int.from_bytes(head[37:41], "little")  # of the name of the compression
        start = 41 + length + 8
        compression = head[41 : 41 + length].decode(errors="replace")
        return Chunk(
            compression=compression,
            data=head[start:],
            message_end_time=0,
            message_start_time=0,
            uncompressed_crc=0,
            uncompressed_size=int.from_bytes(head[25:33], "little"),
        )

    def _check_size(self, chunk: Chunk) -> None:
        """Refuse a chunk that would unpack into more than memory, whatever the file says."""
        size = chunk.uncompressed_size
        if chunk.compression == "zstd":
            import zstandard

            stated = zstandard.get_frame_parameters(chunk.data).content_size
            size = max(size, stated if stated < zstandard.CONTENTSIZE_UNKNOWN else 0)
        elif chunk.compression == "lz4":
            import lz4.frame

            size = max(size, lz4.frame.get_frame_info(chunk.data)["content_size"])
        if size > LARGEST_CHUNK:
            raise DuagError(f"{self.path}: a chunk unpacks to {size} bytes, expected at most {LARGEST_CHUNK}")

    def _messages(self, topics: Sequence[str], heads: Sequence[str]) -> Iterator[tuple[int, int, int, bytes]]:
        """Channel, time of recording, time of publication and bytes."""
        wanted = {
            number: (self._decoders[number].tells_time if channel.topic in heads else None)
            for number, channel in self._channels.items()
            if channel.topic in topics
        }
        if self._indexed:
            for m in self._chunks.messages(wanted):
                yield m.channel, m.log_ns, m.publish_ns, m.data
            return
        for record in self._records():
            if isinstance(record, Message) and record.channel_id in wanted:
                yield record.channel_id, record.log_time, record.publish_time, record.data

    def entries(self, topics: Sequence[str], heads: Sequence[str] = ()) -> Iterator[Entry]:
        """Messages of these topics in order of recording.

        Args:
            topics: their names.
            heads: those of which `header_ns` is all that will be asked; `data` may be cut behind it.

        Raises:
            DuagError: the file is broken, or a message has no sound time.
        """
        with reading(self.path, WANTED):
            for number, log_ns, publish_ns, data in self._messages(topics, heads):
                topic, decoder = self._channels[number].topic, self._decoders[number]
                where = f"{self.path}: {topic}"
                yield Entry(
                    topic,
                    sound_time(log_ns, where),
                    sound_time(publish_ns, where),
                    data,
                    partial(decoder.read, data, where),
                    partial(decoder.header_ns, data, where),
                    type=self._kinds[number],
                )

    def close(self) -> None:
        self._stream.close()


def _is_complete(summary: Summary, statistics: Statistics) -> bool:
    """Whether a summary repeats all channels that have messages, and their schemas; writers may leave them out."""
    known = summary.channels
    return (
        all(
            number in known and (known[number].schema_id == 0 or known[number].schema_id in summary.schemas)
            for number, count in statistics.channel_message_counts.items()
            if count
        )
        and sum(statistics.channel_message_counts.values()) == statistics.message_count
    )


class _Decoder(Protocol):
    """Reads the messages of one channel."""

    def read(self, data: bytes, where: str) -> Any: ...

    def header_ns(self, data: bytes, where: str) -> int: ...

    def tells_time(self, head: bytes) -> bool:
        """Whether `header_ns` needs no more than these first bytes of a message."""
        ...


class _RosJson:
    """Messages of ROS in JSON."""

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def read(self, data: bytes, where: str) -> Any:
        return ros_json.read(self.kind, data, where)

    def header_ns(self, data: bytes, where: str) -> int:
        return ros_json.header_ns(self.kind, data, where)

    def tells_time(self, head: bytes) -> bool:
        return False


class _Foxglove:
    """Foxglove's messages in protobuf, by our classes, or JSON."""

    def __init__(self, schema: Schema, encoding: str) -> None:
        self.name, self.encoding = foxglove.plain_name(schema.name), encoding

    def read(self, data: bytes, where: str) -> Any:
        return foxglove.as_ros(self.name, self._message(data, where), where)

    def header_ns(self, data: bytes, where: str) -> int:
        """Without unpacking the image: of transforms in a list the first one's."""
        first = self._first_stamp(data)
        if first is not None:
            return first
        message = self._message(data, where)
        if self.name == "foxglove.FrameTransforms":
            return stamp_ns(foxglove.as_ros(self.name, message, where))
        return foxglove.stamp_ns(message, where)

    def tells_time(self, head: bytes) -> bool:
        return self._first_stamp(head) is not None

    def _first_stamp(self, head: bytes) -> int | None:
        """The time, where it stands in the first bytes of the message, as it most often does."""
        if self.name == "foxglove.FrameTransforms":  # has no time of its own
            return None
        if self.encoding == "json":
            return foxglove.first_stamp_of_json(head)
        return foxglove.first_stamp_of_protobuf(head)

    def _message(self, data: bytes, where: str) -> Any:

        try:
            if self.encoding == "json":
                members = foxglove.json_members(data)
                return foxglove.JsonFields(members if isinstance(members, dict) else {})
            return schemas.message_class(self.name).FromString(data)
        except Exception as error:  # protobuf's DecodeError, broken JSON, broken text
            raise InvalidMessage(
                where, f"holds {len(data)} bytes that are no {self.name} in {self.encoding} ({reason(error)})"
            ) from error


class _Unknown:
    """Messages that are not read here."""

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def read(self, data: bytes, where: str) -> Any:
        raise DuagError(f"{where} is {self.kind}, expected ROS or Foxglove")

    def header_ns(self, data: bytes, where: str) -> int:
        return 0

    def tells_time(self, head: bytes) -> bool:
        return True
