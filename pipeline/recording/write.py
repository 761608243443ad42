"""Writes logs: MCAP, zstd, chunks of 1 MiB, all indexes, checksums of chunks, data and summary."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from mcap.writer import CompressionType, IndexType, Writer

from duagc import schemas
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.shelf import LARGE_BYTES, SHELF
from duagc.pipeline.recording.access import check_write
from duagc.pipeline.recording.identity import ContentDigest, channel_identity
from duagc.pipeline.recording.names import DIGEST_RECORD, LIBRARY, LOG_RECORD, ROBOT_KEY
from duagc.pipeline.recording.read import LogFile, Record
from duagc.schemas import topics as topic_table

CHUNK_BYTES = 1 << 20


def mcap_writer(stream: IO[bytes]) -> Writer:
    """A writer with the settings of our logs, not yet started.

    Args:
        stream: that takes the bytes.
    """
    return Writer(
        stream,
        chunk_size=CHUNK_BYTES,
        compression=CompressionType.ZSTD,
        index_types=IndexType.ALL,
        enable_crcs=True,
        enable_data_crcs=True,
    )


class LogWriter:
    """Writes one log; use it as a context manager.

    The file has its final name only when it is complete: it is written as `<name>.part`, renamed on a clean exit and
    removed on any other. `digest` is the content digest once the writer is closed.
    """

    def __init__(self, path: str | Path, robot: str = "", metadata: Mapping[str, str] | None = None) -> None:
        """Keep the path and the metadata; the file is opened when the context is entered.

        Args:
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
        self._schema_ids: dict[tuple[str, bytes], int] = {}
        self._content = ContentDigest()
        self._last_log_time_ns = 0

    def __enter__(self) -> LogWriter:
        try:
            self._stream = self._part.open("wb")
        except OSError as error:
            raise DuagError(f"{self._part}: {error.strerror or error}, expected to write a log") from error
        self._writer = mcap_writer(self._stream)
        self._writer.start(profile="", library=LIBRARY)
        self._writer.add_metadata(LOG_RECORD, dict(sorted(self._metadata.items())))
        return self

    def channel(self, topic: str, schema: str, metadata: Mapping[str, str] | None = None) -> None:
        """Open a topic before its first message; without metadata this is not needed.

        Args:
            topic: a topic of schemas/topics.py.
            schema: full name of its schema.
            metadata: text about the channel, for example depth_scale.

        Raises:
            ValueError: the topic is open already, is not in the table, or carries another schema.
        """
        if topic in self._channels:
            raise ValueError(f"{topic} is open already")
        row = topic_table.find(topic)
        if row is None or row[0].schema != schema:
            expected = row[0].schema if row else "a topic of schemas/topics.py"
            raise ValueError(f"{topic} carries {schema}, expected {expected}")
        check_write(self.path, topic)
        descriptors = schemas.descriptor_set(schema)
        self._open(topic, (schema, "protobuf", descriptors), "protobuf", metadata or {})

    def _open(
        self, topic: str, schema: tuple[str, str, bytes], encoding: str, metadata: Mapping[str, str]
    ) -> None:
        name, schema_encoding, data = schema
        number = 0  # without a schema
        if name:
            if (name, data) not in self._schema_ids:
                self._schema_ids[name, data] = self._writer.register_schema(name, schema_encoding, data)
            number = self._schema_ids[name, data]
        text = dict(sorted(metadata.items()))
        channel = self._writer.register_channel(topic, encoding, number, text)
        self._channels[topic] = _OpenChannel(channel, name, channel_identity(topic, name, data), text)

    def write(self, topic: str, message: Any, log_time_ns: int, publish_time_ns: int | None = None) -> None:
        """Append one message.

        Args:
            topic: a topic of schemas/topics.py.
            message: a dataclass of `duagc.pipeline.messages` or a protobuf message of the topic's schema.
            log_time_ns: when it was received; never earlier than that of the message before.
            publish_time_ns: when it was produced; the log time if not given.
        """
        proto = message.pack() if hasattr(message, "pack") else message
        schema = proto.DESCRIPTOR.full_name
        if topic not in self._channels:
            self.channel(topic, schema)
        if schema != self._channels[topic].schema:
            raise ValueError(f"{topic} carries {schema}, expected {self._channels[topic].schema}")
        log_time_ns = int(log_time_ns)
        publish_time_ns = log_time_ns if publish_time_ns is None else int(publish_time_ns)
        data = proto.SerializeToString(deterministic=True)
        del proto  # a map's takes as much memory again
        if len(data) > LARGE_BYTES:
            SHELF.sweep(heap=True)  # the writer holds four times as much meanwhile
        self._append(topic, data, log_time_ns, publish_time_ns)

    @property
    def last_log_time_ns(self) -> int:
        """Time of the last message; the next one is not earlier."""
        return self._last_log_time_ns

    def copy(self, log: LogFile, record: Record) -> None:
        """Append a message of another log as it stands there, also of a topic that is not in the table.

        Args:
            log: that it is of.
            record: the message.
        """
        if record.topic not in self._channels:
            check_write(self.path, record.topic)
            channel = log.channels[record.topic]
            schema = log.summary.schemas.get(channel.schema_id)
            described = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
            self._open(record.topic, described, channel.message_encoding, channel.metadata)
        self._append(record.topic, record.data, record.log_time_ns, record.publish_time_ns)

    def _append(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        channel = self._channels[topic]
        if log_time_ns < self._last_log_time_ns or publish_time_ns < 0:
            raise ValueError(
                f"{topic} at {log_time_ns} ns comes after {self._last_log_time_ns} ns in {self.path.name}"
            )
        self._last_log_time_ns = log_time_ns
        try:
            self._writer.add_message(channel.number, log_time_ns, data, publish_time_ns, channel.sequence)
        except OSError as error:
            raise self._named(error) from error
        self._content.add(
            channel.identity, log_time_ns, publish_time_ns, sequence=channel.sequence, data=data
        )
        channel.sequence += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._stream is not None
        try:
            if kind is None:
                self._finish(self._stream)
        except OSError as full:
            raise self._named(full) from full
        finally:
            with suppress(OSError):  # it is removed: that the rest has no room does not matter
                self._stream.close()
            self._part.unlink(missing_ok=True)

    def _finish(self, stream: IO[bytes]) -> None:
        channels = [(c.identity, c.metadata) for c in self._channels.values()]
        log = {LOG_RECORD: self._metadata}
        self.digest = self._content.finish(channels, sorted(log.items()), [])
        self._writer.add_metadata(DIGEST_RECORD, {"sha256": self.digest})
        self._writer.finish()
        stream.close()
        os.replace(self._part, self.path)

    def _named(self, error: OSError) -> OSError:
        """The error with the name of the log, which one of an open file lacks."""
        return OSError(error.errno, error.strerror, str(self.path))


@dataclass
class _OpenChannel:
    number: int
    schema: str
    identity: bytes
    metadata: dict[str, str]
    sequence: int = 0
