"""Whole files: reading regular ones of bounded size from outside, writing ones that appear when they are finished."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from duagc.pipeline.base.errors import DuagError

if TYPE_CHECKING:
    from numpy.typing import NDArray

LARGEST_BYTES = 1 << 29
MOST_OF_LINE = 80  # characters of a line that a message repeats
TOO_LONG = "it holds a number of more than 4300 digits"  # of ValueErrors that tomllib does not raise itself


def check_file(path: Path, expected: str, largest: int | None = None) -> int:
    """The size of a regular file in bytes; opening anything else might never end.

    Args:
        path: of the file.
        expected: what the file should be, for the line of the error.
        largest: size in bytes that is still accepted; None: any.

    Raises:
        DuagError: it is missing, a folder, a pipe or a device, or larger than `largest` bytes.
    """
    try:
        size = path.stat().st_size
        regular = path.is_file()
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or error
        raise DuagError(f"{path}: {reason}, expected {expected}") from error
    if not regular:
        kind = "a folder" if path.is_dir() else "no regular file"
        raise DuagError(f"{path}: is {kind}, expected {expected}")
    if largest is not None and size > largest:
        raise DuagError(
            f"{path}: has {size / 1e6:.0f} MB, expected {expected}, at most {largest / 1e6:.0f} MB"
        )
    return size


def kind_of_path(path: Path) -> str:
    """What is at a path, for the line of an error: "a file", "a folder" or "no such file or folder".

    Args:
        path: of anything; need not exist.
    """
    if path.is_dir():
        return "a folder"
    return "a file" if path.exists() else "no such file or folder"


def read_bytes(path: Path, expected: str) -> bytes:
    """The bytes of a file.

    Args:
        path: of the file.
        expected: what the file should be, for the line of the error.

    Raises:
        DuagError: as `check_file`, or it cannot be read.
    """
    check_file(path, expected, LARGEST_BYTES)
    try:
        return path.read_bytes()
    except OSError as error:
        raise DuagError(f"{path}: {error.strerror or error}, expected {expected}") from error


def read_text(path: Path, expected: str) -> str:
    """The text of a file in UTF-8, without a byte order mark.

    Args:
        path: of the file.
        expected: what the file should be, for the line of the error.

    Raises:
        DuagError: as `read_bytes`, or it is not UTF-8.
    """
    try:
        return read_bytes(path, expected).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DuagError(f"{path}: is not text in UTF-8, expected {expected}") from error


def read_toml(path: Path, expected: str) -> dict[str, Any]:
    """The content of a TOML file.

    Args:
        path: of the file.
        expected: what the file should be, for the line of the error.

    Raises:
        DuagError: as `read_text`, or it is not TOML.
    """
    return parse_toml(read_text(path, expected), path, expected)


def parse_toml(text: str, path: Path, expected: str) -> dict[str, Any]:
    """The content of a TOML file whose text is there.

    Args:
        text: of the file.
        path: of the file, for the line of the error.
        expected: what the file should be, for the line of the error.

    Raises:
        DuagError: it is not TOML.
    """
    import tomllib

    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        why = _reason_and_line(error, text)
        raise DuagError(f"{path}: not valid TOML: {why}, expected {expected}") from error


def _reason_and_line(error: Exception, text: str) -> str:
    """Why a text is no TOML, and the line; the parser names neither a key that comes twice nor a limit of Python."""
    import tomllib

    if isinstance(error, RecursionError):
        return "it is nested too deep"
    if not isinstance(error, tomllib.TOMLDecodeError):
        return TOO_LONG
    place, lines = re.search(r"\(at line (\d+), ", str(error)), text.splitlines() or [""]
    number = len(lines) if place is None else min(int(place[1]), len(lines))  # none: "at end of document"
    line = lines[number - 1].strip()
    why = str(error).replace("Cannot overwrite a value", "a key comes twice, or is a value and a section", 1)
    return f"{why}: {line[:MOST_OF_LINE]}"


def read_json(path: Path, expected: str) -> dict[str, Any]:
    """The content of a file of one JSON object.

    Args:
        path: of the file.
        expected: what the file should be, for the line of the error.

    Raises:
        DuagError: as `read_text`, or it is no JSON object.
    """
    try:
        content = json.loads(read_text(path, expected))
    except (ValueError, RecursionError) as error:
        raise DuagError(f"{path}: not valid JSON: {error}, expected {expected}") from error
    if not isinstance(content, dict):
        raise DuagError(f"{path}: found a {type(content).__name__}, expected a JSON object: {expected}")
    return content


def digest_of_values(values: Any) -> str:
    """64 hex characters of SHA-256 over plain values, as JSON writes them with sorted names.

    Args:
        values: tables, lists, texts, numbers.
    """
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def digest_of_bytes(path: Path) -> str:
    """64 hex characters of SHA-256 over the bytes of a file.

    Args:
        path: of the file.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def size_bytes(path: Path) -> int:
    """Bytes of a file, or of all files in a folder and below.

    Args:
        path: of the file or folder.
    """
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    return sum(p.stat().st_size for p in files)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """A name next to `path` to write to: it becomes `path` when the block ends well, else it is removed.

    Args:
        path: of the finished file; replaced if it exists.

    Yields:
        The name to write to.

    Raises:
        DuagError: it cannot be written there.
    """
    if not path.name:
        raise DuagError(f"{path}: found a path without a name, expected the name of a file")
    part = path.with_name(path.name + ".part")
    try:
        yield part
        part.replace(path)
    except OSError as error:
        raise DuagError(f"{path}: {error.strerror or error}, expected to write a file") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def save_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array as .npy.

    Args:
        path: of the file.
        array: of numbers.

    Raises:
        DuagError: it cannot be written there; numpy names neither the file nor the reason.
    """
    import numpy as np

    try:
        np.save(path, array)
    except OSError as error:
        raise DuagError(f"{path}: {error.strerror or error}, expected room for it") from error


def decode_image(data: bytes, flags: int) -> NDArray[Any] | None:
    """What OpenCV makes of an encoded image; None if nothing, or more pixels than `determinism` allows.

    Args:
        data: bytes of the encoded image.
        flags: cv2.IMREAD_*.
    """
    import cv2
    import numpy as np

    if not data or _is_torn_png(data):
        return None
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # it refuses large sizes by an exception
        return None


def encode_jpeg(image: NDArray[Any], quality: int) -> bytes:
    """An image as JPEG.

    Args:
        image: uint8 [h, w, 3], BGR.
        quality: 0 to 100.
    """
    import cv2

    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise RuntimeError("the JPEG encoder refused an 8-bit image")
    return data.tobytes()


def encode_png(image: NDArray[Any]) -> bytes:
    """An image as PNG, as fast as it goes: OpenCV's own choice of filter and strategy.

    Asked for a level of compression, also for the lowest, it tries every filter on every row and searches longer: that
    takes 1.8 times as long to write and 1.5 times to read, for 1 % fewer bytes of a photograph.

    Args:
        image: [h, w] or, in the order blue, green, red, [h, w, 3].
    """
    import cv2
    import numpy as np

    return cv2.imencode(".png", np.ascontiguousarray(image))[1].tobytes()


def _is_torn_png(data: bytes) -> bool:
    """Whether a chunk of a PNG claims more bytes than follow: OpenCV takes up to 4 GB of memory to find that out."""
    if not data.startswith(b"\x89PNG"):
        return False
    at = 8
    while at + 8 <= len(data) and data[at + 4 : at + 8] != b"IEND":
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return at + 8 > len(data)
