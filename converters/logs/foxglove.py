"""Messages of Foxglove's schemas with the fields that ROS has for the same things, from protobuf, JSON or ROS.

Foxglove has no schema for an IMU.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace as Fields
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from duagc.converters.logs.entries import InvalidMessage

ROS_TYPES = {
    "foxglove.CompressedImage": "sensor_msgs/msg/CompressedImage",
    "foxglove.CompressedVideo": "foxglove_msgs/msg/CompressedVideo",
    "foxglove.RawImage": "sensor_msgs/msg/Image",
    "foxglove.CameraCalibration": "sensor_msgs/msg/CameraInfo",
    "foxglove.FrameTransform": "tf2_msgs/msg/TFMessage",
    "foxglove.FrameTransforms": "tf2_msgs/msg/TFMessage",
    "foxglove.PoseInFrame": "geometry_msgs/msg/PoseStamped",
    "foxglove.Odometry": "nav_msgs/msg/Odometry",
    "foxglove.PointCloud": "sensor_msgs/msg/PointCloud2",
}
POINT_TYPES = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}  # Foxglove's number of a type -> that of ROS
_POINT_TYPE_NAMES = ("UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64")  # from 1


def plain_name(schema: str) -> str:
    """Foxglove's name of a schema that ROS or JSON spell otherwise, such as "foxglove_msgs/msg/RawImage".

    Args:
        schema: name of a type, of Foxglove or not.

    Returns:
        The name with "foxglove." before it; that of another schema as it is.
    """
    parts = schema.split("/")
    if len(parts) > 1 and parts[0] in ("foxglove", "foxglove_msgs"):
        return f"foxglove.{parts[-1]}"
    return schema


def as_ros(schema: str, message: Any, where: str) -> Any:
    """A message with ROS's fields; of a schema that is not Foxglove's, or has none in ROS, the message itself.

    Args:
        schema: by its plain name.
        message: attributes by Foxglove's names.
        where: of the message, for errors.
    Raises:
        InvalidMessage: a field is missing or of another kind.
    """
    if schema not in ROS_TYPES:
        return message
    with _readable(schema, where):
        return _MAKERS[schema](message)


def stamp_ns(message: Any, where: str) -> int:
    """The time of a message of Foxglove, ns.

    Args:
        message: with a field `timestamp`.
        where: begins the line of an error.

    Raises:
        InvalidMessage: the time cannot be read.
    """
    with _readable("timestamp", where):
        stamp = _stamp(message.timestamp)
        return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


@contextmanager
def _readable(what: str, where: str) -> Iterator[None]:
    try:
        yield
    except (AttributeError, TypeError, ValueError, KeyError, OverflowError, binascii.Error) as error:
        raise InvalidMessage(
            where, f"holds a {what} that cannot be read ({' '.join(str(error).split())})"
        ) from error


class JsonFields:
    """A JSON object whose members are attributes; members that are objects too."""

    def __init__(self, members: dict[str, Any]) -> None:
        """Keep the members; objects in them are wrapped when they are read.

        Args:
            members: of the JSON object, by name.
        """
        self._members = members

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name not in self._members:
            raise AttributeError(f"no {name}")
        return _wrapped(self._members[name])


class Base64(bytes):
    """Bytes in base64 that are not unpacked yet."""


LONG_TEXT = 4096
_SPACE = b" \t\r\n"
_STAMP = re.compile(
    rb'\s*\{\s*"timestamp"\s*:\s*\{\s*"sec"\s*:\s*(\d{1,18})\s*,\s*"nsec"\s*:\s*(\d{1,9})\s*\}'
)


def json_members(data: bytes) -> Any:
    """A JSON text as Python has it. Long `data` without escapes is not walked through: it comes as `Base64`.

    Args:
        data: the text, UTF-8.

    Raises:
        ValueError: it is no JSON.
    """
    name = data.find(b'"data"')
    colon = data[name + 6 : name + 64].lstrip(_SPACE)
    if name < 0 or not colon.startswith(b":") or not colon[1:].lstrip(_SPACE).startswith(b'"'):
        return json.loads(data)
    start = data.index(b'"', name + 6) + 1
    end = data.find(b'"', start)
    if end - start < LONG_TEXT or data.find(b"\\", start, end) >= 0:
        return json.loads(data)
    rest = data[:start] + data[end:]
    members = json.loads(rest)
    if not isinstance(members, dict) or members.get("data") != "" or rest.count(b'"data"') > 1:
        return json.loads(data)  # the name stands elsewhere too
    return {**members, "data": Base64(data[start:end])}


def first_stamp_of_json(head: bytes) -> int | None:
    """The time (ns) of a message whose first member is `timestamp`; None if that is not so.

    Args:
        head: first bytes of the message.
    """
    found = _STAMP.match(head)
    return int(found[1]) * 1_000_000_000 + int(found[2]) if found else None


def first_stamp_of_protobuf(head: bytes) -> int | None:
    """The time (ns) of a message whose first field is `timestamp` (number 1, in all of Foxglove's but lists).

    Args:
        head: first bytes of the message.

    Returns:
        None if that is not so, or the bytes end before the time does.
    """
    from google.protobuf.timestamp_pb2 import Timestamp

    if head[:1] != b"\x0a" or not 2 <= (length := head[1] if len(head) > 1 else 0) <= min(127, len(head) - 2):
        return None
    try:
        stamp = Timestamp.FromString(head[2 : 2 + length])
    except DecodeError:
        return None
    return int(stamp.seconds) * 1_000_000_000 + int(stamp.nanos)


def _wrapped(value: Any) -> Any:
    if isinstance(value, dict):
        return JsonFields(value)
    return [_wrapped(v) for v in value] if isinstance(value, list) else value


def _stamp(time: Any) -> Fields:
    """Time of protobuf (seconds, nanos), JSON (sec, nsec) or ROS (sec, nanosec)."""
    if hasattr(time, "nanos"):
        return Fields(sec=int(time.seconds), nanosec=int(time.nanos))
    return Fields(sec=int(time.sec), nanosec=int(time.nsec if hasattr(time, "nsec") else time.nanosec))


def _header(m: Any, frame: str = "frame_id") -> Fields:
    return Fields(stamp=_stamp(m.timestamp), frame_id=str(getattr(m, frame)))


def _bytes(data: Any) -> bytes:
    """Bytes, of JSON in base64 or as a list; a number would become as many zeros."""
    if not isinstance(data, str | bytes | list):
        raise TypeError(f"data is {type(data).__name__}, expected bytes")
    if isinstance(data, Base64):
        return binascii.a2b_base64(data, strict_mode=True)
    return base64.b64decode(data, validate=True) if isinstance(data, str) else bytes(data)


def _xyz(v: Any) -> Fields:
    return Fields(x=float(v.x), y=float(v.y), z=float(v.z))


def _pose(pose: Any) -> Fields:
    q = pose.orientation
    return Fields(position=_xyz(pose.position), orientation=Fields(**vars(_xyz(q)), w=float(q.w)))


def _compressed_image(m: Any) -> Fields:
    return Fields(header=_header(m), format=str(getattr(m, "format", "")), data=_bytes(m.data))


def _raw_image(m: Any) -> Fields:
    return Fields(
        header=_header(m),
        width=int(m.width),
        height=int(m.height),
        encoding=str(m.encoding),
        step=int(m.step),
        is_bigendian=0,
        data=_bytes(m.data),
    )


def _calibration(m: Any) -> Fields:
    matrices = {
        name: [float(v) for v in getattr(m, name if hasattr(m, name) else name.lower())] for name in "DKRP"
    }
    return Fields(
        header=_header(m),
        width=int(m.width),
        height=int(m.height),
        distortion_model=str(m.distortion_model),
        binning_x=0,
        binning_y=0,
        roi=Fields(x_offset=0, y_offset=0, width=0, height=0),
        **matrices,
    )


def _transforms(m: Any) -> Fields:
    transforms = [
        Fields(
            header=_header(t, "parent_frame_id"),
            child_frame_id=str(t.child_frame_id),
            transform=Fields(
                translation=_xyz(t.translation),
                rotation=Fields(**vars(_xyz(t.rotation)), w=float(t.rotation.w)),
            ),
        )
        for t in (m.transforms if hasattr(m, "transforms") else [m])
    ]
    first = transforms[0].header if transforms else Fields(stamp=Fields(sec=0, nanosec=0), frame_id="")
    return Fields(header=first, transforms=transforms)


def _pose_in_frame(m: Any) -> Fields:
    return Fields(header=_header(m), pose=_pose(m.pose))


def _odometry(m: Any) -> Fields:
    return Fields(header=_header(m), child_frame_id=str(m.body_frame_id), pose=Fields(pose=_pose(m.pose)))


def _point_cloud(m: Any) -> Fields:
    pose = _pose(m.pose)
    p, q = pose.position, pose.orientation
    if np.any(np.abs([p.x, p.y, p.z, q.x, q.y, q.z]) > 0):
        raise ValueError("points in a frame of their own, expected the pose to be the identity")
    fields = [
        Fields(
            name=str(f.name),
            offset=int(f.offset),
            datatype=POINT_TYPES[
                _POINT_TYPE_NAMES.index(f.type) + 1 if isinstance(f.type, str) else int(f.type)
            ],
            count=1,
        )
        for f in m.fields
    ]
    data, step = _bytes(m.data), int(m.point_stride)
    if step <= 0 or len(data) % step:
        raise ValueError(f"{len(data)} bytes of points of {step}")
    return Fields(
        header=_header(m),
        height=1,
        width=len(data) // step,
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=len(data),
        data=np.frombuffer(data, np.uint8),
        is_dense=False,
    )


_MAKERS: dict[str, Callable[[Any], Fields]] = {
    "foxglove.CompressedImage": _compressed_image,
    "foxglove.CompressedVideo": _compressed_image,
    "foxglove.RawImage": _raw_image,
    "foxglove.CameraCalibration": _calibration,
    "foxglove.FrameTransform": _transforms,
    "foxglove.FrameTransforms": _transforms,
    "foxglove.PoseInFrame": _pose_in_frame,
    "foxglove.Odometry": _odometry,
    "foxglove.PointCloud": _point_cloud,
}
