"""How a camera moved between two times by sensors other than itself: an odometry, or the gyroscope of an IMU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline import messages
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.recording.depth_sources import constant, transform_rows
from duagc.pipeline.recording.gyro_calibration import GyroCorrection
from duagc.pipeline.recording.read import LogFile
from duagc.schemas import topics as topic_table

LONGEST_POSE_GAP_NS = 250_000_000
LONGEST_RATE_GAP_NS = 50_000_000


@dataclass(frozen=True)
class Motion:
    """T_start_stop [4, 4] of the camera. knows_translation: False if only its rotation means anything."""

    T_start_stop: Array
    knows_translation: bool


class MotionPrior(Protocol):
    """Says how the camera moved."""

    def between(self, start_ns: int, stop_ns: int) -> Motion | None:
        """The motion from one time to a later one; None where the sensor does not reach or has a gap.

        Args:
            start_ns: time of the first pose, ns.
            stop_ns: time of the second pose, ns, not earlier.
        """
        ...


class OdometryPrior:
    """Poses of the camera by another odometry, in a frame of its own, interpolated between its messages."""

    def __init__(self, stamps_ns: Sequence[int], T_odometry_camera: Array) -> None:
        """Keep the poses between which motions are interpolated.

        Args:
            stamps_ns: increasing.
            T_odometry_camera: [n, 4, 4].
        """
        self.stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        self.T_odometry_camera = np.asarray(T_odometry_camera, dtype=np.float64)

    def between(self, start_ns: int, stop_ns: int) -> Motion | None:
        """The motion between two times, interpolated; None where the messages do not reach or have a gap.

        Args:
            start_ns: time of the first pose, ns.
            stop_ns: time of the second pose, ns, not earlier.
        """
        start, stop = self._at(start_ns), self._at(stop_ns)
        if start is None or stop is None:
            return None
        return Motion(se3.inverse(start) @ stop, knows_translation=True)

    def _at(self, time_ns: int) -> Array | None:
        after = int(np.searchsorted(self.stamps_ns, time_ns))
        if after < len(self.stamps_ns) and self.stamps_ns[after] == time_ns:
            return np.asarray(self.T_odometry_camera[after])
        if after in (0, len(self.stamps_ns)):
            return None
        first, last = int(self.stamps_ns[after - 1]), int(self.stamps_ns[after])
        if last - first > LONGEST_POSE_GAP_NS:
            return None
        T_first, T_last = self.T_odometry_camera[after - 1], self.T_odometry_camera[after]
        share = (time_ns - first) / (last - first)
        return np.asarray(T_first @ se3.exp(share * se3.log(se3.inverse(T_first) @ T_last)))


class GyroPrior:
    """Rotation by the integrated rates of a gyroscope; a rate holds from the middle before it to the middle after."""

    def __init__(self, stamps_ns: Sequence[int], rates_camera: Array) -> None:
        """Keep the rates that are integrated to rotations.

        Args:
            stamps_ns: increasing.
            rates_camera: [n, 3], rad/s, about the axes of the camera.
        """
        self.stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        self.rates_camera = np.asarray(rates_camera, dtype=np.float64)

    def between(self, start_ns: int, stop_ns: int) -> Motion | None:
        """The rotation between two times; None where the rates do not reach or have a gap.

        Args:
            start_ns: time of the first pose, ns.
            stop_ns: time of the second pose, ns, not earlier.
        """
        if (used := self._used(start_ns, stop_ns)) is None:
            return None
        edges, R = self._edges(used, start_ns, stop_ns), np.eye(3)
        for rate, seconds in zip(self.rates_camera[used], np.diff(edges) * 1e-9, strict=True):
            R = R @ so3.exp(rate * seconds)
        return Motion(se3.from_rotation_translation(R, np.zeros(3)), knows_translation=False)

    def turns(self, start_ns: int, times_ns: NDArray[np.int64], correction: GyroCorrection) -> Array | None:
        """Rotations R_start_then [n, 3, 3] to some times; None where the rates do not reach or have a gap.

        Args:
            start_ns: from which they are.
            times_ns: [n], before it or after it.
            correction: of the rates.
        """
        first_ns, last_ns = min(start_ns, int(times_ns.min())), max(start_ns, int(times_ns.max()))
        if (used := self._used(first_ns, last_ns)) is None:
            return None
        rates = self.rates_camera[used] @ correction.R_camera_gyro.T - correction.bias_rad_s
        edges = self._edges(used, first_ns, last_ns)
        steps = so3.exp(rates * (1e-9 * np.diff(edges))[:, None])
        R_first_edge = np.array(list(accumulate(steps[:-1], np.matmul, initial=np.eye(3))))
        times = np.append(times_ns, start_ns)
        at = np.searchsorted(edges[1:-1], times, side="right")
        R = R_first_edge[at] @ so3.exp(rates[at] * (1e-9 * (times - edges[at]))[:, None])
        return np.asarray(R[-1].T @ R[:-1])

    def _used(self, start_ns: int, stop_ns: int) -> slice | None:
        """The rates from the last one at or before a time to the first one at or after another."""
        stamps = self.stamps_ns
        if len(stamps) < 2 or start_ns < stamps[0] or stop_ns > stamps[-1]:
            return None
        first, last = np.searchsorted(stamps, start_ns, side="right") - 1, np.searchsorted(stamps, stop_ns)
        used = slice(int(first), int(last) + 1)
        return None if np.any(np.diff(stamps[used]) > LONGEST_RATE_GAP_NS) else used

    def _edges(self, used: slice, start_ns: int, stop_ns: int) -> NDArray[np.int64]:
        """Times [rates + 1] between which rates hold."""
        middles = (self.stamps_ns[used][:-1] + self.stamps_ns[used][1:]) // 2
        return np.clip(np.concatenate([[start_ns], middles, [stop_ns]]), start_ns, stop_ns)


def motion_prior(log: LogFile, robot: str) -> MotionPrior | None:
    """The best prior that a log has: an odometry, then an IMU; None if it has neither.

    Args:
        log: of the robot.
        robot: whose topics are read.

    Raises:
        DuagError: a message that cannot be read, or an IMU without its pose in the camera.
    """
    topic = topic_table.ODOMETRY_PRIOR.of(robot)
    if log.entries(topic):
        at = log.entries_by_time(topic)
        times = sorted(at)
        poses = []
        for time in times:
            try:
                poses.append(messages.unpack_pose_in_frame(log.record_at(topic, at[time]).proto()))
            except DuagError as error:
                raise DuagError(f"{log.path}: {topic} at {time} ns: {error}") from error
        return OdometryPrior(times, np.array(poses))
    return gyro_prior(log, robot)


def gyro_prior(log: LogFile, robot: str) -> GyroPrior | None:
    """The gyroscope of a log's IMU; None if it has none.

    Args:
        log: of the robot.
        robot: whose topics are read.

    Raises:
        DuagError: a message that cannot be read, or an IMU without its pose in the camera.
    """
    topic = topic_table.IMU.of(robot)
    if not log.entries(topic):
        return None
    rows = constant(log, topic_table.IMU_TRANSFORM.of(robot), transform_rows)
    R_camera_imu = np.array(rows)[:3, :3]
    at = log.entries_by_time(topic)
    times = sorted(at)
    rates = []
    for time in times:
        rate = log.record_at(topic, at[time]).proto().angular_velocity
        rates.append([rate.x, rate.y, rate.z])
    if not np.all(np.isfinite(rates)):
        raise DuagError(f"{log.path}: {topic} has a rate that is not finite, expected rad/s")
    return GyroPrior(times, np.array(rates) @ R_camera_imu.T)
