"""The state of a computation as bytes, and back: arrays to the last bit, and only classes that may be in it.

Pickle of protocol 5 carries the structure, since a state is thousands of small objects with shared parts; arrays stand
behind it as they are, without a copy. What is read back is compared with its digest before, and may name no function
and no class but arrays, data classes and enumerations of this package, and what the reader allows: a foreign file can
give wrong values, but run nothing. Values that are cached in a data class are left out.
"""

from __future__ import annotations

import copyreg
import functools
import hashlib
import io
import json
import os
import pickle
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

MAGIC = b"duagc state 1\n"
ALIGNMENT = 64
PACKAGE = "duagc."
NUMPY = frozenset(
    {
        ("numpy", "ndarray"),
        ("numpy", "dtype"),
        *(
            (f"numpy.{core}.multiarray", name)
            for core in ("core", "_core")
            for name in ("_reconstruct", "scalar")
        ),
        *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
    }
)
Name = Callable[[Any], Any]
"""A name for an object that stands elsewhere; None for any other one."""


class DamagedStateError(Exception):
    """A file of a state is not what was written."""


def write_state(path: Path, value: Any, head: Callable[[], Any], named: Name) -> str:
    """Write a state; the file appears whole, by rename.

    Args:
        path: of the file.
        value: the state.
        head: plain values to be read first, asked for when the state has been walked through.
        named: objects that stand elsewhere.

    Returns:
        Digest of the file.

    Raises:
        OSError: it cannot be written; nothing is left behind.
    """
    buffers: list[pickle.PickleBuffer] = []
    stream = io.BytesIO()
    pickler = _Pickler(stream, protocol=5, buffer_callback=buffers.append)
    pickler.named = named
    pickler.dump(value)
    parts: list[Any] = [stream.getbuffer(), *(buffer.raw() for buffer in buffers)]
    first = json.dumps({"head": head(), "sizes": [len(part) for part in parts]}).encode() + b"\n"
    part_path = path.with_name(f"{path.name}.part")
    try:
        with part_path.open("wb") as file:
            digest = _Digested(file)
            digest.write(MAGIC)
            digest.write(first)
            for part in parts:
                digest.pad()
                digest.write(part)
            found: str = digest.hash.hexdigest()
            file.write(found.encode())
        os.replace(part_path, path)
    except OSError:
        with suppress(OSError):
            part_path.unlink(missing_ok=True)
        raise
    return found


class StateFile:
    """A state that was written, with its digest compared."""

    def __init__(self, path: Path, digest: str | None = None) -> None:
        """Read a file.

        Args:
            path: of the file.
            digest: that it must have; None: that which stands in it.

        Raises:
            FileNotFoundError: there is none.
            DamagedStateError: it is not what was written.
        """
        self._path = path
        with path.open("rb") as file:
            self._data = bytearray(os.fstat(file.fileno()).st_size)
            file.readinto(self._data)
        whole = memoryview(self._data)
        content, own = whole[:-64], bytes(whole[-64:]).decode("ascii", "replace")
        found = hashlib.sha256(content).hexdigest()
        if found != own or (digest is not None and digest != found):
            raise DamagedStateError(f"{path}: has digest {found[:12]}, expected {(digest or own)[:12]}")
        end = self._data.find(b"\n", len(MAGIC)) + 1
        if not self._data.startswith(MAGIC) or not end:
            raise DamagedStateError(f"{path}: does not begin with {MAGIC.decode().strip()!r}")
        first = json.loads(bytes(whole[len(MAGIC) : end]))
        self.head: Any = first["head"]
        self._parts, at = [], end
        for size in first["sizes"]:
            at += -at % ALIGNMENT
            self._parts.append(whole[at : at + size])
            at += size

    def value(self, named: Callable[[Any], Any], allowed: Sequence[type]) -> Any:
        """The state.

        Args:
            named: the object that a name stands for.
            allowed: classes that it may have besides, and those derived from them.

        Raises:
            DamagedStateError: it has something else.
        """
        unpickler = _Unpickler(io.BytesIO(self._parts[0]), buffers=self._parts[1:])
        unpickler.named, unpickler.allowed = named, tuple(allowed)
        try:
            return unpickler.load()
        except (pickle.UnpicklingError, AttributeError, ImportError, IndexError, EOFError) as error:
            raise DamagedStateError(f"{self._path}: {error}") from error


class _Digested:
    """Writes, and digests what is written."""

    def __init__(self, file: Any) -> None:
        self.hash, self._file, self._size = hashlib.sha256(), file, 0

    def write(self, data: Any) -> None:
        self.hash.update(data)
        self._file.write(data)
        self._size += len(data)

    def pad(self) -> None:
        self.write(bytes(-self._size % ALIGNMENT))


class _Pickler(pickle.Pickler):
    named: Name

    def persistent_id(self, obj: Any) -> Any:
        return self.named(obj)

    def reducer_override(self, obj: Any) -> Any:
        caches = _caches(type(obj))
        if not caches or caches.isdisjoint(vars(obj)):
            return NotImplemented
        return copyreg.__newobj__, (type(obj),), {k: v for k, v in vars(obj).items() if k not in caches}  # type: ignore[attr-defined]


class _Unpickler(pickle.Unpickler):
    named: Callable[[Any], Any]
    allowed: tuple[type, ...]

    def persistent_load(self, pid: Any) -> Any:
        return self.named(pid)

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in NUMPY:
            return super().find_class(module, name)
        if module.startswith(PACKAGE) or any(module == one.__module__ for one in self.allowed):
            found = super().find_class(module, name)
            ours = isinstance(found, type) and module.startswith(PACKAGE)
            if ours and (is_dataclass(found) or issubclass(found, Enum)):
                return found
            if isinstance(found, type) and issubclass(found, self.allowed):
                return found
        raise pickle.UnpicklingError(f"names {module}.{name}, expected a class of a state")


_cached: dict[type, frozenset[str]] = {}


def _caches(cls: type) -> frozenset[str]:
    """Cached properties of a data class."""
    if cls not in _cached:
        values = [(k, v) for base in cls.__mro__ for k, v in vars(base).items()] if is_dataclass(cls) else []
        _cached[cls] = frozenset(k for k, v in values if isinstance(v, functools.cached_property))
    return _cached[cls]
