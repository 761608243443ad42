"""Where the depth of a frame comes from: the color camera's own, another camera's, or a LiDAR's."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline import messages
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.recording.depth_steps import COARSE_PER_M, inverse_step_per_m, without_steps
from duagc.pipeline.recording.lidar import lidar_depth
from duagc.pipeline.recording.names import DEPTH_SCALE_KEY, RANGE_SIGMA_KEY
from duagc.pipeline.recording.pairing import pair_topics
from duagc.pipeline.recording.read import LogFile, Record
from duagc.pipeline.recording.register_depth import register_depth
from duagc.pipeline.recording.sparse_depth import between_pixels, is_sparse
from duagc.schemas import topics as topic_table

Value = TypeVar("Value")

SOME_IMAGES = 5
"""Depth images, spread over the log, that say whether a sensor measures in steps, or in few pixels."""


@dataclass(frozen=True)
class DepthImage:
    """Depth [h, w], meters along z of the color camera, 0 = unknown, and its standard deviation where the log has it.

    sigma_m: [h, w], meters, 0 where the depth is unknown; None: the log does not have the sensor's noise.
    """

    depth_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32] | None = None


class DepthSource(Protocol):
    """One topic of a log, read as depth images of the color camera. scale: meters per unit of the source."""

    topic: str
    scale: float

    def read(self, record: Record) -> DepthImage:
        """The depth image of a message.

        Args:
            record: of the source's topic.

        Raises:
            DuagError: the message cannot be read, or does not have the size of its calibration.
        """
        ...


def depth_source(log: LogFile, robot: str, camera: PinholeCamera) -> DepthSource:
    """The best source that the log has: registered depth, then another camera's, then a LiDAR's.

    Args:
        log: of the robot.
        robot: whose topics are read.
        camera: the color camera, whose pixels the depth images have.

    Raises:
        DuagError: no source has a message, or what its images need to be understood is missing or changes.
    """
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
    """Depth images that are registered to color, and those of their standard deviation if there are any."""

    def __init__(self, log: LogFile, robot: str, camera: PinholeCamera) -> None:
        """Read the scale, meters per unit, and how coarse the depth is.

        Args:
            log: of the robot.
            robot: whose topics are read.
            camera: the color camera.

        Raises:
            DuagError: the channel states no usable scale.
        """
        self.topic, self.camera = topic_table.DEPTH.of(robot), camera
        self.scale = _meters(log, self.topic, DEPTH_SCALE_KEY)
        self._surfaces = _Surfaces(log, self.topic, self.scale, camera, robot=robot)
        self._log, self._sigma_topic = log, topic_table.DEPTH_SIGMA.of(robot)
        self._sigma_at = log.entries_by_time(self._sigma_topic)
        if self._sigma_at:
            self._sigma_scale = _meters(log, self._sigma_topic, DEPTH_SCALE_KEY)

    def read(self, record: Record) -> DepthImage:
        """The depth image of a message, with its standard deviation if the log has it.

        Args:
            record: of the topic `depth`.

        Raises:
            DuagError: the message cannot be read, has another size, or lacks the image of its standard
                deviation.
        """
        depth_m = self._surfaces.of(_depth_image(record, self.scale, self.camera))
        if not self._sigma_at:
            return DepthImage(depth_m)
        entry = self._sigma_at.get(record.publish_time_ns)
        if entry is None:
            raise DuagError(
                f"{_where(record)} has no image on {self._sigma_topic}, expected one for each depth image"
            )
        sigma_m = _depth_image(self._log.record_at(self._sigma_topic, entry), self._sigma_scale, self.camera)
        known = (depth_m > 0) & (sigma_m > 0)  # a depth without sigma is unknown
        return DepthImage(np.where(known, depth_m, np.float32(0)), np.where(known, sigma_m, np.float32(0)))


class OtherCamera:
    """Depth images of a camera of its own, registered by its calibration and its pose in the color camera."""

    def __init__(self, log: LogFile, robot: str, camera: PinholeCamera) -> None:
        """Read the scale, the calibration of the depth camera and its pose.

        Args:
            log: of the robot.
            robot: whose topics are read.
            camera: the color camera.

        Raises:
            DuagError: scale, calibration or pose is missing, cannot be read, or changes.
        """
        self.topic, self.camera = topic_table.RAW_DEPTH.of(robot), camera
        self.scale = _meters(log, self.topic, DEPTH_SCALE_KEY)
        calibration = topic_table.RAW_DEPTH_CALIBRATION.of(robot)
        self.depth_camera = constant(log, calibration, messages.unpack_calibration)
        transform = topic_table.RAW_DEPTH_TRANSFORM.of(robot)
        self.T_camera_depth = np.array(constant(log, transform, transform_rows))
        self._surfaces = _Surfaces(log, self.topic, self.scale, self.depth_camera, robot=robot)

    def read(self, record: Record) -> DepthImage:
        """The depth image of a message, moved into the color camera.

        Args:
            record: of the topic of the depth camera.

        Raises:
            DuagError: the message cannot be read, or has another size than the depth camera.
        """
        depth_m = self._surfaces.of(_depth_image(record, self.scale, self.depth_camera))
        return DepthImage(register_depth(depth_m, self.depth_camera, self.T_camera_depth, self.camera))


class Lidar:
    """Sweeps of a LiDAR, filled between their points; with sigma if the log has the noise of its ranges."""

    scale = 1.0

    def __init__(self, log: LogFile, robot: str, camera: PinholeCamera) -> None:
        """Read the pose of the LiDAR and, if it is stated, the noise of its ranges.

        Args:
            log: of the robot.
            robot: whose topics are read.
            camera: the color camera.

        Raises:
            DuagError: the pose is missing, cannot be read, or changes; or the noise is no length.
        """
        self.topic, self.camera = topic_table.LIDAR.of(robot), camera
        transform = topic_table.LIDAR_TRANSFORM.of(robot)
        self.T_camera_lidar = np.array(constant(log, transform, transform_rows))
        known = RANGE_SIGMA_KEY in log.channels[self.topic].metadata
        self._range_sigma_m = _meters(log, self.topic, RANGE_SIGMA_KEY) if known else None

    def read(self, record: Record) -> DepthImage:
        """The depth image of a sweep, filled between its points.

        Args:
            record: of the topic of the LiDAR.

        Raises:
            DuagError: the message cannot be read.
        """
        points = messages.unpack_points(record.proto(), _where(record))
        range_sigma_m = self._range_sigma_m or 0.0
        depth_m, sigma_m = lidar_depth(points, self.T_camera_lidar, self.camera, range_sigma_m)
        return DepthImage(depth_m, sigma_m if range_sigma_m else None)


class _Surfaces:
    """Makes surfaces of the depth images of a topic where they are steps or single pixels, as some of them are."""

    def __init__(self, log: LogFile, topic: str, scale: float, camera: PinholeCamera, *, robot: str) -> None:
        self._log, self._topic, self._color_topic = log, topic, topic_table.COLOR.of(robot)
        self._scale, self._camera = scale, camera

    @cached_property
    def _kind(self) -> tuple[bool, float]:
        """Whether single pixels are known; and the step of inverse depth, 1/m."""
        at = self._log.entries_by_time(self._topic)
        frames = pair_topics(self._log, self._color_topic, self._topic).pairs
        held_out = {depth for index, (_, depth) in enumerate(frames) if is_held_out(index)}
        mapped = [entry for stamp, entry in sorted(at.items()) if stamp not in held_out]
        some = [mapped[k] for k in evenly_spaced(len(mapped), min(SOME_IMAGES, len(mapped)))]
        records = [self._log.record_at(self._topic, entry) for entry in some]
        depths_m = [_depth_image(r, self._scale, self._camera) for r in records]
        sparse = 2 * sum(is_sparse(depth_m) for depth_m in depths_m) > len(depths_m)
        return sparse, inverse_step_per_m(depths_m, self._scale)

    def of(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """A depth image as it is, or without steps if they are coarse, and known between single pixels.

        Args:
            depth_m: as it was read.
        """
        sparse, step_per_m = self._kind
        if sparse:
            return between_pixels(depth_m, self._camera)
        return without_steps(depth_m, step_per_m) if step_per_m >= COARSE_PER_M else depth_m


def constant(log: LogFile, topic: str, unpack: Callable[[Any], Value]) -> Value:
    """What every message of a topic says, which must be there and not change.

    Args:
        log: that is read.
        topic: full name.
        unpack: value of a protobuf message; values are compared with !=.

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
    """Rows of a transform: unlike arrays they can be compared as a whole.

    Args:
        message: foxglove.FrameTransform.

    Raises:
        DuagError: numbers that are not finite, or a quaternion of no length.
    """
    return tuple(tuple(row) for row in messages.unpack_transform(message).tolist())


def _meters(log: LogFile, topic: str, key: str) -> float:
    """A length in the metadata of a channel."""
    text = log.channels[topic].metadata.get(key)
    try:
        scale = float(text or "missing")
    except ValueError:
        scale = math.nan
    if not (math.isfinite(scale) and scale > 0):
        where = f"{log.path}: {topic}: channel metadata {key}"
        raise DuagError(f"{where} is {text!r}, expected meters, for example '0.001'")
    return scale


def _where(record: Record) -> str:
    return f"{record.path}: {record.topic} at {record.publish_time_ns} ns"


def _depth_image(record: Record, scale: float, camera: PinholeCamera) -> NDArray[np.float32]:
    raw = messages.unpack_depth(record.proto(), _where(record))
    check_size(record, raw.shape[1], raw.shape[0], camera)
    return raw.astype(np.float32) * np.float32(scale)


def check_size(record: Record, width: int, height: int, camera: PinholeCamera) -> None:
    """Refuse an image that does not have the size of its calibration.

    Args:
        record: the image, for the line of the error.
        width: of the image, pixels.
        height: of the image, pixels.
        camera: of the calibration.

    Raises:
        DuagError: the sizes differ.
    """
    if (width, height) != (camera.width, camera.height):
        raise DuagError(
            f"{_where(record)} is {width}x{height}, "
            f"expected {camera.width}x{camera.height} as in the calibration"
        )
