"""Bags of ROS 1 and ROS 2 of a box room, made in the test."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from tests.converters.box_room import path, render

COLOR = PinholeCamera(160, 120, 140.0, 141.0, 79.2, 60.3)
DEPTH = PinholeCamera(120, 90, 92.0, 92.0, 60.1, 44.2)
DISTORTION = (0.12, -0.2, 0.001, -0.002, 0.05)
T_COLOR_DEPTH = se3.from_rotation_translation(so3.exp([0.004, -0.003, 0.002]), [-0.059, 0.001, 0.002])
REAL = Path(__file__).parents[3] / "shared" / "data" / "logs"
START_NS = 1_700_000_000_000_000_000
STEP_NS = 50_000_000
FRAMES = 4


class Ros:
    """Messages of one of the two ROS versions."""

    def __init__(self, version: int) -> None:
        self.version = version
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
        if version == 1:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))

    def make(self, kind: str, /, **values: Any) -> Any:
        return self.store.types[kind](**values)

    def header(self, stamp_ns: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        more = {"seq": 0} if self.version == 1 else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **more)

    def image(
        self, stamp_ns: int, frame: str, pixels: np.ndarray, encoding: str, pad: int = 0, big: bool = False
    ) -> Any:
        rows = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
        raw = np.frombuffer(rows.tobytes(), np.uint8).reshape(pixels.shape[0], -1)
        raw = np.pad(raw, ((0, 0), (0, pad)), constant_values=77)
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(stamp_ns, frame),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=int(big),
            step=raw.shape[1],
            data=raw.ravel(),
        )

    def compressed(self, stamp_ns: int, frame: str, data: bytes, text: str) -> Any:
        return self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(stamp_ns, frame),
            format=text,
            data=np.frombuffer(data, np.uint8),
        )

    def info(self, stamp_ns: int, frame: str, c: PinholeCamera, D: tuple[float, ...] = ()) -> Any:
        K = np.array([c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1])
        P = np.array([c.fx, 0, c.cx, 0, 0, c.fy, c.cy, 0, 0, 0, 1, 0])
        values = {"D": np.array(D or [0.0] * 5), "K": K, "R": np.eye(3).ravel(), "P": P}
        if self.version == 2:
            values = {name.lower(): value for name, value in values.items()}
        region = self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(stamp_ns, frame),
            height=c.height,
            width=c.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=region,
            **values,
        )

    def transform(self, stamp_ns: int, parent: str, child: str, T: np.ndarray) -> Any:
        q = so3.to_quat_wxyz(T[:3, :3])
        t = self.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", T[:3, 3].tolist(), strict=True)))
        r = self.make("geometry_msgs/msg/Quaternion", **dict(zip("wxyz", q.tolist(), strict=True)))
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp_ns, parent),
            child_frame_id=child,
            transform=self.make("geometry_msgs/msg/Transform", translation=t, rotation=r),
        )

    def tf(self, *transforms: Any) -> Any:
        return self.make("tf2_msgs/msg/TFMessage", transforms=list(transforms))

    def write(self, out: Path, rows: list[tuple[str, int, Any]], container: str) -> Path:
        """Write messages (topic, time of recording, message) into a bag; returns what to convert."""
        if self.version == 1:
            writer = Writer1(out.with_suffix(".bag"))
            if container != "plain":
                writer.set_compression(Writer1.CompressionFormat[container.upper()])
            with writer as bag:
                self._fill(bag, rows, self.store.serialize_ros1)
            return out.with_suffix(".bag")
        plugin = StoragePlugin.MCAP if container == "mcap" else StoragePlugin.SQLITE3
        with Writer2(out, version=9, storage_plugin=plugin) as bag:
            self._fill(bag, rows, self.store.serialize_cdr)
        return out

    def _fill(self, bag: Any, rows: list[tuple[str, int, Any]], serialize: Callable[..., Any]) -> None:
        connections: dict[tuple[str, str], Any] = {}
        for topic, log_ns, message in rows:
            kind = message.__msgtype__
            if (topic, kind) not in connections:
                connections[topic, kind] = bag.add_connection(topic, kind, typestore=self.store)
            bag.write(connections[topic, kind], log_ns, serialize(message, kind))


def scene(
    r: Ros,
    prefix: str = "",
    late_ns: int = 3_000_000,
    poses: list[np.ndarray] | None = None,
) -> list[tuple[str, int, Any]]:
    """Distorted color, depth of its own camera a little later, CameraInfo once, static tf, odometry of the base."""
    T_base_color = se3.from_rotation_translation(so3.exp([-1.2, 1.2, -1.2]), [0.1, 0.0, 0.3])
    frames = f"{prefix.strip('/')}_color", f"{prefix.strip('/')}_depth", f"{prefix.strip('/')}_base"
    rows: list[tuple[str, int, Any]] = [
        (f"{prefix}/camera/color/camera_info", START_NS, r.info(START_NS, frames[0], COLOR, DISTORTION)),
        (f"{prefix}/camera/depth/camera_info", START_NS, r.info(START_NS, frames[1], DEPTH)),
        (
            "/tf_static",
            START_NS,
            r.tf(
                r.transform(START_NS, frames[1], frames[0], se3.inverse(T_COLOR_DEPTH)),
                r.transform(START_NS, frames[2], frames[0], T_base_color),
            ),
        ),
    ]
    for i, T in enumerate(poses or path(FRAMES)):
        at = START_NS + (i + 1) * STEP_NS
        color, _ = render(COLOR, T, DISTORTION)
        _, z = render(DEPTH, T @ T_COLOR_DEPTH)
        raw = np.rint(z * 1000).astype(np.uint16)
        rows += [
            (
                f"{prefix}/camera/color/image_raw",
                at + 5_000_000,
                r.image(at, frames[0], color, "rgb8", pad=3),
            ),
            (
                f"{prefix}/camera/depth/image_rect_raw",
                at + 9_000_000,
                r.image(at + late_ns, frames[1], raw, "16UC1", pad=2, big=i == 1),
            ),
            (f"{prefix}/odom", at, odometry(r, at, frames[2], T @ se3.inverse(T_base_color))),
        ]
    return rows


def odometry(r: Ros, stamp_ns: int, child: str, T: np.ndarray) -> Any:
    q = so3.to_quat_wxyz(T[:3, :3])
    vector = r.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    pose = r.make(
        "geometry_msgs/msg/Pose",
        position=r.make("geometry_msgs/msg/Point", **dict(zip("xyz", T[:3, 3].tolist(), strict=True))),
        orientation=r.make("geometry_msgs/msg/Quaternion", **dict(zip("wxyz", q.tolist(), strict=True))),
    )
    twist = r.make("geometry_msgs/msg/Twist", linear=vector, angular=vector)
    return r.make(
        "nav_msgs/msg/Odometry",
        header=r.header(stamp_ns, "world"),
        child_frame_id=child,
        pose=r.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
        twist=r.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )
