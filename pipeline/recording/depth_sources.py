"""Where the depth of a frame comes from: the colour camera's own, another camera's, or a LiDAR's."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline import messages
from pipeline.errors import DuagError
from pipeline.geometry.camera import PinholeCamera
from pipeline.recording.names import DEPTH_SCALE_KEY
from pipeline.recording.read import LogFile, Record
from pipeline.recording.register_depth import fill_between, register_depth
from schemas import topics as topic_table

Value = TypeVar("Value")


class DepthSource(Protocol):
    """One topic of a log, read as depth images of the colour camera. scale: metres per unit of the source."""

    topic: str
    scale: float

    def read(self, record: Record) -> NDArray[np.float32]:
        """Depth [h, w] of a message, metres along z of the colour camera, 0 = unknown."""
        ...


def depth_source(log: LogFile, robot: str, camera: PinholeCamera) -> DepthSource:
    """The best source that the log has: registered depth, then another camera's, then a LiDAR's."""
    sources: tuple[tuple[topic_table.Topic, Callable[[LogFile, str, PinholeCamera], DepthSource]], ...] = (
        (topic_table.DEPTH, Registered),
        (topic_table.RAW_DEPTH, OtherCamera),
        (topic_table.LIDAR, Lidar),
    )
    for topic, source in sources:
        if log.entries(topic.of(robot)):
            return source(log, robot, camera)
    names = ", ".join(topic.of(robot) for topic, _ in sources)
    raise DuagError(f"{log.path}: none of {names} has a message, expected depth from one of them")


class Registered:
    """Depth images that are registered to colour."""

    def __init__(self, log: LogFile, robot: str, camera: PinholeCamera) -> None:
        self.topic, self.camera = topic_table.DEPTH.of(robot), camera
        self.scale = _scale(log, self.topic)

    def read(self, record: Record) -> NDArray[np.float32]:
        return _depth_image(record, self.scale, self.camera)


class OtherCamera:
    """Depth images of a camera of its own, registered by its calibration and its pose in the colour camera."""

    def __init__(self, log: LogFile, robot: str, camera: PinholeCamera) -> None:
        self.topic, self.camera = topic_table.RAW_DEPTH.of(robot), camera
        self.scale = _scale(log, self.topic)
        calibration = topic_table.RAW_DEPTH_CALIBRATION.of(robot)
        self.depth_camera = constant(log, calibration, messages.unpack_calibration)
        transform = topic_table.RAW_DEPTH_TRANSFORM.of(robot)
        self.T_camera_depth = np.array(constant(log, transform, transform_rows))

    def read(self, record: Record) -> NDArray[np.float32]:
        depth_m = _depth_image(record, self.scale, self.depth_camera)
        return register_depth(depth_m, self.depth_camera, self.T_camera_depth, self.camera)


class Lidar:
    """Sweeps of a LiDAR, filled between their points."""

    scale = 1.0

    def __init__(self, log: LogFile, robot: str, camera: PinholeCamera) -> None:
        self.topic, self.camera = topic_table.LIDAR.of(robot), camera
        transform = topic_table.LIDAR_TRANSFORM.of(robot)
        self.T_camera_lidar = np.array(constant(log, transform, transform_rows))

    def read(self, record: Record) -> NDArray[np.float32]:
        points = messages.unpack_points(record.proto(), _where(record))
        R, t = self.T_camera_lidar[:3, :3], self.T_camera_lidar[:3, 3]
        return fill_between(points @ R.T + t, self.camera)


def constant(log: LogFile, topic: str, unpack: Callable[[Any], Value]) -> Value:
    """What every message of a topic says, which must be there and not change.

    Raises:
        DuagError: no message, one that cannot be read, or two that differ.
    """
    found: list[tuple[int, Value]] = []
    for entry in log.entries(topic):
        record = log.record_at(topic, entry)
        try:
            found.append((record.log_time_ns, unpack(record.proto())))
        except DuagError as error:
            raise DuagError(f"{log.path}: {topic}: {error}") from error
    if not found:
        raise DuagError(f"{log.path}: {topic} has no message, expected what the images need to be understood")
    for time, value in found:
        if value != found[0][1]:
            raise DuagError(f"{log.path}: {topic} changes at {time} ns to {value}, expected {found[0][1]}")
    return found[0][1]


def transform_rows(message: Any) -> tuple[tuple[float, ...], ...]:
    """Rows of a transform: unlike arrays they can be compared as a whole."""
    return tuple(tuple(row) for row in messages.unpack_transform(message).tolist())


def _scale(log: LogFile, topic: str) -> float:
    text = log.channels[topic].metadata.get(DEPTH_SCALE_KEY)
    try:
        scale = float(text or "missing")
    except ValueError:
        scale = math.nan
    if not (math.isfinite(scale) and scale > 0):
        where = f"{log.path}: {topic}: channel metadata {DEPTH_SCALE_KEY}"
        raise DuagError(f"{where} is {text!r}, expected metres per unit, for example '0.001'")
    return scale


def _where(record: Record) -> str:
    return f"{record.path}: {record.topic} at {record.publish_time_ns} ns"


def _depth_image(record: Record, scale: float, camera: PinholeCamera) -> NDArray[np.float32]:
    raw = messages.unpack_depth(record.proto(), _where(record))
    check_size(record, raw.shape[1], raw.shape[0], camera)
    return raw.astype(np.float32) * np.float32(scale)


def check_size(record: Record, width: int, height: int, camera: PinholeCamera) -> None:
    """Refuse an image that does not have the size of its calibration."""
    if (width, height) != (camera.width, camera.height):
        raise DuagError(
            f"{_where(record)} is {width}x{height}, "
            f"expected {camera.width}x{camera.height} as in the calibration"
        )
