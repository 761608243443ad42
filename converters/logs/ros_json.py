"""Messages of ROS as JSON, as rosbridge and its recorders write them: bytes in base64, or as a list of numbers.

Times are `sec` and `nanosec`, or `secs` and `nsecs` (ROS 1); matrices may have large letters; a number that is null is
none (rosbridge's NaN). What is missing but for the number of a header is an error.
"""

from __future__ import annotations

import base64
import binascii
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from duagc.converters.logs.entries import InvalidMessage, reason, stamp_ns
from duagc.converters.logs.foxglove import Base64, json_members
from duagc.converters.logs.topic_types import READ_TYPES

_ALIASES = {
    "sec": ("secs",),
    "nanosec": ("nsecs", "nsec"),
    "d": ("D",),
    "k": ("K",),
    "r": ("R",),
    "p": ("P",),
}


def is_read(kind: str) -> bool:
    """Whether messages of a type are read from JSON.

    Args:
        kind: ROS 2's name of the type.
    """
    return kind in READ_TYPES


def read(kind: str, data: bytes, where: str) -> Any:
    """A message of ROS 2's definition of `kind`.

    Args:
        kind: ROS 2's name of the type.
        data: JSON, UTF-8.
        where: begins the line of an error.

    Raises:
        InvalidMessage: it is no JSON, a field is missing or of another kind.
    """
    try:
        return _built(kind, json_members(data))
    except Exception as error:  # broken JSON, and whatever values provoke that should be others
        raise InvalidMessage(
            where, f"holds {len(data)} bytes that are no {kind} in json ({reason(error)})"
        ) from error


def header_ns(kind: str, data: bytes, where: str) -> int:
    """The time (ns) in the header of a message, without its data; 0 where it has no header.

    Args:
        kind: ROS 2's name of the type, for the error.
        data: JSON, UTF-8.
        where: begins the line of an error.

    Raises:
        InvalidMessage: as `read`.
    """
    try:
        members = json_members(data)
        if not isinstance(members, dict) or "header" not in members:
            return 0
        return stamp_ns(SimpleNamespace(header=_built("std_msgs/msg/Header", members["header"])))
    except Exception as error:
        raise InvalidMessage(
            where, f"holds {len(data)} bytes that are no {kind} in json ({reason(error)})"
        ) from error


@lru_cache(maxsize=1)
def _store() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _built(kind: str, members: Any) -> Any:
    store = _store()
    if not isinstance(members, dict):
        raise TypeError(f"{kind} is {type(members).__name__}, expected an object")
    fields = {}
    for name, definition in store.fielddefs[kind][1]:
        found = next((n for n in (name, *_ALIASES.get(name, ())) if n in members), None)
        if found is None:
            raise KeyError(f"{kind} has no {name}")
        fields[name] = _value(definition, members[found], name)
    return store.types[kind](**fields)


def _value(definition: Any, value: Any, name: str) -> Any:
    node, of = definition
    if node == Nodetype.NAME:
        return _built(of, value)
    if node == Nodetype.BASE:
        return _plain(of[0], value, name)
    (inner_node, inner), count = of
    if inner_node == Nodetype.NAME:
        return [_built(inner, v) for v in value]
    array = _array(inner[0], value, name)
    if node == Nodetype.ARRAY and len(array) != count:
        raise ValueError(f"{name} has {len(array)} numbers, expected {count}")
    return array


def _plain(kind: str, value: Any, name: str) -> Any:
    if kind == "string":
        if not isinstance(value, str):
            raise TypeError(f"{name} is {value!r}, expected text")
        return value
    number = float("nan") if value is None else value
    if not isinstance(number, int | float):
        raise TypeError(f"{name} is {value!r}, expected a number")
    return float(number) if kind.startswith("float") else int(number)


def _array(kind: str, value: Any, name: str) -> Any:
    if kind in ("uint8", "int8", "octet", "char", "byte") and isinstance(value, str | bytes):
        if isinstance(value, Base64):
            return np.frombuffer(binascii.a2b_base64(value, strict_mode=True), np.uint8)
        return np.frombuffer(base64.b64decode(value, validate=True), np.uint8)
    if not isinstance(value, list):
        raise TypeError(f"{name} is {type(value).__name__}, expected a list")
    numbers = np.array([np.nan if v is None else v for v in value], dtype=np.float64)
    dtype = np.dtype({"bool": "?", "char": "u1", "octet": "u1", "byte": "u1"}.get(kind, kind))
    if dtype.kind in "iu" and not np.array_equal(numbers, numbers.astype(dtype)):
        raise ValueError(f"{name} holds a number that is no {kind}")
    return numbers.astype(dtype)
