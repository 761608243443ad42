"""One robot's RGB-D camera in a log: which topics, which cameras, and which messages belong together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from converters.logs.choice import REGISTERED, Chooser
from converters.logs.clocks import RobotClock
from converters.logs.files import NANOSECONDS, Entry, Log
from converters.logs.frames import Transforms, frame_name, pose_matrix
from converters.logs.options import LogOptions
from converters.ros_images import RosCamera, size_of
from converters.tum_layout import Listed, Poses, associate
from pipeline.errors import DuagError, closest
from pipeline.geometry import se3

Array = NDArray[np.float64]
POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
IMU_TYPE = "sensor_msgs/msg/Imu"
RECTIFIED = ("image_rect", "image_rect_color", "rect")
OUT_SCALE = 0.0005  # metres per unit of depth that was registered or came as floats


@dataclass(frozen=True)
class Imu:
    """stamps_ns int64 [n], increasing; values [n, 6]: rad/s and m/s^2 in its own axes; T_color_imu [4, 4]."""

    stamps_ns: NDArray[np.int64]
    values: Array
    T_color_imu: Array


@dataclass(frozen=True)
class CameraPoses:
    """Poses of a body that holds the colour camera: it is the body that moves evenly between two of them."""

    body: Poses
    T_body_color: Array

    def at(self, stamp_ns: int, max_gap_s: float) -> Array | None:
        """Pose [4, 4] of the colour camera at a time; None where there is none near."""
        T = self.body.at(stamp_ns, max_gap_s)
        return None if T is None else T @ self.T_body_color


class RobotLog:
    """Colour, depth, cameras and true poses of one robot.

    Raises (on construction):
        DuagError: a topic is missing or more than one could be meant; a camera or an extrinsic is unknown.
    """

    def __init__(self, log: Log, namespace: str, settings: LogOptions) -> None:
        self.log, self.namespace, self.settings = log, namespace.rstrip("/"), settings
        self.name = log.name
        self.warnings: list[str] = []
        self.shift_ns = round(
            settings.clock_offset_s * NANOSECONDS
        )  # added to all times when they are written
        self.transforms = Transforms(log, self.namespace)
        self._choose()

    def _choose(self) -> None:
        s = self.settings
        chooser = Chooser(self.log, self.namespace, s.model_dump())
        if not chooser.images:
            where = f" below {self.namespace}" if self.namespace else ""
            raise DuagError(f"{self.name}: found no topic of images{where}, expected colour and depth")
        self.depth = chooser.depth().required(self.log, "depth")
        self.color = chooser.color().required(self.log, "color")
        images = chooser.images
        self.color_camera = self._camera(self.color, "color_info", chooser)
        self.depth_camera = self._camera(self.depth, "depth_info", chooser)
        self.T_color_depth = self._extrinsics()
        raw16 = not hasattr(images[self.depth], "encoding") or images[self.depth].encoding != "32FC1"
        kept = raw16 and self.T_color_depth is None and self.color_maps is None
        self.depth_scale = s.depth_scale if kept else OUT_SCALE
        self.truth: CameraPoses | None = self._poses(s.truth, "truth") if s.truth else None

    def _camera(self, topic: str, option: str, chooser: Chooser) -> RosCamera:
        """Camera of an image topic."""
        chosen = chooser.info(option, topic).required(self.log, option)
        name = PurePosixPath(topic.removesuffix("/compressedDepth").removesuffix("/compressed")).name
        camera = RosCamera.of(self.log.first(chosen), name.startswith(RECTIFIED), f"{self.name}: {chosen}")
        found = size_of(chooser.images[topic], f"{self.name}: {topic}")
        expected = camera.camera.width, camera.camera.height
        if found != expected:
            raise DuagError(
                f"{self.name}: {topic} is {found[0]}x{found[1]}, expected {expected[0]}x{expected[1]} as in {chosen}"
            )
        return camera

    @cached_property
    def color_maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """Where in the colour images every pixel of the recording's camera lies."""
        return self.color_camera.maps() if self.settings.undistort else None

    # --- where the cameras are

    def _extrinsics(self) -> Array | None:
        """T_color_depth [4, 4]; None if depth is registered already."""
        s, color, depth = self.settings, self.color_camera, self.depth_camera
        same = color.camera == depth.camera and color.frame_id == depth.frame_id != ""
        named = any(hint in self.depth.lower() for hint in REGISTERED)
        if s.registered == "yes" or (s.registered == "auto" and not s.T_color_depth and (same or named)):
            if (color.camera.width, color.camera.height) != (depth.camera.width, depth.camera.height):
                raise DuagError(
                    f"{self.name}: {self.depth} is {depth.camera.width}x{depth.camera.height}, expected "
                    f"{color.camera.width}x{color.camera.height} of colour that it is registered to"
                )
            return None
        if s.T_color_depth:
            return extrinsics_of("T_color_depth", s.T_color_depth)
        named_frames = bool(color.frame_id and depth.frame_id)
        T = (
            self.transforms.lookup(color.frame_id, depth.frame_id)
            if named_frames
            else self._realsense_extrinsics()
        )
        if T is None:
            raise DuagError(
                f"{self.name}: {self.depth} is seen from {depth.frame_id!r}, colour from {color.frame_id!r}, and "
                "/tf_static does not tie them; expected --set T_color_depth='x y z qw qx qy qz' or registered=yes"
            )
        return T

    def _realsense_extrinsics(self) -> Array | None:
        """T_color_depth [4, 4] of a recording by RealSense's own software: each stream tells T_stream_reference."""
        found = []
        for image in (self.color, self.depth):
            topic = f"{image.removesuffix('/image/data')}/tf/0"
            if not self.log.of_type("geometry_msgs/msg/Transform", below=topic.removesuffix("/0")):
                return None
            m = self.log.first(topic)
            found.append(pose_matrix(m.translation, m.rotation, f"{self.name}: {topic}"))
        return found[0] @ se3.inverse(found[1])

    def _body_camera(self, topic: str, body: str) -> Array:
        """T_body_color [4, 4] of the frame that a topic of poses is of."""
        frame = self.settings.truth_frame if topic == self.settings.truth else ""
        frame = frame_name(frame or body or self.color_camera.frame_id)
        if self.settings.T_body_color:
            return extrinsics_of("T_body_color", self.settings.T_body_color)
        if frame in ("camera", frame_name(self.color_camera.frame_id)):
            return np.eye(4)
        T = self.transforms.lookup(frame, self.color_camera.frame_id)
        if T is None:
            raise DuagError(
                f"{self.name}: {topic} is of {frame!r}, and /tf_static does not tie it to "
                f"{self.color_camera.frame_id!r}; expected --set T_body_color='x y z qw qx qy qz', or "
                "truth_frame=camera if that is where it is"
            )
        return T

    def _poses(self, topic: str, option: str) -> CameraPoses:
        """Poses of the colour camera by a topic of poses of its body."""
        known = self.log.of_type(*POSE_TYPES)
        if topic not in known:
            raise DuagError(
                f"{self.name}: {option} topic {topic} not found, {closest(topic, known, 'poses')}"
            )
        poses: dict[int, Array] = {}
        body = ""
        for entry in self.log.entries(topic):
            m, where = entry.read(), f"{self.name}: {topic} at {entry.log_ns} ns"
            if hasattr(m, "transform"):
                position, orientation = m.transform.translation, m.transform.rotation
            else:
                pose = m.pose.pose if hasattr(m.pose, "pose") else m.pose
                position, orientation = pose.position, pose.orientation
            body = getattr(m, "child_frame_id", "")
            if np.isfinite([position.x, position.y, position.z]).all():
                poses[self.time_ns(entry)] = pose_matrix(position, orientation, where)
        stamps = sorted(poses)
        T = np.array([poses[stamp] for stamp in stamps]).reshape(-1, 4, 4)
        return CameraPoses(Poses(np.array(stamps, dtype=np.int64), T, 0), self._body_camera(topic, body))

    @cached_property
    def imu(self) -> Imu | None:
        """What the IMU measured, in order of time."""
        topic = self.settings.imu
        if not topic:
            return None
        known = self.log.of_type(IMU_TYPE)
        if topic not in known:
            raise DuagError(f"{self.name}: imu topic {topic} not found, {closest(topic, known, 'an IMU')}")
        stamps: list[int] = []
        rows: list[list[float]] = []
        frame = ""
        for entry in self.log.entries(topic):
            m = entry.read()
            frame, w, a = m.header.frame_id, m.angular_velocity, m.linear_acceleration
            stamps.append(self.time_ns(entry))
            rows.append([w.x, w.y, w.z, a.x, a.y, a.z])
        times, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)
        values = np.array(rows, dtype=np.float64)[first]
        if not np.isfinite(values).all():
            raise DuagError(
                f"{self.name}: {topic} holds numbers that are not finite, expected rad/s and m/s^2"
            )
        if self.settings.T_color_imu:
            T = extrinsics_of("T_color_imu", self.settings.T_color_imu)
        else:
            found = self.transforms.lookup(self.color_camera.frame_id, frame)
            if found is None:
                raise DuagError(
                    f"{self.name}: {topic} is of {frame!r}, and /tf_static does not tie it to "
                    f"{self.color_camera.frame_id!r}; expected --set T_color_imu='x y z qw qx qy qz'"
                )
            T = found
        return Imu(times, values, T)

    @cached_property
    def odometry(self) -> CameraPoses | None:
        """Poses of the colour camera by another odometry."""
        return self._poses(self.settings.odometry, "odometry") if self.settings.odometry else None

    # --- which messages

    def time_ns(self, entry: Entry) -> int:
        """The time of a message by the clock that the options choose."""
        source = self.settings.time_source
        if source == "header":
            return entry.header_ns()
        if source == "log":
            return entry.log_ns
        if entry.publish_ns is None:
            raise DuagError(
                f"{self.name}: bags of ROS hold no times of publication, expected time_source=header or log"
            )
        return entry.publish_ns

    @cached_property
    def pairs(self) -> dict[int, int]:
        """Time of a colour image -> time of its depth image."""
        stamps: dict[str, list[int]] = {self.color: [], self.depth: []}
        delays = []
        for entry in self.log.entries(self.color, self.depth):
            stamps[entry.topic].append(self.time_ns(entry))
            delays.append(entry.log_ns - stamps[entry.topic][-1])
        self._delays_ns = np.array(delays, dtype=np.int64)
        for topic, times in stamps.items():
            if times != sorted(times):
                self.warnings.append(f"{topic}: times go backwards; images are taken in order of time")
            if len(set(times)) < len(times):
                self.warnings.append(
                    f"{topic}: {len(times) - len(set(times))} images repeat a time; left out"
                )
            if not any(times):
                raise DuagError(
                    f"{self.name}: {topic}: all times are zero, expected times, or --set time_source=log"
                )
        listed = {topic: [Listed(t, Path()) for t in sorted(set(times))] for topic, times in stamps.items()}
        found = associate(listed[self.color], listed[self.depth], self.settings)
        if not found:
            away = nearest_s(
                [d.stamp_ns for d in listed[self.depth]], [c.stamp_ns for c in listed[self.color]]
            )
            raise DuagError(
                f"{self.name}: no image on {self.depth} within {self.settings.limit_ns / NANOSECONDS:g} s of one on "
                f"{self.color} (the nearest is {away:.3f} s away), expected pairs, or --set max_difference_s=SECONDS"
            )
        alone = len(listed[self.color]) - len(found)
        if alone:
            self.warnings.append(
                f"{alone} of {len(listed[self.color])} colour images have no depth near in time"
            )
        return {c.stamp_ns: d.stamp_ns for c, d in found}

    def clock(self, robot: str) -> RobotClock:
        """What the times of the images say about the robot's clock."""
        first, last = min(self.pairs), max(self.pairs)
        header = self.settings.time_source == "header"
        return RobotClock(robot, self.log, self.namespace, self._delays_ns, first, last, header)

    def frames(self) -> Iterator[tuple[int, Any, Any]]:
        """Time, colour and depth message of every pair, in order of time; holds no more than it must."""
        pairs = self.pairs
        used_by: dict[int, list[int]] = {}
        for color_ns, depth_ns in pairs.items():
            used_by.setdefault(depth_ns, []).append(color_ns)
        colors: dict[int, Any] = {}
        depths: dict[int, Any] = {}
        order = sorted(pairs)
        at = 0
        for entry in self.log.entries(self.color, self.depth):
            stamp = self.time_ns(entry)
            if entry.topic == self.color and stamp in pairs:
                colors.setdefault(stamp, entry)
            elif entry.topic == self.depth and stamp in used_by:
                depths.setdefault(stamp, entry)
            while at < len(order) and order[at] in colors and pairs[order[at]] in depths:
                color_ns, depth_ns = order[at], pairs[order[at]]
                yield color_ns, colors.pop(color_ns).read(), depths[depth_ns].read()
                used_by[depth_ns].remove(color_ns)
                if not used_by[depth_ns]:
                    del depths[depth_ns]
                at += 1

    def sensors(self) -> dict[str, str]:
        """What the log says about its source."""
        moved = "registered to colour by the converter" if self.T_color_depth is not None else "registered"
        return {"color_topic": self.color, "depth_topic": self.depth, "depth": moved}


def nearest_s(times_ns: list[int], others_ns: list[int]) -> float:
    """The least difference between sorted times and sorted others, seconds."""
    times, others = np.array(times_ns, dtype=np.int64), np.array(others_ns, dtype=np.int64)
    after = np.searchsorted(others, times)
    near = np.stack(
        [others[np.clip(after, 0, len(others) - 1)], others[np.clip(after - 1, 0, len(others) - 1)]]
    )
    return float(np.abs(near - times).min()) / NANOSECONDS


def extrinsics_of(option: str, text: str) -> Array:
    """Matrix [4, 4] of "x y z qw qx qy qz" (m), the value of an option."""
    try:
        x, y, z, *q = np.array(text.split(), dtype=np.float64).tolist()
        if len(q) != 4 or not np.isfinite([x, y, z]).all() or abs(np.linalg.norm(q) - 1) > 0.01:
            raise ValueError("no rigid motion")
    except ValueError as error:
        raise DuagError(f"ros: {option} = {text!r}, expected 'x y z qw qx qy qz'") from error
    return np.asarray(se3.from_quat_translation(np.array(q), np.array([x, y, z])))
