"""Types of topics: which are read here, and of which a topic is whose messages are of several."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NoReturn

from duagc.converters.logs.entries import Entry, InvalidMessage, LogTopic

_READ = {
    "builtin_interfaces": "Time",
    "std_msgs": "Header",
    "geometry_msgs": "Point Pose PoseStamped PoseWithCovariance PoseWithCovarianceStamped Quaternion Transform "
    "TransformStamped Vector3",
    "nav_msgs": "Odometry",
    "sensor_msgs": "CameraInfo CompressedImage Image Imu PointCloud2 PointField RegionOfInterest",
    "tf2_msgs": "TFMessage",
}
READ_TYPES = {f"{package}/msg/{name}" for package, names in _READ.items() for name in names.split()}


def as_one(topics: Sequence[LogTopic]) -> LogTopic:
    """What several connections, channels or files say of one topic; its type is the one that most messages have.

    Of types with as many messages one that is read here counts, then the first.

    Args:
        topics: of one name, at least one.
    """
    counts = Counter[str]()
    for topic in topics:
        counts.update({topic.type: topic.count - sum(topic.others.values()), **topic.others})
    kind = max(counts, key=lambda kind: (counts[kind], kind in READ_TYPES))
    stating = [topic for topic in topics if topic.type == kind]
    last = [*stating[:1], *(topic for topic in stating if topic.count)][-1]
    remarks = dict.fromkeys(topic.remark for topic in stating if topic.remark)
    others = {other: count for other, count in counts.items() if count and other != kind}
    return replace(last, count=counts.total(), others=others, remark="; ".join(remarks))


def of_their_types(entries: Iterator[Entry], topics: Mapping[str, LogTopic], name: str) -> Iterator[Entry]:
    """The same messages; whoever reads one of another type than its topic learns that it is.

    Args:
        entries: of any topics.
        topics: of the log, by name.
        name: of the log, for the error.
    """
    for entry in entries:
        wanted = topics[entry.topic].type
        if entry.type in ("", wanted):
            yield entry
        else:
            refuse = partial(_refuse, f"{name}: {entry.topic}", entry.type, wanted)
            yield replace(entry, read=refuse, header_ns=refuse)


def _refuse(where: str, found: str, wanted: str) -> NoReturn:
    raise InvalidMessage(where, f"holds {found}, expected {wanted} as most of its messages are")
