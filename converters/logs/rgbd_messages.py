"""Messages that hold color, depth and their cameras at once, read as four topics.

RealSense's driver sends them (`enable_rgbd`), and RTAB-Map. Those of `/camera/rgbd` are read as /camera/rgbd/rgb/image,
/camera/rgbd/rgb/camera_info, and the same of depth; images that they hold compressed as .../image/compressed. RTAB-Map
takes images for rectified, so its are image_rect.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from typing import Any

from duagc.converters.logs.entries import Entry, InvalidMessage, LogPart, LogTopic, raw_image, stamp_ns
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import decode_image

RGBA = b"\x08\x06"  # 8 bits, color type 6, in the first chunk of a PNG
_REALSENSE = "realsense2_camera_msgs/msg/RGBD"
_RTABMAP = ("rtabmap_msgs/msg/RGBDImage", "rtabmap_ros/msg/RGBDImage")
_MEMBERS = {  # of the messages, by the topics that they are read as
    "rgb/{image}": "rgb",
    "rgb/{image}/compressed": "rgb_compressed",
    "rgb/camera_info": "rgb_camera_info",
    "depth/{image}": "depth",
    "depth/{image}/compressed": "depth_compressed",
    "depth/camera_info": "depth_camera_info",
}


def holds_rgbd(kind: str) -> bool:
    """Whether messages of a type hold color, depth and cameras.

    Args:
        kind: ROS 2's name of the type.
    """
    return kind == _REALSENSE or kind in _RTABMAP


def with_members(part: LogPart) -> LogPart:
    """The same container, with a topic for each member of messages that hold color and depth.

    Args:
        part: a container.
    """
    return _WithMembers(part) if any(holds_rgbd(t.type) and t.count for t in part.topics.values()) else part


class _WithMembers:
    """A container with topics for members of messages. Members that are empty in the first message have none."""

    def __init__(self, part: LogPart) -> None:
        self._part, self.path = part, part.path
        self.topics = dict(part.topics)
        self._source: dict[str, tuple[str, str]] = {}  # topic and member, by the topic that it is read as
        for topic in part.topics.values():
            if holds_rgbd(topic.type) and topic.count:
                with suppress(DuagError):  # comes again when images are asked for
                    self._add(topic)

    def _add(self, topic: LogTopic) -> None:
        """Make the topics of the members known."""
        message = self._first_sound(topic.name)
        image = "image_rect" if topic.type in _RTABMAP else "image"
        for name, member in _MEMBERS.items():
            value = getattr(message, member, None)
            added = f"{topic.name}/{name.format(image=image)}"
            if value is not None and len(getattr(value, "data", "1")) and added not in self.topics:
                self._source[added] = topic.name, member
                self.topics[added] = replace(topic, name=added, type=value.__msgtype__, others={})

    def _first_sound(self, topic: str) -> Any:
        """The first message of a topic that is one; an error if there is none."""
        for entry in self._part.entries([topic]):
            with suppress(InvalidMessage):
                if entry.type == self._part.topics[topic].type:
                    return entry.read()
        raise DuagError(f"{self.path}: {topic} has no sound message, expected one")

    def entries(self, topics: Sequence[str], heads: Sequence[str] = ()) -> Iterator[Entry]:
        wanted = {name: self._source[name] for name in topics if name in self._source}
        sources = {topic for topic, _ in wanted.values()}
        own = {topic for topic in topics if topic not in self._source}
        for entry in self._part.entries(sorted(own | sources), [t for t in heads if t in own - sources]):
            if entry.topic in own:
                yield entry
            read = cache(entry.read)  # once for all members
            for name, (topic, member) in wanted.items():
                if topic == entry.topic and entry.type == self._part.topics[topic].type:
                    stamp = partial(_stamp_ns, read, member)
                    yield replace(
                        entry,
                        topic=name,
                        read=partial(_member, read, member),
                        header_ns=stamp,
                        type=self.topics[name].type,
                    )

    def close(self) -> None:
        self._part.close()


def _member(read: Any, member: str) -> Any:
    value = getattr(read(), member)
    floats = _as_floats(value) if member == "depth_compressed" else None
    return value if floats is None else floats


def _as_floats(image: Any) -> Any:
    """Raw depth that RTAB-Map compressed, as a PNG of which a pixel's four bytes are a float; None: it is none."""
    head = bytes(image.data[:26])
    if not head.startswith(b"\x89PNG") or head[24:26] != RGBA:
        return None
    import cv2

    pixels = decode_image(bytes(image.data), cv2.IMREAD_UNCHANGED)
    return None if pixels is None else raw_image(image.header, pixels, "32FC1")


def _stamp_ns(read: Any, member: str) -> int:
    """The time of a member; that of the message where it has none."""
    message = read()
    return stamp_ns(getattr(message, member)) or stamp_ns(message)
