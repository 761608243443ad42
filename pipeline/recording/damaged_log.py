"""What can be read of a damaged MCAP file: every record that is whole, also after damage."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO, Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Message, Metadata, Schema

from duagc.pipeline.recording.names import MAGIC

_RECORD = struct.Struct("<BQ")  # opcode, length


_CHUNK = struct.Struct("<QQQII")  # first and last time, size, checksum, length of the compression's name


_COMPRESSIONS = (b"zstd", b"lz4")
_HEAD_BYTES = _RECORD.size + _CHUNK.size + 16  # of a record, by which a chunk is known


LARGEST_CHUNK = 1 << 28  # bytes, unpacked; more is damage


LARGEST_RECORD = 1 << 28  # bytes, outside chunks


_SEARCH_BYTES = 1 << 22


@dataclass
class Salvage:
    """What became of one log.

    lost: messages known to be missing, by the counts at the end of the log or, where that is lost, by the gaps in
    their numbers; what a cut has taken from the end cannot be counted. damage: one line for each place.
    """

    path: str
    messages: int = 0
    lost: int = 0
    cut: bool = False
    damage: list[str] = field(default_factory=list)
    digest: str = ""

    @property
    def whole(self) -> bool:
        """Whether nothing was damaged."""
        return not (self.damage or self.cut or self.lost)

    def line(self) -> str:
        """One line for people."""
        if self.whole:
            return f"{self.path}: {self.messages} messages, nothing lost"
        if ".mcap" not in self.path:
            return f"{self.path}: {'; '.join(self.damage[:5])}"
        lost = f"{self.lost} lost in between"
        end = ", and all after the cut" if self.cut else ""
        return f"{self.path}: {self.messages} messages, {lost}{end}: {'; '.join(self.damage[:5])}"


_KNOWN: dict[int, Any] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
}


def records_of(stream: IO[bytes], size: int, salvage: Salvage) -> Iterator[Any]:
    """Every schema, channel, message, metadata and attachment of a file that is certain.

    Args:
        stream: seekable, of the file.
        size: of the file, bytes.
        salvage: gets a line for each damage found, and whether the file is cut.
    """
    stream.seek(0)
    at = len(MAGIC) if stream.read(len(MAGIC)) == MAGIC else 0
    if at == 0:
        salvage.damage.append("the file does not begin as a log")
    while at < size:
        opcode, length = _record_head(stream, at, size, salvage)
        end = at + _RECORD.size + length
        stream.seek(at + _RECORD.size)
        if opcode == Opcode.DATA_END and length == 4:
            return
        limit = LARGEST_CHUNK if opcode == Opcode.CHUNK else LARGEST_RECORD
        if not Opcode.HEADER <= opcode <= Opcode.DATA_END or length > limit:
            at = _after_damage(stream, at, size, salvage)
            continue
        if end > size and (later := _after_damage(stream, at, size, salvage, known=True)) < size:
            salvage.damage.append(f"at byte {at}: a record of {length} bytes, more than the file has")
            at = later
            continue
        if end > size:
            stream.seek(at + _RECORD.size)
            salvage.cut = True
            salvage.damage.append(f"cut after {size} bytes")
            if opcode == Opcode.CHUNK:
                yield from _rest_of_chunk(stream.read(length))
            return
        body = stream.read(length) if opcode in (Opcode.CHUNK, Opcode.MESSAGE, *_KNOWN) else b""
        try:
            found = list(_chunk(body)) if opcode == Opcode.CHUNK else list(_one(opcode, body))
        except Exception as error:  # a wrong checksum, and whatever damage provokes
            salvage.damage.append(f"at byte {at}: {type(error).__name__} ({error})")
            goes_on = _is_record(stream, end, size)
            at = end if goes_on else _after_damage(stream, at, size, salvage, known=True)
            continue
        yield from found
        at = end
    salvage.cut = True
    salvage.damage.append(f"no end of the log after {size} bytes")


def _record_head(stream: IO[bytes], at: int, size: int, salvage: Salvage) -> tuple[int, int]:
    """Kind and length of a record; those of a chunk by what follows, where its head is damaged."""
    stream.seek(at)
    head = stream.read(_HEAD_BYTES)
    opcode, length = _RECORD.unpack_from(head) if len(head) >= _RECORD.size else (0, 0)
    by_content = _length_of_chunk(head)
    if by_content is None or (opcode, length) == (Opcode.CHUNK, by_content):
        return opcode, length
    if opcode != Opcode.CHUNK and length == by_content:
        salvage.damage.append(f"at byte {at}: a chunk that is called a record of kind {opcode}")
    elif (
        opcode == Opcode.CHUNK
        and not _is_record(stream, at + _RECORD.size + length, size)
        and _is_record(stream, at + _RECORD.size + by_content, size)
    ):
        salvage.damage.append(f"at byte {at}: a chunk of {by_content} bytes that is said to have {length}")
    else:
        return opcode, length
    return int(Opcode.CHUNK), by_content


def _is_record(stream: IO[bytes], at: int, size: int) -> bool:
    """Whether a record may begin here."""
    if at >= size:
        return False
    stream.seek(at)
    head = stream.read(_RECORD.size)
    opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
    return Opcode.HEADER <= opcode <= Opcode.DATA_END and at + _RECORD.size + length <= size


def _after_damage(stream: IO[bytes], at: int, size: int, salvage: Salvage, *, known: bool = False) -> int:
    """Where the next sound chunk begins after a place that is no record; the end of the file if there is none."""
    start = at
    while True:
        at = _next_chunk(stream, at + 1, size)
        if at == size:
            break
        stream.seek(at)
        _, length = _RECORD.unpack(stream.read(_RECORD.size))
        if at + _RECORD.size + length > size:
            break  # the caller takes what is left of it
        try:
            list(_chunk(stream.read(length)))
            break
        except Exception:  # by chance, or damaged as well
            continue
    if not known:
        salvage.damage.append(f"at byte {start}: {at - start} bytes that are no record")
    return at


def _next_chunk(stream: IO[bytes], start: int, size: int) -> int:
    """Where the next record that looks like a chunk begins; `size` if there is none."""
    overlap = _RECORD.size + _CHUNK.size + 4
    at = start
    while at < size:
        stream.seek(at)
        window = stream.read(_SEARCH_BYTES + overlap)
        places = [p for name in _COMPRESSIONS for p in _places(window, struct.pack("<I", len(name)) + name)]
        for place in sorted(places):
            begin = place + 4 - _RECORD.size - _CHUNK.size
            if begin >= 0 and _looks_like_chunk(window[begin:]):
                return at + begin
        at += _SEARCH_BYTES
    return size


def _places(window: bytes, pattern: bytes) -> Iterator[int]:
    at = window.find(pattern)
    while at >= 0:
        yield at
        at = window.find(pattern, at + 1)


def _looks_like_chunk(data: bytes) -> bool:
    if len(data) < _HEAD_BYTES:
        return False
    opcode, length = _RECORD.unpack_from(data)
    return bool(opcode == Opcode.CHUNK and length == _length_of_chunk(data))


def _length_of_chunk(data: bytes) -> int | None:
    """Length that a chunk has by what follows its head, whatever that says; None: what follows is no chunk."""
    if len(data) < _HEAD_BYTES:
        return None
    first, last, unpacked, _, name = _CHUNK.unpack_from(data, _RECORD.size)
    if first > last or unpacked > LARGEST_CHUNK or name > 8:  # longer than the name of any compression
        return None
    (packed,) = struct.unpack_from("<Q", data, _RECORD.size + _CHUNK.size + name)
    return int(_CHUNK.size + name + 8 + packed)


def _unpack(body: bytes) -> tuple[bytes, int, int]:
    """The bytes of a chunk as far as they are there, the size and the checksum they should have."""
    import lz4.frame
    import zstandard

    _, _, size, crc, name = _CHUNK.unpack_from(body)
    compression = body[_CHUNK.size : _CHUNK.size + name]
    packed = body[_CHUNK.size + name + 8 :]
    if size > LARGEST_CHUNK:
        raise ValueError(f"a chunk of {size} bytes")
    if compression == b"zstd":
        reader = zstandard.ZstdDecompressor().stream_reader(BytesIO(packed))
        pieces = []
        left = size
        try:
            while left > 0 and (piece := reader.read(min(left, 1 << 16))):
                pieces.append(piece)
                left -= len(piece)
        except zstandard.ZstdError:
            pass  # what came before is checked by size and checksum
        out = b"".join(pieces)
    elif compression == b"lz4":
        try:
            out = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
        except RuntimeError:
            out = b""
    elif compression == b"":
        out = packed
    else:
        raise ValueError(f"compression {compression!r}")
    return out, size, crc


def _chunk(body: bytes) -> Iterator[Any]:
    data, size, crc = _unpack(body)
    if len(data) != size:
        raise ValueError(f"a chunk of {len(data)} bytes instead of {size}")
    if crc and zlib.crc32(data) != crc:
        raise ValueError("a chunk with another checksum")
    return _inside(data)


def _rest_of_chunk(body: bytes) -> Iterator[Any]:
    """The whole records in the beginning of a chunk that is cut."""
    try:
        data, *_ = _unpack(body)
        yield from _inside(data, cut=True)
    except (struct.error, ValueError, IndexError):
        return


def _inside(data: bytes, cut: bool = False) -> Iterator[Any]:
    at = 0
    while at + _RECORD.size <= len(data):
        opcode, length = _RECORD.unpack_from(data, at)
        end = at + _RECORD.size + length
        if end > len(data):
            if cut:
                return
            raise ValueError("a chunk with records that are longer than it")
        yield from _one(opcode, data[at + _RECORD.size : end])
        at = end


def _one(opcode: int, body: bytes) -> Iterator[Any]:
    if opcode == Opcode.MESSAGE:
        yield Message.read(ReadDataStream(BytesIO(body)), len(body))
    elif opcode in _KNOWN:
        yield _KNOWN[opcode].read(ReadDataStream(BytesIO(body)))
