"""Messages of ROS, read by the definitions that a log carries; their headers without reading the rest."""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from functools import cached_property
from typing import Any

from duagc.converters.logs import foxglove
from duagc.converters.logs.definitions import of_ros2
from duagc.converters.logs.entries import InvalidMessage, reason, ros_type, stamp_ns
from duagc.converters.logs.topic_types import READ_TYPES
from duagc.pipeline.messages.parts import NANOSECONDS

LONGEST_FRAME = 4096  # letters; of bytes that are no header the number is most often larger
_ANY_DIGEST = ("", "*")  # of connections that state none


class RosMessages:
    """Reads the messages of one connection or channel."""

    def __init__(self, schema: str, encoding: str, definition: str, *, is_idl: bool) -> None:
        """The definition is understood when the first message is read: what is not needed may be beyond the parser.

        Args:
            schema: name of the type, as the file has it.
            encoding: "cdr" or "ros1".
            definition: of the type and those that it holds; empty: as ROS has it.
            is_idl: it is in OMG IDL, not in lines of `.msg`.
        """
        self.type, self.encoding = ros_type(schema), encoding
        self._definition, self._is_idl, self._plain = definition, is_idl, foxglove.plain_name(schema)
        self._of_ros = self._plain not in foxglove.ROS_TYPES

    @cached_property
    def _store(self) -> Any:
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

        if not self._definition.strip():  # a recorder that had no definitions at hand
            return of_ros2() if self.encoding == "cdr" else get_typestore(Stores.ROS1_NOETIC)
        store = get_typestore(Stores.EMPTY)
        if not self._is_idl:
            store.register(get_types_from_msg(self._definition, self.type))
            check_definitions(store.fielddefs)
            return store
        line = "=" * 80 + "\n"
        parts = (
            [part.split("\n", 1)[1] for part in self._definition.split(line)[1:]]
            if self._definition.startswith(f"{line}IDL: ")
            else [self._definition]
        )
        types: dict[str, Any] = {}
        for part in parts:
            types.update(
                get_types_from_idl(re.sub(r"(?m)^\s*#.*$", "", part))
            )  # its parser knows no #include
        store.register(types)
        check_definitions(store.fielddefs)
        return store

    @cached_property
    def _fault(self) -> str:
        """Why the definition cannot be read; empty if it can."""
        try:
            self._store  # noqa: B018 (understands it)
        except Exception as error:  # whatever a broken definition provokes in the parser
            return f"has a definition of {self.type} that cannot be read ({reason(error)})"
        return ""

    def remark(self, digest: str) -> str:
        """What users should know whose messages of a read type are defined otherwise than their connection states.

        Args:
            digest: that the connection states: the MD5 sum in ROS 1, the hash of the type in ROS 2.

        Returns:
            Empty: nothing.
        """
        if self.type not in READ_TYPES or digest in _ANY_DIGEST or self._fault:
            return ""
        store = self._store
        own = (
            store.hash_rihs01(self.type)
            if self.encoding == "cdr"
            else store.generate_msgdef(self.type, ros_version=1)[1]
        )
        word = "hash" if self.encoding == "cdr" else "MD5 sum"
        return (
            ""
            if digest == own
            else f"a connection states {word} {digest[:80]} of {self.type}, expected {own} as of its definition, "
            "by which its messages are read"
        )

    def read(self, data: bytes, where: str) -> Any:
        """A message with ROS's fields.

        Args:
            data: its bytes.
            where: begins the line of an error.

        Raises:
            InvalidMessage: the bytes are no message of the type, or its definition cannot be read.
        """
        if self._fault:
            raise InvalidMessage(where, self._fault)
        store = self._store
        message = deserialized(
            store.deserialize_cdr if self.encoding == "cdr" else store.deserialize_ros1,
            data,
            self.type,
            where,
        )
        return foxglove.as_ros(self._plain, message, where)

    def header_ns(self, data: bytes, where: str) -> int:
        """The time in the header of a message, ns; 0 where it has none.

        Args:
            data: its bytes; of types of ROS the first ones are enough.
            where: begins the line of an error.

        Raises:
            InvalidMessage: the bytes begin with no header.
        """
        return ros_header_ns(data, self.encoding, where) if self._of_ros else stamp_ns(self.read(data, where))

    def tells_time(self, head: bytes) -> bool:
        """Whether `header_ns` needs no more than some first bytes of a message.

        Args:
            head: these bytes.
        """
        return self._of_ros


def check_definitions(found: Mapping[str, Any]) -> None:
    """Refuse definitions of types that are read here otherwise than ROS has them.

    Args:
        found: fields by type, as rosbags has them.

    Raises:
        ValueError: a type has other fields.
    """
    from rosbags.typesys import Stores, get_typestore

    standard = get_typestore(Stores.ROS2_HUMBLE).fielddefs
    for name in sorted(set(found) & READ_TYPES):
        # the matrices D, K, R, P of ROS 1 have small letters in ROS 2
        has, wanted = (
            {(field if len(field) > 1 else field.lower()): kind for field, kind in types[name][1]}
            for types in (found, standard)
        )
        for field in wanted:
            if has.get(field) != wanted[field]:
                raise ValueError(f"its {name} has no field {field} as ROS has it")


def deserialized(read: Any, raw: bytes, kind: str, where: str) -> Any:
    """A message of ROS from its bytes, or an error that names its topic.

    Args:
        read: makes a message of bytes and the name of a type.
        raw: the bytes.
        kind: name of the type.
        where: begins the line of an error.

    Raises:
        InvalidMessage: the bytes are no message of that type.
    """
    try:
        return read(raw, kind)
    except Exception as error:  # whatever broken bytes provoke
        raise InvalidMessage(where, f"holds {len(raw)} bytes that are no {kind} ({reason(error)})") from error


def ros_header_ns(raw: bytes, encoding: str, where: str) -> int:
    """Stamp (ns) of a message that begins with a header, without reading the rest.

    Args:
        raw: the message, at least its first bytes.
        encoding: "cdr" or "ros1".
        where: begins the line of an error.

    Raises:
        InvalidMessage: there are too few bytes, or they begin with no header.
    """
    try:
        if encoding == "cdr":
            order = "<" if raw[1] & 1 else ">"
            seconds, nanoseconds, letters = struct.unpack_from(f"{order}iII", raw, 4)
        else:
            seconds, nanoseconds, letters = struct.unpack_from("<III", raw, 4)
    except (struct.error, IndexError) as error:
        raise InvalidMessage(where, f"holds {len(raw)} bytes, expected a message with a header") from error
    if letters > LONGEST_FRAME:
        raise InvalidMessage(where, f"has a frame of {letters} letters, expected at most {LONGEST_FRAME}")
    return int(seconds) * NANOSECONDS + int(nanoseconds)
