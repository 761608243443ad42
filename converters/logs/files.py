"""One interface to every container: what topics there are, and their messages in order of recording.

    with open_log([Path("a_0.bag"), Path("a_1.bag")]) as log:
        for topic in log.topics.values():
            print(topic.name, topic.type, topic.count)
        for entry in log.entries("/camera/color/image_raw"):
            image = entry.read()          # attributes as ROS names them, whatever the encoding

Types and fields are those of ROS: Foxglove's messages are brought into that form (`duagc.converters.logs.foxglove`).
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from duagc.converters.logs.entries import Entry, LogPart, LogTopic
from duagc.converters.logs.invalid import InvalidMessages
from duagc.converters.logs.rgbd_messages import with_members
from duagc.converters.logs.topic_types import as_one, of_their_types
from duagc.converters.logs.video import images, is_video
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.recording.names import LOG_RECORD, MAGIC

SUFFIXES = (".bag", ".db3", ".mcap")
HEAD_BYTES = 1024


class Log:
    """One or several containers read as one; a context manager."""

    def __init__(self, parts: Sequence[LogPart], name: str) -> None:
        """Merge the topics of all parts, and add up how many messages each has.

        Args:
            parts: the containers; a topic may be in several.
            name: how messages for people call it.
        """
        self.parts, self.name = list(parts), name
        stated: dict[str, list[LogTopic]] = {}
        for topic in (topic for part in self.parts for topic in part.topics.values()):
            stated.setdefault(topic.name, []).append(topic)
        self.topics = {topic: as_one(found) for topic, found in stated.items()}
        self.invalid = InvalidMessages(self.topics)

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *error: object) -> None:
        for part in self.parts:
            part.close()

    def of_type(self, *types: str, below: str = "") -> list[str]:
        """Names of topics of these types that have messages, in a namespace.

        Args:
            types: names of types as `topics` has them.
            below: the namespace; empty: all topics.
        """
        return sorted(
            t.name for t in self.topics.values() if t.type in types and t.count and is_below(t.name, below)
        )

    def entries(self, *topics: str, heads: Collection[str] = ()) -> Iterator[Entry]:
        """Messages of these topics, in order of recording over all parts.

        Args:
            topics: their names; video comes as the images that it shows, if its topic is not in `heads`.
            heads: see `LogPart.entries`.
        """
        films = {t for t in topics if t in self.topics and is_video(self.topics[t].type)} - set(heads)
        streams = [
            self._entries_of(part, wanted, [t for t in wanted if t in heads])
            for part in self.parts
            if (wanted := [t for t in topics if t in part.topics and t not in films])
        ]
        for topic in sorted(films):
            streams.append(
                images(
                    _merged([self._entries_of(part, [topic]) for part in self.parts if topic in part.topics])
                )
            )
        return _merged(streams)

    def _entries_of(self, part: LogPart, topics: Sequence[str], heads: Sequence[str] = ()) -> Iterator[Entry]:
        """Messages of a part; those of another type than their topic are none."""
        entries = part.entries(topics, heads)
        if not any(self.topics[topic].others for topic in topics):
            return entries
        return of_their_types(entries, self.topics, str(part.path))

    def messages(self, topic: str) -> Iterator[Any]:
        """The messages of a topic in order of recording, without those that are none.

        Args:
            topic: its name.
        """
        for entry in self.entries(topic):
            message = None
            with self.invalid.left_out(entry):
                message = entry.read()
            if message is not None:
                yield message

    def first(self, topic: str) -> Any:
        """The first message of a topic that is one.

        Args:
            topic: its name.

        Raises:
            DuagError: it has no message, or none can be read.
        """
        message = next(self.messages(topic), None)
        if message is None:
            raise self.invalid.first(topic) or DuagError(f"{self.name}: {topic} has no message, expected one")
        return message


def _merged(streams: Sequence[Iterator[Entry]]) -> Iterator[Entry]:
    """Messages in order of recording."""
    return streams[0] if len(streams) == 1 else heapq.merge(*streams, key=lambda entry: entry.log_ns)


def is_own_log(path: Path) -> bool:
    """Whether a file is a log that DUAG-C wrote, by its first record.

    Args:
        path: of any file.
    """
    if path.suffix != ".mcap" or not path.is_file():
        return False
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    return head.startswith(MAGIC) and LOG_RECORD.encode() in head


def is_below(topic: str, namespace: str) -> bool:
    """Whether a topic is in a namespace; in ROS 1 either may come without the slash before it.

    Args:
        topic: its name.
        namespace: empty: that of all.
    """
    space = namespace.strip("/")
    return not space or topic.lstrip("/").startswith(f"{space}/")


def open_log(paths: Sequence[Path], name: str = "") -> Log:
    """Open containers, to be read as one log.

    Args:
        paths: files or folders, the containers of one log.
        name: how messages for people call it; empty: by the first path.

    Raises:
        DuagError: a file is missing, of another kind, or broken.
    """
    parts: list[LogPart] = []
    with ExitStack() as opened:
        for path in paths:
            part = _open_part(path)
            opened.callback(part.close)
            parts.append(with_members(part))
        log = Log(parts, name or str(paths[0]))
        opened.pop_all()
    return log


def _open_part(path: Path) -> LogPart:
    if not path.exists():
        raise DuagError(f"{path}: no such file or folder, expected a log ({', '.join(SUFFIXES)})")
    if path.suffix == ".mcap" and path.is_file():
        from duagc.converters.logs.mcap_file import McapFile

        return McapFile(path)
    if path.suffix in SUFFIXES or (path / "metadata.yaml").is_file():
        from duagc.converters.logs.rosbag_file import RosBag

        return RosBag(path)
    raise DuagError(f"{path}: is no log, expected {', '.join(SUFFIXES)} or a folder of `ros2 bag`")
