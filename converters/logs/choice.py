"""Which topics of a log are a robot's color, depth and cameras, by type and name, and why."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Any

from duagc.converters.layouts.ros_images import DEPTH_ENCODINGS, is_depth, is_unusable
from duagc.converters.logs.cameras import image_path
from duagc.converters.logs.entries import InvalidMessage, LogTopic, ros_type
from duagc.converters.logs.files import Log, is_below
from duagc.converters.logs.rgbd_messages import holds_rgbd
from duagc.converters.logs.video import is_video
from duagc.pipeline.base.errors import DuagError, closest

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO_TYPE, INFO_NAME = "sensor_msgs/msg/CameraInfo", "camera_info"
POINTS_TYPE = "sensor_msgs/msg/PointCloud2"
MOST_TRIED, MOST_PACKETS = 30, 1000  # images, and packets of video, that are read to find one that is sound
PACKETS = (
    "CustomMsg",
    "VelodyneScan",
    "PacketMsg",
    "HesaiScan",
    "RslidarScan",
    "NebulaPackets",
)  # of LiDARs, likewise
LEFT, RIGHT = ("left", "infra1", "infrared_1", "cam0"), ("right", "infra2", "infrared_2", "cam1")
REGISTERED = (
    "aligned_depth_to_color",
    "depth_registered",
    "registered",
    "aligned",
)  # words of a topic's parts


@dataclass(frozen=True)
class Choice:
    """A topic and why it is the one; or no topic, and what keeps from choosing.

    Attributes:
        candidates: topics that could have been meant.
        expected: what decides, if not the option of the topic.
    """

    topic: str
    why: str
    candidates: tuple[str, ...] = ()
    expected: str = ""

    def required(self, log: Log, option: str) -> str:
        """The topic.

        Args:
            log: named in the error.
            option: that names the topic, unless `expected` says otherwise.

        Raises:
            DuagError: there is none; names the option that decides.
        """
        if not self.topic:
            raise DuagError(f"{log.name}: {self.why}; expected --set {self.expected or f'{option}=TOPIC'}")
        return self.topic


class Chooser:
    """Chooses among the topics of one robot; reads the first sound message of every topic of images."""

    def __init__(self, log: Log, namespace: str = "", wanted: Mapping[str, str] | None = None) -> None:
        """Read a sound message of every topic of images, and list those of CameraInfo and of points.

        Args:
            log: the log.
            namespace: only topics below it.
            wanted: topics by name of the option ("color", ...), "" = not given.
        """
        self.log, self.namespace, self._wanted = log, namespace.rstrip("/"), dict(wanted or {})
        self.images: dict[str, Any] = {}
        self.unread = ""  # what to add to a complaint that there are no images: why others have none
        for image_topic in log.of_type(*IMAGE_TYPES, below=self.namespace):
            try:
                self.images[image_topic] = first_usable(log, image_topic)
            except InvalidMessage as error:  # and so are all others of the topic
                self.unread += f"; {error}"
        for topic in sorted(log.topics.values(), key=lambda t: t.name):
            if topic.count and is_below(topic.name, self.namespace):
                self._add_held(topic)
        self.infos = log.of_type(INFO_TYPE, below=self.namespace)
        self.clouds = log.of_type(POINTS_TYPE, below=self.namespace)

    def color(self) -> Choice:
        """Images that are not depth, and are not named so."""
        found = [t for t, m in self.images.items() if not is_depth(m) and not self._is_named_depth(t)]
        left = LEFT if self._wanted.get("depth_from") == "stereo" else ()
        choice = self._one("color", self._preferred(found), (*left, "color", "rgb"))
        return choice if choice.topic else replace(choice, why=choice.why + self.unread)

    def depth(self) -> Choice:
        """Images that say that they are depth, of several those that are named so too.

        mono16 may be infrared and counts only if it is named depth, or where nothing else does.

        Where depth comes from elsewhere (`depth_from`): the right images, or the points of a LiDAR.
        """
        source = self._wanted.get("depth_from")
        if source == "stereo":
            left = self.color().topic
            others = [t for t, m in self.images.items() if t != left and not is_depth(m)]
            others = [t for t in others if not self._is_named_depth(t)]
            return self._one("depth", self._preferred(others), RIGHT, "right")
        if source == "lidar":
            if not self.clouds:
                return Choice("", f"no topic holds {POINTS_TYPE}{packet_words(self.log, self.namespace)}")
            return self._one("depth", self.clouds, (), "point", known=self.clouds)
        found = [t for t, m in self.images.items() if is_depth(m)]
        infrared = [t for t in found if getattr(self.images[t], "encoding", "") == "mono16"]
        sure = [t for t in found if t not in infrared or self._is_named_depth(t)]
        near = self._near_color(self._preferred(sure or found))
        choice = self._one("depth", [t for t in near if "depth" in t.lower()] or near, REGISTERED)
        lost = [t for t, m in self.images.items() if self._is_named_depth(t) and not is_depth(m)]
        if not choice.topic and not choice.candidates and self.clouds:
            choice = replace(choice, why=f"{choice.why}, but there are points (depth_from=lidar)")
        elif not choice.topic and not choice.candidates:
            choice = replace(choice, why=choice.why + packet_words(self.log, self.namespace))
        sides = [
            [t for t in self.images if any(hint in t.lower() for hint in hints)] for hints in (LEFT, RIGHT)
        ]
        if not choice.topic and not choice.candidates and all(sides):
            choice = replace(
                choice, why=f"{choice.why}, but there are left and right ones (depth_from=stereo)"
            )
        if choice.topic or not lost:
            return choice
        return replace(choice, why=f"{choice.why}; {', '.join(map(self._no_depth_words, lost))}")

    def _no_depth_words(self, topic: str) -> str:
        """Why images that are named so hold no depth."""
        encoding = getattr(self.images[topic], "encoding", None)
        if encoding is None:
            return f"{topic} holds no depth, or as JPEG, which destroys it"
        return f"{topic} has encoding {encoding!r}, none of {', '.join(DEPTH_ENCODINGS)}"

    def _near_color(self, topics: Sequence[str]) -> Sequence[str]:
        """Topics whose names share most with that of color: of several cameras each has its own depth."""
        color = self.color().topic
        shared = [shared_parts(color, topic) for topic in topics]
        return [topic for topic, count in zip(topics, shared, strict=True) if count == max(shared)]

    def info(self, option: str, image_topic: str) -> Choice:
        """CameraInfo of an image topic: the one where ROS looks for it, else whose name shares most with it.

        Args:
            option: "color_info" or "depth_info"; if it is set, its topic is the choice.
            image_topic: of the images.
        """
        if self._wanted.get(option):
            return self._told(option, self.infos)
        by_parts = {_parts(info): info for info in self.infos}
        for parts in info_parts(image_topic):
            if parts in by_parts:
                return Choice(by_parts[parts], "it lies next to the images", tuple(self.infos))
        shared = {info: shared_parts(image_topic, info) for info in self.infos}
        best = [info for info in self.infos if shared[info] == max(shared.values())]
        if len(best) != 1 or shared[best[0]] == 0:
            if not self.infos:
                stated = f"{option.removesuffix('_info')}_camera='fx fy cx cy'"
                if option == "depth_info" and self._wanted.get("depth_from") == "image":
                    stated += ", or registered=yes if it is seen from color"
                return Choice("", f"{image_topic} has CameraInfo on no topic", expected=stated)
            return Choice(
                "",
                f"{image_topic} has CameraInfo of its own on none of {', '.join(self.infos)}",
                tuple(self.infos),
                f"{option}=TOPIC if one is of its camera, or {option.removesuffix('_info')}_camera='fx fy cx cy'",
            )
        return Choice(best[0], "its name shares most with that of the images", tuple(self.infos))

    def _add_held(self, topic: LogTopic) -> None:
        """The images of video, or why messages that hold images cannot be read: bags may lack their definition."""
        try:
            if is_video(topic.type):
                self.images[topic.name] = first_usable(self.log, topic.name)
            elif holds_rgbd(topic.type):  # its images have topics of their own
                self.log.first(topic.name)
        except DuagError as error:
            self.unread += f"; {error}"

    def _preferred(self, topics: Sequence[str]) -> Sequence[str]:
        """Topics of images, if there are any; else of messages that hold both, else of video."""
        first = min((repeats(self.log, topic) for topic in topics), default=0)
        return [topic for topic in topics if repeats(self.log, topic) == first]

    def _is_named_depth(self, topic: str) -> bool:
        """Whether a topic is named as depth; the name of a sensor of both (/depth_cam/rgb) does not count."""
        names, parts = [topic.lower()], PurePosixPath(topic.lower()).parts
        for other in (t.lower() for t, m in self.images.items() if is_depth(m)):
            others = PurePosixPath(other).parts
            same = [a == b for a, b in zip(parts, others, strict=False)]
            shared = [*same, False].index(False)
            if any("depth" in part for part in others[shared:]):
                names.append("/".join(parts[shared:]))
        return all("depth" in name for name in names)

    def _one(
        self,
        kind: str,
        found: Sequence[str],
        hints: Sequence[str],
        called: str = "",
        *,
        known: Sequence[str] = (),
    ) -> Choice:
        """The topic that was given, the only one, or the only one with the first hint that decides.

        kind: the option. called: what kind of images these are, if not that. known: what may be given, if not images.
        """
        if self._wanted.get(kind):
            return self._told(kind, known or list(self.images))
        kind = called or kind
        found = [
            t for t in found if t.rpartition("/")[0] not in found
        ]  # "/image/compressed" repeats "/image"
        if len(found) == 1:
            return Choice(found[0], f"the only images that are {kind}", tuple(found))
        for hint in hints:
            some = [topic for topic in found if _has(topic, hint)]
            if len(some) == 1:
                return Choice(some[0], f"the only {kind} images with {hint!r} in their name", tuple(found))
        if not found:
            names = ", ".join(self.images)
            why = f"none of {names} holds {kind} images" if names else "there are no images"
            return Choice("", why)
        return Choice("", f"{kind} images on {', '.join(found)}", tuple(found))

    def _told(self, option: str, known: Sequence[str]) -> Choice:
        wanted = self._wanted[option]
        if wanted not in known:
            there = self.log.topics.get(wanted)
            found = f"is {there.type}" if there and there.count else "not found"
            raise DuagError(
                f"{self.log.name}: {option} topic {wanted} {found}, {closest(wanted, known, 'a topic')}"
            )
        return Choice(wanted, "given", tuple(known))


def _has(topic: str, hint: str) -> bool:
    """Whether a hint is in the name of a topic; one of registration only as whole words ("unregistered" is none)."""
    if hint not in REGISTERED:
        return hint in topic.lower()
    return re.search(rf"(?<![a-z0-9]){hint}(?![a-z0-9])", topic.lower()) is not None


def repeats(log: Log, topic: str) -> int:
    """How likely images repeat those of other topics: 0 of their own, 1 below messages that hold both, 2 of video.

    Args:
        log: the log.
        topic: of images.
    """
    known = log.topics[topic]
    return 2 if is_video(known.type) else int(holds_rgbd(ros_type(known.schema)))


def first_usable(log: Log, topic: str) -> Any:
    """The first image of a topic that can be read; the very first if none of some can be.

    Args:
        log: the log.
        topic: of images.
    """
    most = MOST_PACKETS if is_video(log.topics[topic].type) else MOST_TRIED
    for message in itertools.islice(log.messages(topic), most):
        if not is_unusable(message):
            return message
    return log.first(topic)


def packet_words(log: Log, namespace: str) -> str:
    """What to add to a complaint that there are no points: topics that hold them as their driver has them.

    Args:
        log: whose topics are searched.
        namespace: of the robot; empty: the whole log.

    Returns:
        Words that begin with "; ", or an empty string.
    """
    found = sorted(
        f"{t.name} ({t.type})"
        for t in log.topics.values()
        if t.type.endswith(PACKETS) and t.count and is_below(t.name, namespace)
    )
    return f"; {', '.join(found)} is of a driver and not read: republish it as {POINTS_TYPE}" if found else ""


def _parts(topic: str) -> tuple[str, ...]:
    return PurePosixPath(topic.lstrip("/")).parts


def info_parts(image_topic: str) -> list[tuple[str, ...]]:
    """Where CameraInfo of images lies next to them: /rgb_camera_info of /rgb_image, else /camera_info, as ROS looks.

    Args:
        image_topic: of the images, or of a transport of them.
    """
    path = image_path(image_topic)
    names = re.sub(r"image(_.*)?$", INFO_NAME, path.name), INFO_NAME
    return [_parts(str(path.parent / name)) for name in names]


def shared_parts(a: str, b: str) -> int:
    """How many parts two topics have in common from the left.

    Args:
        a: a topic, such as /camera/color/image.
        b: another one.
    """
    count = 0
    for x, y in zip(_parts(a), _parts(b), strict=False):
        if x != y:
            break
        count += 1
    return count
