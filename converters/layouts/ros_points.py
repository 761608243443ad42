"""PointCloud2 as ROS messages hold it: points, the time of each, and all of them as of one time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from duagc.converters.layouts.ros_images import UnusableImage
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.messages.parts import NANOSECONDS
from duagc.pipeline.recording.motion import MotionPrior

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
_TIMES = {  # fields of times, and seconds per unit if their name says it
    "time": 1.0,  # Velodyne
    "t": 1e-9,  # Ouster
    "offset_time": 1e-9,  # Livox
    "time_offset": 1e-9,
    "time_offset_ns": 1e-9,
    "timestamp": None,  # Hesai, RoboSense: s; Livox: ns
    "time_stamp": None,
}
_UNITS = {1.0: "s", 1e-3: "ms", 1e-6: "us", 1e-9: "ns"}
FARTHEST_M, LONGEST_S = 1e4, 10.0  # no point is farther away, no sweep longer
MOMENT_NS = 2_000_000  # points no further apart in time are moved together
LEAST_PERIOD_S, USUAL_PERIOD_S, MOST_PERIOD_S = 1e-3, 0.1, 0.2  # between sweeps, unless some were left out
LEAST_SHARE, MOST_SHARE = 0.02, 20.0  # of the period, that a sweep takes: one unit is between them
LEAST_SOUND = 0.6  # of the points of a sweep, whose times are near its stamp


class UnusableSweep(UnusableImage):
    """A sweep of a log is cut short; others of its topic may be sound."""


@dataclass(frozen=True)
class PointTimes:
    """How the points of a topic say when each of them was measured.

    Attributes:
        field: that says it; empty: none does, and points are of the time of their message.
        unit_s: seconds per unit.
        absolute: by the clock of the stamps; else after the stamp of the message.
        words: what to warn of, of the topic; empty: nothing.
    """

    field: str = ""
    unit_s: float = 1.0
    absolute: bool = False
    words: str = ""

    @staticmethod
    def found(messages: Sequence[Any], where: str) -> PointTimes:
        """Whatever makes sweeps as long as what is between them.

        Drivers give one name to several units. A sweep takes about as long as until the next one comes, and is not far
        from its stamp.

        Args:
            messages: some sweeps in order of recording, at least one; those that are cut short do not count.
            where: begins the line of an error.
        Raises:
            UnusableSweep: all are cut short.
        """
        rows, broken = list[_Rows](), list[UnusableSweep]()
        for message in messages:
            try:
                rows.append(_Rows(message, where))
            except UnusableSweep as error:
                broken.append(error)
        if broken and not rows:
            raise broken[0]
        period_s = _period_s(messages)
        names = [name for name in _TIMES if all(name in row.fields for row in rows)]
        known = [
            (name, [(row.column(name)[row.points_sound()[1]], row.stamp) for row in rows]) for name in names
        ]
        for name, times in known:
            fits = [
                (off_s, length_s, PointTimes(name, unit_s, absolute))
                for absolute in (False, True)
                for unit_s in _UNITS
                if (fit := _fit(PointTimes(name, unit_s, absolute), times, period_s))
                for off_s, length_s in [fit]
            ]
            if not fits:
                continue
            _, length_s, best = min(fits, key=lambda fit: fit[0])
            expected = _TIMES[name]
            if expected is None or (best.unit_s == expected and not best.absolute):
                return best
            taken = f"{_UNITS[best.unit_s]} {'of the clock' if best.absolute else 'after the stamp'}"
            words = (
                f"field {name} is taken in {taken}, as sweeps of {length_s:.3f} s every {period_s:.3f} s "
                f"have it; expected {_UNITS[expected]} after the stamp"
            )
            return PointTimes(name, best.unit_s, best.absolute, words)
        return PointTimes(words=_unknown_words(known, period_s))

    def seconds(self, values: Array, stamp: Any) -> Array:
        """Seconds after the stamp of a message, of what the field of its points says.

        Args:
            values: of the field, [n].
            stamp: of the message, fields sec and nanosec.
        """
        if not self.absolute:
            return values * self.unit_s
        per_s = round(1 / self.unit_s)
        return (values - int(stamp.sec) * per_s - int(stamp.nanosec) * per_s / NANOSECONDS) * self.unit_s


VELODYNE = PointTimes("time")


def _period_s(messages: Sequence[Any]) -> float:
    """Time between sweeps, by their stamps."""
    stamps = [m.header.stamp for m in messages]
    steps = np.diff(np.unique([int(s.sec) * NANOSECONDS + int(s.nanosec) for s in stamps]))
    period_s = float(np.median(steps)) / NANOSECONDS if len(steps) else USUAL_PERIOD_S
    return min(max(period_s, LEAST_PERIOD_S), MOST_PERIOD_S)


def _fit(
    times: PointTimes, sweeps: Sequence[tuple[Array, Any]], period_s: float
) -> tuple[float, float] | None:
    """How far from the stamps points are, s, and how long sweeps are, s; None if they cannot be so."""
    shares, lengths, offsets = [], [], []
    for values, stamp in sweeps:
        with np.errstate(over="ignore"):
            seconds = times.seconds(values[np.isfinite(values)], stamp)
        near = seconds[np.abs(seconds) < MOST_SHARE * period_s]
        shares.append(len(near) / max(1, len(seconds)))
        lengths.append(float(np.ptp(near)) if len(near) else 0.0)
        offsets.append(float(np.median(np.abs(near))) if len(near) else 0.0)
    length_s = float(np.median(lengths))
    if np.median(shares) < LEAST_SOUND or not LEAST_SHARE <= length_s / period_s < MOST_SHARE:
        return None
    return float(np.median(offsets)), length_s


def _unknown_words(known: Sequence[tuple[str, Sequence[tuple[Array, Any]]]], period_s: float) -> str:
    """What to say of sweeps whose times of points are not known."""
    blurred = "sweeps hold what the LiDAR moved meanwhile"
    for name, sweeps in known:
        values = np.concatenate([values[np.isfinite(values)] for values, _ in sweeps])
        if not len(values) or values.min() == values.max():
            continue
        stamp = sweeps[0][1]
        return (
            f"{blurred}: field {name} goes from {values.min():.16g} to {values.max():.16g} with stamps from "
            f"{int(stamp.sec)}.{int(stamp.nanosec):09d} s and sweeps every {period_s:.3f} s; expected s, ms, us or ns "
            "after the stamp or of its clock"
        )
    return f"{blurred}: its points have no times, expected a field {', '.join(_TIMES)}"


class _Rows:
    """The points of a message, as bytes [n, step]."""

    def __init__(self, message: Any, where: str) -> None:
        self.fields = {field.name: field for field in message.fields}
        self.stamp, self._where = message.header.stamp, where
        self._is_big = bool(message.is_bigendian)
        step, width, height = int(message.point_step), int(message.width), int(message.height)
        used = step * width
        row = int(message.row_step) or used
        # the last row may come without its padding
        size = max(row, used) * (height - 1) + used if height > 0 else 0
        data = np.frombuffer(bytes(message.data), np.uint8)
        missing = [name for name in "xyz" if name not in self.fields]
        if missing or step < 1 or row < used or len(data) < size:
            kind = UnusableSweep if not missing and step > 0 and row >= used else DuagError
            raise kind(
                f"{where} has fields {sorted(self.fields)} and {len(data)} bytes for {width}x{height} points "
                f"of {step}, expected x, y, z and {size} bytes"
            )
        of_points = as_strided(data, (height, used), (row, 1), writeable=False)
        self._bytes, self._step = np.ascontiguousarray(of_points).reshape(-1, step), step

    def column(self, name: str) -> Array:
        """A field of all points, [n]."""
        field = self.fields[name]
        kind = np.dtype(_TYPES.get(field.datatype, "V0")).newbyteorder(">" if self._is_big else "<")
        if kind.itemsize == 0 or field.offset + kind.itemsize > self._step:
            raise DuagError(
                f"{self._where}: field {name} has type {field.datatype} at byte {field.offset} of {self._step}, "
                "expected a number within the point"
            )
        part = np.ascontiguousarray(self._bytes[:, field.offset : field.offset + kind.itemsize])
        return part.view(kind)[:, 0].astype(float)

    def points_sound(self) -> tuple[Array, NDArray[np.bool_]]:
        """All points [n, 3], and which of them were measured."""
        points = np.stack([self.column(name) for name in "xyz"], axis=-1)
        with np.errstate(invalid="ignore"):
            sound = (np.abs(points) < FARTHEST_M).all(axis=1)
        return points, sound & (points != 0).any(axis=1)  # else nothing came back


def points_of(message: Any, where: str, times: PointTimes | None = None) -> tuple[Array, Array]:
    """Points [n, 3] in meters, frame of the message, and when each was measured, s after its stamp; all finite.

    Args:
        message: a sweep.
        where: begins the line of an error.
        times: how its points say when they were measured; None: found by this sweep alone.
    """
    rows = _Rows(message, where)
    points, sound = rows.points_sound()
    times = times or PointTimes.found([message], where)
    if times.field not in rows.fields:
        return points[sound], np.zeros(int(sound.sum()))
    with np.errstate(invalid="ignore", over="ignore"):
        seconds = times.seconds(rows.column(times.field), rows.stamp)
        sound &= np.abs(seconds) < LONGEST_S
    return points[sound], seconds[sound]


def as_of(
    at_ns: int,
    points_lidar: Array,
    times_ns: NDArray[np.int64],
    T_camera_lidar: Array,
    *,
    motion: MotionPrior | None,
) -> Array:
    """Points of a moving LiDAR, each measured at its time, as it would see them all at one time, [n, 3].

    Args:
        at_ns: that time.
        points_lidar: [n, 3], meters, LiDAR frame.
        times_ns: when each was measured, [n].
        T_camera_lidar: [4, 4].
        motion: of the camera; without it, or where it does not reach, points stay as they are.
    """
    if motion is None or not len(points_lidar):
        return points_lidar
    moments = np.floor_divide(times_ns - at_ns, MOMENT_NS)
    moved = points_lidar.copy()
    for moment in np.unique(moments):
        then_ns = at_ns + int(moment) * MOMENT_NS + MOMENT_NS // 2
        known = motion.between(min(at_ns, then_ns), max(at_ns, then_ns))
        if known is None:
            continue
        T_at_then = known.T_start_stop if then_ns > at_ns else se3.inverse(known.T_start_stop)
        T = se3.inverse(T_camera_lidar) @ T_at_then @ T_camera_lidar
        now = moments == moment
        moved[now] = se3.transform(T, points_lidar[now])
    return moved
