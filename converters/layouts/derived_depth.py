"""Frames whose depth is not measured by a depth camera: images of a stereo pair, sweeps of a LiDAR."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.ros_images import UnusableImage, color_bytes
from duagc.converters.layouts.ros_points import PointTimes, as_of, points_of
from duagc.converters.layouts.row_check import RowCheck
from duagc.converters.layouts.stereo import StereoRig
from duagc.converters.logs.entries import Entry
from duagc.converters.robot_writer import RobotWriter
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import decode_image, encode_png
from duagc.pipeline.recording.greatest_depth import units_of_depth
from duagc.pipeline.recording.lidar import lidar_depth
from duagc.pipeline.recording.motion import GyroPrior, MotionPrior

Image = NDArray[np.uint8]
STEREO_SCALE_M = 0.002  # per unit of the depth images
ROW_PAIRS = 6  # image pairs whose rows are tested
RATIO_FRAMES = 12  # frames whose stereo depth is compared with the LiDAR's
IMPOSSIBLE = 1e3  # rad/s and m/s^2: no vehicle turns or falls so
MAX_RATIO_ERROR = 0.02


@dataclass(frozen=True)
class LidarSource:
    """A LiDAR next to a camera.

    Attributes:
        motion: of that camera, to take out what it moved during a sweep; None: not known.
        times: how its points say when they were measured.
    """

    T_camera_lidar: Array
    range_sigma_m: float
    motion: MotionPrior | None
    times: PointTimes

    def points(self, message: Any, stamp_ns: int, at_ns: int, where: str) -> Array:
        """Points [n, 3] of a sweep, meters, LiDAR frame, all as of one time.

        Args:
            message: a PointCloud2.
            stamp_ns: its time.
            at_ns: the time that the points are moved to.
            where: begins the line of an error.

        Raises:
            UnusableSweep: the message is cut short.
            DuagError: it holds no points that can be read.
        """
        points, seconds = points_of(message, where, self.times)
        times_ns = stamp_ns + np.rint(seconds * 1e9).astype(np.int64)
        return as_of(at_ns, points, times_ns, self.T_camera_lidar, motion=self.motion)


def decoded(message: Any, where: str) -> Image:
    """Color [h, w, 3], BGR as OpenCV has it, of an Image or CompressedImage.

    Args:
        message: an Image or CompressedImage.
        where: begins the line of an error.

    Raises:
        UnusableImage: no decoder reads it.
        DuagError: its encoding is none of color.
    """
    import cv2

    data, _ = color_bytes(message, where)
    image = decode_image(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise UnusableImage(f"{where}: {len(data)} bytes that no decoder reads, expected an image")
    return np.asarray(image, dtype=np.uint8)


class StereoFrames:
    """Rectified color, depth and sigma of the pairs of one rig."""

    def __init__(self, rig: StereoRig, size: tuple[int, int]) -> None:
        """Keep the calibration, and the size that images must have.

        Args:
            rig: the calibrated pair.
            size: width and height of the images as they come, pixels.
        """
        self.rig, self._size = rig, size

    def sized(self, image: Image, where: str) -> Image:
        """The image, if it has the size of the calibration.

        Args:
            image: [h, w, ...], as it came.
            where: begins the line of an error.

        Raises:
            DuagError: it has another size.
        """
        if (image.shape[1], image.shape[0]) != self._size:
            raise DuagError(
                f"{where} is {image.shape[1]}x{image.shape[0]}, expected {self._size[0]}x{self._size[1]} as in the "
                "calibration"
            )
        return image

    def rectified(self, left: Any, right: Any, where: str) -> tuple[Image, Image]:
        """Left and right messages as rectified BGR images, [h, w, 3].

        Args:
            left: message with the left image.
            right: message with the right image.
            where: begins the line of an error.

        Raises:
            UnusableImage: no decoder reads one of them.
            DuagError: one of them has another size than the calibration.
        """
        first, second = (self.sized(decoded(message, where), where) for message in (left, right))
        return self.rig.rectify_left(first), self.rig.rectify_right(second)

    def check_rows(self, pairs: Iterable[tuple[Any, Any]], where: str) -> dict[str, Any]:
        """The test of the rectification on some pairs of messages, broken ones left out; see `RowCheck`.

        Args:
            pairs: messages of the left and the right image.
            where: begins the line of an error.

        Raises:
            UnusableImage: all pairs are broken.
            DuagError: the rectification does not fit the images.
        """
        check, broken, sound = RowCheck(), list[UnusableImage](), 0
        for left, right in pairs:
            try:
                images = self.rectified(left, right, where)
            except UnusableImage as error:
                broken.append(error)
                continue
            check.add(*(gray(image) for image in images))
            sound += 1
        if broken and not sound:
            raise broken[0]
        return check.result(where)

    def frame(
        self, left: Any, right: Any, where: str
    ) -> tuple[bytes, NDArray[np.uint16], NDArray[np.float32]]:
        """PNG of the left image, depth in units of `STEREO_SCALE_M`, and its standard deviation (m), [h, w].

        Args:
            left: message with the left image.
            right: message with the right image.
            where: begins the line of an error.

        Raises:
            DuagError: as `rectified`.
        """
        color, other = self.rectified(left, right, where)
        depth_m, sigma_m = self.rig.depth(gray(color), gray(other))
        return encode_png(color), units_of_depth(depth_m, STEREO_SCALE_M)[0], sigma_m


def gray(image: Image) -> Image:
    """Gray values [h, w] of an image.

    Args:
        image: [h, w, 3], BGR.
    """
    import cv2

    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


class ScaleCheck:
    """Compares the depth of a stereo pair with that of a LiDAR: they need not know of each other's mistakes."""

    def __init__(self, lidar: LidarSource, rig: StereoRig) -> None:
        """Begin with no sweep compared.

        Args:
            lidar: sensor and where it is in the rectified left camera.
            rig: the pair.
        """
        self._lidar, self._rig = lidar, rig
        self._ratios: list[Array] = [np.zeros(0)]

    def add(self, points_lidar: Array, depth: NDArray[np.uint16]) -> None:
        """Take a sweep and the depth image of the same time.

        Args:
            points_lidar: [n, 3], meters, LiDAR frame.
            depth: of the pair, [h, w], in units of `STEREO_SCALE_M`, 0 = none.
        """
        sigma = self._lidar.range_sigma_m
        measured, sigma_m = lidar_depth(points_lidar, self._lidar.T_camera_lidar, self._rig.camera, sigma)
        both = (depth > 0) & (measured > 0) & (sigma_m < 2 * sigma)
        self._ratios.append(depth[both] * STEREO_SCALE_M / measured[both].astype(np.float64))

    def result(self) -> float | None:
        """Median of stereo depth over LiDAR depth; None where nothing was seen by both."""
        ratios = np.concatenate(self._ratios)
        return float(np.median(ratios)) if len(ratios) > 100 else None


def imu_readings(
    entries: Iterable[Entry], left_out: Callable[[Entry], AbstractContextManager[None]]
) -> list[tuple[int, Array, Array]]:
    """Time (ns), rates (rad/s) and accelerations (m/s^2) of IMU messages, in order of time, each time once.

    Args:
        entries: the messages, in any order; readings that are impossible are left out.
        left_out: given a message, leaves its block if the message is none.
    """
    found: dict[int, tuple[Array, Array]] = {}
    for entry in entries:
        with left_out(entry):
            stamp_ns, m = entry.header_ns(), entry.read()
            w, a = m.angular_velocity, m.linear_acceleration
            reading = np.array([w.x, w.y, w.z], dtype=float), np.array([a.x, a.y, a.z], dtype=float)
            if np.all(np.abs(reading) < IMPOSSIBLE):
                found.setdefault(stamp_ns, reading)
    return [(stamp, *found[stamp]) for stamp in sorted(found)]


def gyro(readings: Sequence[tuple[int, Array, Array]], T_camera_imu: Array) -> GyroPrior | None:
    """How the camera turned, by its IMU; None without readings.

    Args:
        readings: of `imu_readings`.
        T_camera_imu: [4, 4].
    """
    if not readings:
        return None
    rates = np.array([rates for _, rates, _ in readings])
    return GyroPrior([stamp for stamp, _, _ in readings], rates @ T_camera_imu[:3, :3].T)


class ImuFeed:
    """Writes IMU readings into a log up to the time of what comes next."""

    def __init__(self, robot: RobotWriter, readings: Sequence[tuple[int, Array, Array]]) -> None:
        """Begin before the first reading.

        Args:
            robot: into whose log they are written.
            readings: of `imu_readings`.
        """
        self._robot, self._readings, self._at = robot, readings, 0

    def until(self, stamp_ns: int) -> None:
        """Write what was read up to a time.

        Args:
            stamp_ns: this time included.
        """
        while self._at < len(self._readings) and self._readings[self._at][0] <= stamp_ns:
            self._robot.add_imu(*self._readings[self._at])
            self._at += 1


def spread(count: int, most: int) -> set[int]:
    """Up to so many indices, evenly spread over 0 .. count - 1.

    Args:
        count: of what is indexed.
        most: how many indices.
    """
    return set(np.linspace(0, count - 1, min(count, most)).astype(int).tolist())
