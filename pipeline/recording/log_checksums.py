"""The checksums of a log: the whole file is read once before its first message is used."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Header

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track
from duagc.pipeline.base.workers import hand_down
from duagc.pipeline.recording.names import LIBRARY, MAGIC

_FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary start, summary offset start, CRC of the summary
_DATA_END = struct.Struct("<BQI")  # opcode, length, CRC of everything before
_PIECE_BYTES = 1 << 20
_LONG_BYTES = 1 << 30  # takes long enough that somebody wonders


@contextmanager
def parsing(path: Path, stream: IO[bytes] | None = None) -> Iterator[None]:
    """Turn whatever a reader stumbles over in a broken file, or in one that was closed, into one line.

    Args:
        path: of the log.
        stream: the open file; None: it is opened and closed within.
    """
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
_verified: _Verified = set()


def _known() -> _Verified:
    """What this process knows of files, as long as they are unchanged."""
    return set(_verified)


def _learn(known: _Verified) -> None:
    _verified.update(known)


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
