"""Messages of a log that are none: their bytes are cut, or of another type than most of their topic.

One of them costs itself: it is left out, and said with its topic, its time and how many there are. Where most messages
of a topic are such, the log is not what it says, and that is an error.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager

from duagc.converters.logs.entries import Entry, InvalidMessage, LogTopic
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.messages.parts import NANOSECONDS


class InvalidMessages:
    """What was left out of a log, by topic and time of recording.

    What is read twice counts once, and so do messages of one topic that were recorded at one time.
    """

    def __init__(self, topics: Mapping[str, LogTopic]) -> None:
        """Nothing was left out yet.

        Args:
            topics: of the log, by name.
        """
        self._topics = topics
        self._found: dict[str, dict[int, InvalidMessage]] = {}

    @contextmanager
    def left_out(self, entry: Entry) -> Iterator[None]:
        """Leave the block, and remember why, when it finds that a message is none.

        Args:
            entry: the message that is read in the block.
        """
        try:
            yield
        except InvalidMessage as error:
            self.add(entry, error)

    def add(self, entry: Entry, error: InvalidMessage) -> None:
        """Remember a message that is none.

        Args:
            entry: the message.
            error: what its bytes are.
        """
        self._found.setdefault(entry.topic, {}).setdefault(entry.log_ns, error)

    def first(self, topic: str) -> InvalidMessage | None:
        """What the first message of a topic is that is none; None: there is none such.

        Args:
            topic: its name.
        """
        found = self._found.get(topic)
        return None if found is None else found[min(found)]

    def words(self, topics: Collection[str]) -> list[str]:
        """What to warn of: for every topic what its log remarks on it, and the messages that were left out.

        Args:
            topics: those that are converted.
        """
        known = [self._topics[topic] for topic in sorted(set(topics) & self._topics.keys())]
        lines = [f"{topic.name}: {topic.remark}" for topic in known if topic.remark]
        for topic in sorted(self._found.keys() & set(topics)):
            found = self._found[topic]
            first_ns = min(found)
            lines.append(
                f"{topic}: {len(found)} of {self._topics[topic].count} messages left out; the first, recorded at "
                f"{first_ns / NANOSECONDS:.3f} s, {found[first_ns].why}"
            )
        return lines

    def check(self, topics: Collection[str]) -> None:
        """Refuse topics most of whose messages are none.

        Args:
            topics: those that are needed.

        Raises:
            DuagError: names the topic, what its first such message is, and how many there are.
        """
        for topic in sorted(self._found.keys() & set(topics)):
            bad, count = len(self._found[topic]), self._topics[topic].count
            if 2 * bad > count:
                raise DuagError(
                    f"{self.first(topic)}; so it is with {bad} of its {count} messages, expected most of them sound"
                )
