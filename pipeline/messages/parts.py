"""Pieces that messages share: times, arrays, poses, and the names of frames."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc import schemas
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError

NANOSECONDS = 1_000_000_000
WORLD_FRAME = "world"


def map_frame(robot: str) -> str:
    """Name of the frame of a robot's own map: that of its first camera pose.

    Args:
        robot: name of the robot, or of a component.
    """
    return f"{robot}/map"


def camera_frame(robot: str) -> str:
    """Name of the frame of a robot's color camera: x right, y down, z forward.

    Args:
        robot: name of the robot, or of a component.
    """
    return f"{robot}/camera"


def pack_stamp(message: Any, stamp_ns: int) -> None:
    """Set the field `timestamp` of any message to integer nanoseconds.

    Args:
        message: with a field `timestamp`; changed in place.
        stamp_ns: time, ns.
    """
    message.timestamp.seconds, message.timestamp.nanos = divmod(int(stamp_ns), NANOSECONDS)


def unpack_stamp(message: Any) -> int:
    """Integer nanoseconds of the field `timestamp` of any message.

    Args:
        message: with a field `timestamp`.
    """
    return message.timestamp.seconds * NANOSECONDS + message.timestamp.nanos


def unpack_array(data: bytes, dtype: str, shape: tuple[int, ...], field: str) -> NDArray[Any]:
    """Array of a shape from little-endian bytes; a writable copy.

    Args:
        data: little-endian bytes, row-major.
        dtype: name of the type, without its byte order.
        shape: of the array.
        field: name of the field, for the line of the error.

    Raises:
        DuagError: the bytes do not have the length that the shape asks for.
    """
    expected = math.prod(shape) * np.dtype(dtype).itemsize
    if len(data) != expected:
        raise DuagError(f"{field} has {len(data)} bytes, expected {expected} for {dtype} {list(shape)}")
    return np.frombuffer(data, np.dtype(dtype).newbyteorder("<")).reshape(shape).astype(dtype)


def numbers(values: Any, shape: tuple[int, ...], field: str) -> Array:
    """float64 array of a shape from a repeated field.

    Args:
        values: of the repeated field, row-major.
        shape: of the array.
        field: name of the field, for the line of the error.

    Raises:
        DuagError: another number of values than the shape asks for.
    """
    array = np.array(values, dtype=np.float64)
    if array.size != math.prod(shape):
        raise DuagError(f"{field} has {array.size} numbers, expected {math.prod(shape)}")
    return array.reshape(shape)


def pack_pose(T: ArrayLike) -> Any:
    """duagc.v1.Pose of a motion.

    Args:
        T: [4, 4], translation in meters.

    Raises:
        ValueError: not [4, 4].
    """
    T = np.asarray(T, dtype=np.float64)
    if T.shape != (4, 4):
        raise ValueError(f"a pose is [4, 4], not {T.shape}")
    x, y, z = T[:3, 3].tolist()
    return schemas.new("Pose", translation={"x": x, "y": y, "z": z}, rotation=T[:3, :3].ravel().tolist())


def unpack_pose(pose: Any, field: str = "pose") -> Array:
    """Motion [4, 4] of a duagc.v1.Pose.

    Args:
        pose: duagc.v1.Pose.
        field: name of the field, for the line of the error.

    Raises:
        DuagError: a rotation of other than nine numbers.
    """
    T = np.eye(4)
    T[:3, :3] = numbers(pose.rotation, (3, 3), f"{field}.rotation")
    T[:3, 3] = pose.translation.x, pose.translation.y, pose.translation.z
    return T


def pack_information(information: ArrayLike) -> list[float]:
    """The 36 numbers of the information of a pose, row by row.

    Args:
        information: [6, 6], right tangent (translation m, rotation rad).

    Raises:
        ValueError: not [6, 6].
    """
    array = np.asarray(information, dtype=np.float64)
    if array.shape != (6, 6):
        raise ValueError(f"the information of a pose is [6, 6], not {array.shape}")
    return array.ravel().tolist()
