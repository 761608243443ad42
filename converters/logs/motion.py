"""How a robot moved, by what its log holds besides images: poses of a body, transforms that change, an IMU."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.tum_layout import Poses
from duagc.converters.logs.entries import Entry, sound_time
from duagc.converters.logs.files import Log
from duagc.converters.logs.frames import (
    TF_TYPES,
    Transforms,
    Unsound,
    body_axes_of_camera,
    frame_name,
    transforms_in,
)
from duagc.converters.logs.options import LogOptions
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError, closest
from duagc.pipeline.geometry import se3
from duagc.pipeline.messages.parts import NANOSECONDS
from duagc.pipeline.recording.motion import GyroPrior, MotionPrior, OdometryPrior

POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
IMU_TYPE = "sensor_msgs/msg/Imu"


@dataclass(frozen=True)
class Imu:
    """stamps_ns int64 [n], increasing; values [n, 6]: rad/s and m/s^2 in its own axes; T_color_imu [4, 4]."""

    stamps_ns: NDArray[np.int64]
    values: Array
    T_color_imu: Array

    def prior(self) -> MotionPrior:
        """How the color camera turned."""
        return GyroPrior(self.stamps_ns.tolist(), self.values[:, :3] @ self.T_color_imu[:3, :3].T)


@dataclass(frozen=True)
class CameraPoses:
    """Poses of a body that holds the color camera: it is the body that moves evenly between two of them."""

    body: Poses
    T_body_color: Array

    def at(self, stamp_ns: int, max_gap_s: float) -> Array | None:
        """Pose T_world_color [4, 4] of the color camera at a time; None where there is none near.

        Args:
            stamp_ns: by the clock of the poses.
            max_gap_s: largest time between the two poses around it, seconds.
        """
        T = self.body.at(stamp_ns, max_gap_s)
        return None if T is None else T @ self.T_body_color

    def prior(self) -> MotionPrior:
        """How the color camera moved."""
        return OdometryPrior(self.body.stamps_ns.tolist(), self.body.T_world_body @ self.T_body_color)


class _ImuReadings:
    """What the messages of an IMU say, as they come."""

    def __init__(self, time_ns: Callable[[Entry], int]) -> None:
        self._time_ns = time_ns
        self.stamps, self.values, self.frame = array("q"), array("d"), ""

    def take(self, entry: Entry) -> None:
        m = entry.read()
        self.frame, w, a = m.header.frame_id, m.angular_velocity, m.linear_acceleration
        self.stamps.append(self._time_ns(entry))
        self.values.extend((w.x, w.y, w.z, a.x, a.y, a.z))


class _PoseReadings:
    """What messages say about the pose of a body, as they come; of a transform that changes: "/tf world base_link"."""

    def __init__(
        self, said: str, option: str, name: str, of_header: bool, *, time_ns: Callable[[Entry], int]
    ) -> None:
        self.option, self._name, self._of_header, self._time_ns = option, name, of_header, time_ns
        self.topic, *frames = said.split() if len(said.split()) == 3 else [said]
        self._frames = tuple(frame_name(f) for f in frames)
        self._seen: set[str] = set()
        self._stamps, self._poses, self._body = array("q"), array("d"), frames[1] if frames else ""
        self.world, self.unsound = frames[0] if frames else "", Unsound()

    def take(self, entry: Entry) -> None:
        if self._frames:
            self._take_transforms(entry)
            return
        m, where = entry.read(), f"{self._name}: {self.topic} at {entry.log_ns} ns"
        if hasattr(m, "transform"):
            position, orientation = m.transform.translation, m.transform.rotation
        else:
            pose = m.pose.pose if hasattr(m.pose, "pose") else m.pose
            position, orientation = pose.position, pose.orientation
        self._body, self.world = getattr(m, "child_frame_id", ""), m.header.frame_id
        if not np.isfinite([position.x, position.y, position.z]).all():
            return
        T = self.unsound.matrix(position, orientation, where, ("", ""))
        if T is not None:
            self._add(self._time_ns(entry), T)

    def _take_transforms(self, entry: Entry) -> None:
        for stamp, parent, child, T in transforms_in(entry, f"{self._name}: {self.topic}", self.unsound):
            self._seen.add(f"{parent} {child}")
            if (parent, child) == self._frames:
                self._add(sound_time(stamp, self.topic) if self._of_header else self._time_ns(entry), T)

    def _add(self, stamp_ns: int, T: Array) -> None:
        self._stamps.append(stamp_ns)
        self._poses.extend(T.ravel().tolist())

    def result(self) -> tuple[Poses, str]:
        """Poses in order of time, of equal times the last one, and the frame of the body."""
        if not self._stamps and (why := self.unsound.broken.get(self._frames or ("", ""))):  # type: ignore[arg-type]
            raise DuagError(why)
        if self._frames and not self._stamps:
            wanted = " ".join(self._frames)
            raise DuagError(
                f"{self._name}: {self.topic} has no {wanted}, {closest(wanted, sorted(self._seen), 'transforms')}"
            )
        backwards = np.array(self._stamps, dtype=np.int64)[::-1]
        stamps, last = np.unique(backwards, return_index=True)
        T = np.array(self._poses, dtype=np.float64).reshape(-1, 4, 4)[::-1][last]
        return Poses(stamps, T, 0), self._body


class MotionReader:
    """Topics of motion for one robot's color camera: `take` has who wants their messages, all to be given once."""

    def __init__(
        self,
        log: Log,
        settings: LogOptions,
        transforms: Transforms,
        color_frame: str,
        *,
        time_ns: Callable[[Entry], int],
    ) -> None:
        """Check the topics that are asked for, and read the file of true poses if there is one.

        Args:
            log: the log.
            settings: options of the converter.
            transforms: between frames of the log.
            color_frame: of the color camera.
            time_ns: the time of a message by the clock that the options choose.

        Raises:
            DuagError: a topic that was asked for is not there, or the file of true poses cannot be read.
        """
        self._log, self._settings, self._transforms = log, settings, transforms
        self.name, self.color_frame, self.warnings = log.name, color_frame, transforms.warnings
        self.take: list[tuple[str, Callable[[Entry], None]]] = []
        s = settings
        self._imu = self._odometry = self._truth = None
        if s.imu:
            self._check("imu", s.imu, log.of_type(IMU_TYPE), "an IMU")
            self._imu = _ImuReadings(time_ns)
            self.take.append((s.imu, self._imu.take))
        if s.odometry:
            self._odometry = self._poses(s.odometry, "odometry", time_ns)
        if s.truth and s.truth_file:
            raise DuagError(f"{self.name}: truth and truth_file are both said, expected one of them")
        self._truth_file = Poses.read(Path(s.truth_file)) if s.truth_file else None
        if s.truth:
            self._truth = self._poses(s.truth, "truth", time_ns)

    def _check(self, option: str, topic: str, known: list[str], what: str) -> None:
        if topic not in known:
            raise DuagError(f"{self.name}: {option} topic {topic} not found, {closest(topic, known, what)}")

    def _poses(self, said: str, option: str, time_ns: Callable[[Entry], int]) -> _PoseReadings:
        of_header = self._settings.time_source == "header"
        readings = _PoseReadings(said, option, self.name, of_header, time_ns=time_ns)
        types, what = (POSE_TYPES, "poses") if readings.topic == said else (TF_TYPES, "transforms")
        self._check(option, readings.topic, self._log.of_type(*types), what)
        self.take.append((readings.topic, readings.take))
        return readings

    def _body_camera(self, option: str, frame_in_log: str) -> Array:
        """T_body_color [4, 4] of the body of poses. option: truth or odometry. frame_in_log: of its messages."""
        setting = f"T_{option}_color"
        text = getattr(self._settings, setting)
        if text:
            return extrinsics_of(setting, text)
        if option == "odometry" and not frame_in_log:
            raise DuagError(
                f"{self.name}: messages of odometry name no body frame, expected --set {setting}='x y z qw qx qy qz'"
            )
        said = frame_name(self._settings.truth_frame) if option == "truth" else ""
        if not said and not frame_in_log:
            self.warnings.append(
                "true poses name no body: taken as those of the color camera, z forward; expected "
                f"truth_frame=camera if they are, else truth_frame=FRAME or {setting}='x y z qw qx qy qz'"
            )
        frame = said or frame_name(frame_in_log or self.color_frame)
        if said == "camera" or frame == frame_name(self.color_frame):
            return np.eye(4)
        T = self._transforms.lookup(frame, self.color_frame)
        if T is None:
            camera = " or truth_frame=camera if that is where it is" if option == "truth" else ""
            raise DuagError(
                f"{self.name}: {option} is of {frame!r}, and /tf_static does not tie it to {self.color_frame!r}; "
                f"expected --set {setting}='x y z qw qx qy qz'{camera}"
            )
        self.warnings += body_axes_of_camera(self.color_frame, frame, T, setting)
        return T

    def truth(self) -> CameraPoses | None:
        """True poses of the color camera, by a topic or a file; None if none were asked for."""
        if self._truth_file:
            found, body = self._truth_file, ""
        elif self._truth:
            found, body = self._truth.result()
            self.warnings += self._truth.unsound.words(self._truth.topic, "true poses")
        else:
            return None
        stamps = found.stamps_ns + round(self._settings.truth_offset_s * NANOSECONDS)
        return CameraPoses(replace(found, stamps_ns=stamps), self._body_camera("truth", body))

    @property
    def truth_world(self) -> str:
        """Frame in which the messages of true poses are; empty: not said."""
        return frame_name(self._truth.world) if self._truth else ""

    def odometry(self) -> CameraPoses | None:
        """Poses of the color camera by another odometry; None if none was asked for."""
        if not self._odometry:
            return None
        found, body = self._odometry.result()
        self.warnings += self._odometry.unsound.words(self._odometry.topic, "poses")
        return CameraPoses(found, self._body_camera("odometry", body))

    def imu(self) -> Imu | None:
        """What an IMU measured, in order of time; None if none was asked for."""
        if not self._imu:
            return None
        topic, frame = self._settings.imu, self._imu.frame
        times, first = np.unique(np.array(self._imu.stamps, dtype=np.int64), return_index=True)
        values = np.array(self._imu.values, dtype=np.float64).reshape(-1, 6)[first]
        sound = np.asarray(np.isfinite(values).all(axis=1))
        if len(values) and not sound.any():
            raise DuagError(
                f"{self.name}: {topic} holds no message of finite numbers, expected rad/s and m/s^2"
            )
        if not sound.all():
            at_s = times[np.argmin(sound)] / NANOSECONDS
            self.warnings.append(
                f"{topic}: {np.count_nonzero(~sound)} of {len(values)} messages hold numbers that are not finite, "
                f"the first at {at_s:.3f} s; left out"
            )
        times, values = times[sound], values[sound]
        if not len(values):
            self.warnings.append(f"{topic}: no message; left out")
            return None
        if not values[:, :3].any():
            self.warnings.append(
                f"{topic}: all turning rates are zero, as of an accelerometer alone; left out"
            )
            return None
        if self._settings.T_color_imu:
            T = extrinsics_of("T_color_imu", self._settings.T_color_imu)
        else:
            found = self._transforms.lookup(self.color_frame, frame)
            if found is None:
                raise DuagError(
                    f"{self.name}: {topic} is of {frame!r}, and /tf_static does not tie it to "
                    f"{self.color_frame!r}; expected --set T_color_imu='x y z qw qx qy qz'"
                )
            T = found
            self.warnings += body_axes_of_camera(self.color_frame, frame, T, "T_color_imu")
        return Imu(times, values, T)


def extrinsics_of(option: str, text: str) -> Array:
    """Matrix [4, 4] of "x y z qw qx qy qz" (m), the value of an option.

    Args:
        option: its name, for the error.
        text: its value: meters, and a quaternion wxyz of unit length.

    Raises:
        DuagError: the text is not seven such numbers.
    """
    try:
        x, y, z, *q = np.array(text.split(), dtype=np.float64).tolist()
        if len(q) != 4 or not np.isfinite([x, y, z]).all() or abs(np.linalg.norm(q) - 1) > 0.01:
            raise ValueError("no rigid motion")
    except ValueError as error:
        raise DuagError(f"ros: {option} = {text!r}, expected 'x y z qw qx qy qz'") from error
    return np.asarray(se3.from_quat_translation(np.array(q), np.array([x, y, z])))
