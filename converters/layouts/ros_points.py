"""PointCloud2 as ROS messages hold it: points, the time of each, and all of them as of one time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording.motion import MotionPrior

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
_TIMES = {
    "time": 1.0,
    "t": 1e-9,
    "offset_time": 1e-9,
    "time_offset": 1e-9,
}  # name of the field, seconds per unit
FARTHEST_M, LONGEST_S = 1e4, 10.0  # no point is farther away, no sweep longer
LARGEST_S, NANOSECONDS = 1e12, 1_000_000_000  # times above are in nanoseconds
MOMENT_NS = 2_000_000  # points no further apart in time are moved together


def points_of(message: Any, where: str) -> tuple[Array, Array]:
    """Points [n, 3] in meters, frame of the message, and when each was measured, s after its stamp; all finite.

    Without a field of times they are zero: `time` (s, Velodyne), `t` (ns, Ouster), `offset_time` (ns, Livox), or
    `timestamp` in float64, of the clock itself (s or ns; Livox, Hesai, RoboSense).
    """
    fields = {field.name: field for field in message.fields}
    step, width, height = int(message.point_step), int(message.width), int(message.height)
    row = int(message.row_step) or step * width
    missing = [name for name in "xyz" if name not in fields]
    data = np.frombuffer(bytes(message.data), np.uint8)
    if missing or step < 1 or row < step * width or len(data) < row * height:
        raise DuagError(
            f"{where} has fields {sorted(fields)} and {len(data)} bytes for {width}x{height} points "
            f"of {step}, expected x, y, z and {max(row, step * width) * height} bytes"
        )
    rows = np.ascontiguousarray(data[: row * height].reshape(height, row)[:, : step * width]).reshape(
        -1, step
    )

    def column(name: str) -> Array:
        field = fields[name]
        kind = np.dtype(_TYPES.get(field.datatype, "V0")).newbyteorder(">" if message.is_bigendian else "<")
        if kind.itemsize == 0 or field.offset + kind.itemsize > step:
            raise DuagError(
                f"{where}: field {name} has type {field.datatype} at byte {field.offset} of {step}, expected a number "
                "within the point"
            )
        return (
            np.ascontiguousarray(rows[:, field.offset : field.offset + kind.itemsize])
            .view(kind)[:, 0]
            .astype(float)
        )

    points = np.stack([column(name) for name in "xyz"], axis=-1)
    timed = next((name for name in _TIMES if name in fields), None)
    seconds = np.zeros(len(points)) if timed is None else column(timed) * _TIMES[timed]
    if timed is None and "timestamp" in fields and _TYPES.get(fields["timestamp"].datatype) == "f8":
        seconds = _after_stamp(column("timestamp"), message.header.stamp)
    with np.errstate(invalid="ignore"):
        sound = (np.abs(points) < FARTHEST_M).all(axis=1) & (np.abs(seconds) < LONGEST_S)
    sound &= (points != 0).any(axis=1)  # nothing came back
    return points[sound], seconds[sound]


def _after_stamp(times: Array, stamp: Any) -> Array:
    """Seconds after the stamp of a message, of times by its clock: seconds, or nanoseconds by their size.

    Times that are after the stamp already stay; those of another clock say nothing.
    """
    known = times[np.isfinite(times)]
    if not len(known):
        return np.zeros(len(times))
    if np.median(known) > LARGEST_S:
        seconds = (times - (int(stamp.sec) * NANOSECONDS + int(stamp.nanosec))) / NANOSECONDS
    else:
        seconds = (times - int(stamp.sec)) - int(stamp.nanosec) / NANOSECONDS
    for after in (seconds, times):
        if abs(np.median(after[np.isfinite(after)])) < LONGEST_S:
            return after
    return np.zeros(len(times))


def as_of(
    at_ns: int,
    points_lidar: Array,
    times_ns: NDArray[np.int64],
    T_camera_lidar: Array,
    *,
    motion: MotionPrior | None,
) -> Array:
    """Points [n, 3] of a moving LiDAR, each measured at its time [n], as it would see them all at one time.

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
