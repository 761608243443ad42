"""How a robot moved, by what its log holds besides images: poses of a body, transforms that change, an IMU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from converters.logs.files import NANOSECONDS, Entry, Log, sound_time
from converters.logs.frames import TF_TYPES, Transforms, frame_name, pose_matrix
from converters.logs.options import LogOptions
from converters.tum_layout import Poses
from pipeline.errors import DuagError, closest
from pipeline.geometry import se3
from pipeline.recording.motion import GyroPrior, MotionPrior, OdometryPrior

Array = NDArray[np.float64]
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
        """How the colour camera turned."""
        return GyroPrior(self.stamps_ns.tolist(), self.values[:, :3] @ self.T_color_imu[:3, :3].T)


@dataclass(frozen=True)
class CameraPoses:
    """Poses of a body that holds the colour camera: it is the body that moves evenly between two of them."""

    body: Poses
    T_body_color: Array

    def at(self, stamp_ns: int, max_gap_s: float) -> Array | None:
        """Pose [4, 4] of the colour camera at a time; None where there is none near."""
        T = self.body.at(stamp_ns, max_gap_s)
        return None if T is None else T @ self.T_body_color

    def prior(self) -> MotionPrior:
        """How the colour camera moved."""
        return OdometryPrior(self.body.stamps_ns.tolist(), self.body.T_world_body @ self.T_body_color)


class MotionReader:
    """Reads topics of motion for one robot's colour camera."""

    def __init__(
        self,
        log: Log,
        settings: LogOptions,
        transforms: Transforms,
        color_frame: str,
        time_ns: Callable[[Entry], int],
    ) -> None:
        """Args:
        color_frame: of the colour camera. time_ns: the time of a message by the clock that the options choose.
        """
        self._log, self._settings, self._transforms = log, settings, transforms
        self.name, self.color_frame, self._time_ns = log.name, color_frame, time_ns

    def _body_camera(self, option: str, told: str) -> Array:
        """T_body_color [4, 4] of the body that poses are of. option: truth or odometry. told: its frame in the log."""
        setting = f"T_{option}_color"
        text = getattr(self._settings, setting)
        if text:
            return extrinsics_of(setting, text)
        frame = frame_name(
            (self._settings.truth_frame if option == "truth" else "") or told or self.color_frame
        )
        if frame in ("camera", frame_name(self.color_frame)):
            return np.eye(4)
        T = self._transforms.lookup(frame, self.color_frame)
        if T is None:
            camera = " or truth_frame=camera if that is where it is" if option == "truth" else ""
            raise DuagError(
                f"{self.name}: {option} is of {frame!r}, and /tf_static does not tie it to {self.color_frame!r}; "
                f"expected --set {setting}='x y z qw qx qy qz'{camera}"
            )
        return T

    def truth(self) -> CameraPoses | None:
        """True poses of the colour camera, by a topic or a file; None if none were asked for."""
        s = self._settings
        if s.truth and s.truth_file:
            raise DuagError(f"{self.name}: truth and truth_file are both said, expected one of them")
        if s.truth_file:
            found = CameraPoses(Poses.read(Path(s.truth_file)), self._body_camera("truth", ""))
        elif s.truth:
            found = self.poses(s.truth, "truth")
        else:
            return None
        stamps = found.body.stamps_ns + round(s.truth_offset_s * NANOSECONDS)
        return replace(found, body=replace(found.body, stamps_ns=stamps))

    def poses(self, topic: str, option: str) -> CameraPoses:
        """Poses of the colour camera by a topic of poses of its body. option: truth or odometry."""
        if len(topic.split()) == 3:
            return self._poses_of_tf(topic.split(), option)
        known = self._log.of_type(*POSE_TYPES)
        if topic not in known:
            raise DuagError(
                f"{self.name}: {option} topic {topic} not found, {closest(topic, known, 'poses')}"
            )
        poses: dict[int, Array] = {}
        body = ""
        for entry in self._log.entries(topic):
            m, where = entry.read(), f"{self.name}: {topic} at {entry.log_ns} ns"
            if hasattr(m, "transform"):
                position, orientation = m.transform.translation, m.transform.rotation
            else:
                pose = m.pose.pose if hasattr(m.pose, "pose") else m.pose
                position, orientation = pose.position, pose.orientation
            body = getattr(m, "child_frame_id", "")
            if np.isfinite([position.x, position.y, position.z]).all():
                poses[self._time_ns(entry)] = pose_matrix(position, orientation, where)
        return self._camera_poses(poses, option, body)

    def _poses_of_tf(self, said: list[str], option: str) -> CameraPoses:
        """Poses of the colour camera by a transform that changes, "/tf world base_link"."""
        topic, parent, child = said
        known = self._log.of_type(*TF_TYPES)
        if topic not in known:
            raise DuagError(f"{self.name}: topic {topic} not found, {closest(topic, known, 'transforms')}")
        poses: dict[int, Array] = {}
        seen = set()
        of_header = self._settings.time_source == "header"
        for (entry, stamp), found_parent, found_child, T in self._transforms.of_topic(topic):
            seen.add(f"{found_parent} {found_child}")
            if (found_parent, found_child) == (frame_name(parent), frame_name(child)):
                poses[sound_time(stamp, topic) if of_header else self._time_ns(entry)] = T
        if not poses:
            wanted = f"{frame_name(parent)} {frame_name(child)}"
            raise DuagError(
                f"{self.name}: {topic} has no {wanted}, {closest(wanted, sorted(seen), 'transforms')}"
            )
        return self._camera_poses(poses, option, child)

    def _camera_poses(self, poses: dict[int, Array], option: str, body: str) -> CameraPoses:
        stamps = sorted(poses)
        T = np.array([poses[stamp] for stamp in stamps]).reshape(-1, 4, 4)
        return CameraPoses(Poses(np.array(stamps, dtype=np.int64), T, 0), self._body_camera(option, body))

    def imu(self, topic: str) -> Imu:
        """What an IMU measured, in order of time."""
        known = self._log.of_type(IMU_TYPE)
        if topic not in known:
            raise DuagError(f"{self.name}: imu topic {topic} not found, {closest(topic, known, 'an IMU')}")
        stamps: list[int] = []
        rows: list[list[float]] = []
        frame = ""
        for entry in self._log.entries(topic):
            m = entry.read()
            frame, w, a = m.header.frame_id, m.angular_velocity, m.linear_acceleration
            stamps.append(self._time_ns(entry))
            rows.append([w.x, w.y, w.z, a.x, a.y, a.z])
        times, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)
        values = np.array(rows, dtype=np.float64)[first]
        if not np.isfinite(values).all():
            raise DuagError(
                f"{self.name}: {topic} holds numbers that are not finite, expected rad/s and m/s^2"
            )
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
        return Imu(times, values, T)


def extrinsics_of(option: str, text: str) -> Array:
    """Matrix [4, 4] of "x y z qw qx qy qz" (m), the value of an option."""
    try:
        x, y, z, *q = np.array(text.split(), dtype=np.float64).tolist()
        if len(q) != 4 or not np.isfinite([x, y, z]).all() or abs(np.linalg.norm(q) - 1) > 0.01:
            raise ValueError("no rigid motion")
    except ValueError as error:
        raise DuagError(f"ros: {option} = {text!r}, expected 'x y z qw qx qy qz'") from error
    return np.asarray(se3.from_quat_translation(np.array(q), np.array([x, y, z])))
