"""Topics and messages of a log, whatever the container, and their times."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.messages.parts import NANOSECONDS

LAST_NS = 1 << 62
SOUND_TIMES = "one between the years 1970 and 2116"


class InvalidMessage(DuagError):  # noqa: N818 (the name says it)
    """The bytes of a message are none of the type of its topic; others of the topic may be sound.

    Attributes:
        why: what they are, without the place.
    """

    def __init__(self, where: str, why: str) -> None:
        """Make the line of an error.

        Args:
            where: file and topic; begins the line.
            why: what was found, and what was expected.
        """
        super().__init__(f"{where} {why}")
        self.why = why


@dataclass(frozen=True)
class LogTopic:
    """A topic of a log.

    Attributes:
        type: ROS's name of it ("sensor_msgs/msg/Image"), or the schema's own if it has none.
            If the topic holds several: the one that most messages have.
        schema: as the file names them.
        encoding: as the file names them.
        count: messages, of all types.
        metadata: that the channel states, where the container holds any.
        others: messages of other types than `type`, by type.
        remark: what users should know who read it; empty: nothing.
    """

    name: str
    type: str
    schema: str
    encoding: str
    count: int
    metadata: Mapping[str, str] = field(default_factory=dict)
    others: Mapping[str, int] = field(default_factory=dict)
    remark: str = ""


@dataclass(frozen=True)
class Entry:
    """One message.

    Attributes:
        log_ns: when it was recorded.
        publish_ns: when it was sent, where the container records it.
        data: as it stands in the container.
        read: the message, with ROS's fields.
        header_ns: the time in its header, 0 where it has none.
        type: as `LogTopic` has it; empty: that of its topic.
    """

    topic: str
    log_ns: int
    publish_ns: int | None
    data: bytes
    read: Callable[[], Any]
    header_ns: Callable[[], int]
    type: str = ""


class LogPart(Protocol):
    """One container file, or a folder of `ros2 bag`."""

    path: Path
    topics: dict[str, LogTopic]

    def entries(self, topics: Sequence[str], heads: Sequence[str] = ()) -> Iterator[Entry]:
        """Messages of these topics in order of recording.

        Args:
            topics: their names.
            heads: those of which `header_ns` is all that will be asked; `data` may be cut behind it.
        """
        ...

    def close(self) -> None: ...


def sound_time(time_ns: int, where: str) -> int:
    """A time that can be computed with.

    Args:
        time_ns: since 1970.
        where: begins the line of an error.

    Raises:
        DuagError: it is before 1970 or after 2115.
    """
    if not 0 <= time_ns < LAST_NS:
        raise DuagError(f"{where}: time {time_ns} ns, expected {SOUND_TIMES}")
    return time_ns


def time_of(entry: Entry, source: str, name: str) -> int:
    """The time of a message by one of its clocks, ns.

    Args:
        entry: the message.
        source: the clock, "header", "log" or "publish".
        name: of the log.

    Raises:
        InvalidMessage: the message has no header, or a time in it that cannot be computed with.
        DuagError: the container has no times of publication.
    """
    if source == "header":
        stamp_ns = entry.header_ns()
        if not 0 <= stamp_ns < LAST_NS:
            raise InvalidMessage(f"{name}: {entry.topic}", f"has time {stamp_ns} ns, expected {SOUND_TIMES}")
        return stamp_ns
    if source == "log":
        return entry.log_ns
    if entry.publish_ns is None:
        raise DuagError(
            f"{name}: bags of ROS hold no times of publication, expected time_source=header or log"
        )
    return entry.publish_ns


def raw_image(header: Any, pixels: NDArray[Any], encoding: str) -> SimpleNamespace:
    """An Image with ROS's fields.

    Args:
        header: of the message.
        pixels: [h, w, ...], bytes of the encoding, little-endian.
        encoding: ROS's name of it.
    """
    rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
    return SimpleNamespace(
        header=header,
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=rows.shape[1],
        data=rows.reshape(-1),
    )


def ros_type(schema: str) -> str:
    """A type of ROS by the name that ROS 2 has for it: "sensor_msgs/Image" is "sensor_msgs/msg/Image".

    Args:
        schema: name of a type, of ROS 1 or ROS 2; other names stay as they are.
    """
    parts = schema.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else schema


def reason(error: Exception) -> str:
    """What an error says, on one line; its kind if it says nothing.

    Args:
        error: any exception.

    Returns:
        At most 200 characters.
    """
    return " ".join(str(error).rstrip(".").split())[:200] or type(error).__name__


def stamp_ns(message: Any) -> int:
    """The time in the header of a message, 0 where it has none.

    Args:
        message: of ROS, with fields as attributes.
    """
    header = getattr(message, "header", None)
    return int(header.stamp.sec) * NANOSECONDS + int(header.stamp.nanosec) if header else 0
