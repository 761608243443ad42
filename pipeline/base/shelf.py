"""Arrays of long computations, laid into files: what is not looked at takes no memory.

The arrays of an object are written into a nameless temporary file, which is mapped into memory, and are read from there
when they are looked at. The system takes the pages back now and then. Values stay the same to the last bit.
"""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import resource
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, overload

import numpy as np

from duagc.pipeline.base.said_lines import say_line

Value = TypeVar("Value")
ALIGNMENT = 64
LEAST_BYTES = 64 << 10
"""Objects of less stay in memory."""
MOST_FILES = 1 << 16
"""Open files that are asked for, if the system allows so many."""
LARGE_BYTES = 32 << 20
"""Arrays and messages of more are those of long logs: memory is given back while they are written."""
SWEEP_AFTER = 16
"""Objects, after which all pages are given back that were looked at since."""

_malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc


class _Mapping(mmap.mmap):
    """A mapped file, of which a weak reference can be had."""


class Shelf:
    """Lays arrays into files, as long as there is room on the disk."""

    def __init__(self) -> None:
        """Begin with none."""
        self._room_for_files = False
        self._mappings: weakref.WeakSet[_Mapping] = weakref.WeakSet()
        self._new = 0
        self._full = False

    def __len__(self) -> int:
        """Objects that are in files."""
        return len(self._mappings)

    def put(self, value: Value) -> Value:
        """An equal object, whose arrays are in a file and cannot be written.

        Args:
            value: data classes, tuples and dictionaries with arrays; arrays that are in a file, and anything else, are
                taken as they are.
        """
        arrays: list[np.ndarray] = []
        _collect(value, arrays)
        sizes = [-(-array.nbytes // ALIGNMENT) * ALIGNMENT for array in arrays]
        if self._full or sum(sizes) < LEAST_BYTES:
            return value
        mapping = self._written(arrays, sizes)
        if mapping is None:
            return value
        starts = np.cumsum([0, *sizes])[:-1].tolist()
        views = [
            np.frombuffer(mapping, array.dtype, array.size, start).reshape(array.shape)
            if array.size
            else array
            for array, start in zip(arrays, starts, strict=True)
        ]
        shelved: Value = _rebuilt(value, iter(views))
        self._new += 1
        if self._new >= SWEEP_AFTER:
            self.sweep()
        return shelved

    def sweep(self, *, heap: bool = False) -> None:
        """Give the memory of all files back until they are looked at again.

        Args:
            heap: also what was freed between arrays that are in use; takes some milliseconds.
        """
        self._new = 0
        for mapping in list(self._mappings):
            mapping.madvise(mmap.MADV_DONTNEED)
        if heap and _malloc_trim is not None:
            _malloc_trim(0)

    def _written(self, arrays: list[np.ndarray], sizes: list[int]) -> _Mapping | None:
        """A file with the arrays; None if there is no room for it."""
        if not self._room_for_files:
            _allow_files()
            self._room_for_files = True
        try:
            with tempfile.TemporaryFile(prefix="duagc-") as file:
                for array, size in zip(arrays, sizes, strict=True):
                    file.write(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
                    file.write(bytes(size - array.nbytes))
                file.flush()
                mapping = _Mapping(file.fileno(), sum(sizes), prot=mmap.PROT_READ)
        except OSError as error:
            self._full = True
            reason = error.strerror or os.strerror(error.errno or 0)
            if error.errno == errno.EMFILE:
                reason = f"{reason} ({len(self._mappings)} of keyframes, see `ulimit -Hn`)"
            say_line(f"warning: {tempfile.gettempdir()}: {reason}; keyframes stay in memory")
            return None
        self._mappings.add(mapping)
        return mapping


def _allow_files() -> None:
    """Let this process open as many files as the system allows: each mapping holds one, and the usual limit is low."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST_FILES)
    if soft != resource.RLIM_INFINITY and soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def _in_memory(value: Any) -> bool:
    """Whether something is an array that lies in no file."""
    if not isinstance(value, np.ndarray):
        return False
    base: Any = value
    while isinstance(base, np.ndarray):
        base = base.base
    return not isinstance(base.obj if isinstance(base, memoryview) else base, _Mapping)


def _collect(value: Any, arrays: list[np.ndarray]) -> None:
    """All arrays of an object that are in no file, in order."""
    if _in_memory(value):
        arrays.append(value)
    elif isinstance(value, tuple):
        for part in value:
            _collect(part, arrays)
    elif isinstance(value, dict):
        _collect(tuple(value.values()), arrays)
    elif is_dataclass(value):
        for field in fields(value):
            _collect(getattr(value, field.name), arrays)


def _rebuilt(value: Any, views: Iterator[np.ndarray]) -> Any:
    """The object with other arrays in the place of those that are in no file, in the same order."""
    if _in_memory(value):
        return next(views)
    if isinstance(value, tuple):
        return tuple(_rebuilt(part, views) for part in value)
    if isinstance(value, dict):
        return {key: _rebuilt(part, views) for key, part in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return type(value)(**{f.name: _rebuilt(getattr(value, f.name), views) for f in fields(value)})
    return value


SHELF = Shelf()
"""Of this process."""


class ShelvedList(Sequence[Value]):
    """Objects whose arrays are in files; of those that were looked at, the last few are in memory."""

    def __init__(self, values: Iterable[Value] = (), shelf: Shelf = SHELF) -> None:
        """Put objects into a list.

        Args:
            values: one after the other, so that not all need to be in memory.
            shelf: where their arrays go.
        """
        self._shelf, self._looked_at = shelf, 0
        self._values: list[Value] = []
        for value in values:
            self._values.append(shelf.put(value))

    def __len__(self) -> int:
        return len(self._values)

    @overload
    def __getitem__(self, index: int) -> Value: ...
    @overload
    def __getitem__(self, index: slice) -> ShelvedList[Value]: ...
    def __getitem__(self, index: int | slice) -> Value | ShelvedList[Value]:
        if isinstance(index, slice):
            part: ShelvedList[Value] = ShelvedList(shelf=self._shelf)
            part._values = self._values[index]
            return part
        self._looked_at += 1
        if self._looked_at >= SWEEP_AFTER:
            self._looked_at = 0
            self._shelf.sweep()
        return self._values[index]
