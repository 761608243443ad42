"""The messages of an MCAP file in the order of their times, chunk by chunk.

A chunk is compared with its checksum the first time it is unpacked whole. Where the first bytes of its messages are all
that is asked for, it is unpacked no further than the last of them begins, and compared when the messages are read.
"""

from __future__ import annotations

import heapq
import io
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import IO, Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex
from mcap.stream_reader import get_chunk_data_stream

HEAD_BYTES = 256
_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
# whether the first bytes of a message are enough; None: the messages are wanted whole
Enough = Callable[[bytes], bool] | None


class LogMessage(NamedTuple):
    """A message, in the order of a log: by time, then by its place in the file."""

    log_ns: int
    chunk: int
    place: int
    channel: int
    publish_ns: int
    data: bytes


class Chunks:
    """The chunks of one file that its index lists."""

    def __init__(self, stream: IO[bytes], indexes: Sequence[ChunkIndex]) -> None:
        """Sort the chunks by time; none is read yet.

        Args:
            stream: the file, open for reading bytes; it stays open.
            indexes: of its chunks.
        """
        self._stream = stream
        self._indexes = sorted(indexes, key=lambda i: (i.message_start_time, i.chunk_start_offset))
        self._compared: set[int] = set()

    def messages(self, wanted: Mapping[int, Enough]) -> Iterator[LogMessage]:
        """The messages of some channels, in the order of their times.

        Args:
            wanted: by number of a channel, whether the first bytes of a message are enough; None: all of it
                is wanted.

        Raises:
            ValueError: a chunk is broken.
        """
        waiting: list[LogMessage] = []
        for index in self._indexes:
            if wanted.keys().isdisjoint(index.message_index_offsets):
                continue
            start = index.chunk_start_offset
            while waiting and waiting[0][:2] < (index.message_start_time, start):
                yield heapq.heappop(waiting)
            for message in self._of_chunk(start, index, wanted):
                heapq.heappush(waiting, message)
        while waiting:
            yield heapq.heappop(waiting)

    def _of_chunk(self, start: int, index: ChunkIndex, wanted: Mapping[int, Enough]) -> Iterator[LogMessage]:
        self._stream.seek(start + _RECORD.size)
        chunk = Chunk.read(ReadDataStream(self._stream))
        here = [wanted[number] for number in index.message_index_offsets if number in wanted]
        if all(here) and chunk.compression in ("", "zstd"):
            source, size = _opened(chunk), chunk.uncompressed_size
        else:
            unpacked, size = get_chunk_data_stream(chunk, validate_crc=start not in self._compared)
            self._compared.add(start)
            source = io.BytesIO(unpacked.read(size))
        at = 0
        while at < size:
            opcode, length = _RECORD.unpack(_exactly(source, _RECORD.size))
            end = at + _RECORD.size + length
            if end > size:
                raise ValueError(f"a chunk of {size} bytes with a record that ends at {end}")
            read = 0
            if opcode == Opcode.MESSAGE:
                number, _, log_ns, publish_ns = _MESSAGE.unpack(_exactly(source, _MESSAGE.size))
                read = _MESSAGE.size
                if number in wanted:
                    data = _body(source, length - read, wanted[number])
                    read += len(data)
                    yield LogMessage(log_ns, start, at, number, publish_ns, data)
            if end < size:
                source.seek(length - read, io.SEEK_CUR)
            at = end


def _opened(chunk: Chunk) -> Any:
    """The contents of a chunk as a stream that unpacks what is read of it."""
    if not chunk.compression:
        return io.BytesIO(chunk.data)
    import zstandard

    return zstandard.ZstdDecompressor().stream_reader(chunk.data)


def _body(source: Any, length: int, enough: Enough) -> bytes:
    """A message, or as much of it as is enough."""
    if not enough or length <= HEAD_BYTES:
        return _exactly(source, length)
    head = _exactly(source, HEAD_BYTES)
    return head if enough(head) else head + _exactly(source, length - HEAD_BYTES)


def _exactly(source: Any, size: int) -> bytes:
    data = bytes(source.read(size))
    while len(data) < size and (more := source.read(size - len(data))):
        data += more
    if len(data) < size:
        raise ValueError(f"a chunk that ends {size - len(data)} bytes too early")
    return data
