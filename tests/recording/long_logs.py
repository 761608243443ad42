"""Long logs by repetition: `python -m tests.recording.long_logs RECORDING OUT --kind bag --gigabytes 20`.

The frames of a recording (color as it is, depth as raw 16UC1) are written at 30 Hz forwards and backwards, again and
again, with an IMU at 200 Hz where the kind of log has messages for it. No more is held than those frames.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer

from duagc import schemas as foxglove
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import Recording, open_rgbd, read_log
from duagc.schemas import topics
from tests.converters.ros_bags import Ros

KINDS = ("bag", "db3", "cdr", "protobuf", "json")
PACKED = "bag-png"  # a bag with depth as compressedDepth
COLOR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
INFOS = ("/camera/color/camera_info", "/camera/aligned_depth_to_color/camera_info")
IMU, STATIC = "/camera/imu", "/tf_static"
FRAME, IMU_FRAME = "camera_color_optical_frame", "camera_imu_frame"
START_NS, STEP_NS, IMU_STEP_NS = 1_700_000_000_000_000_000, 33_333_333, 5_000_000
DELAY_NS = 4_000_000  # from the header to the recorder
Message = Callable[[int], bytes]  # the bytes of a message, by the time of its header


@dataclass
class Seed:
    """What is repeated. colors: JPEG or PNG; depths: uint16 [H, W], in millimeters."""

    camera: PinholeCamera
    colors: list[bytes]
    depths: list[np.ndarray]

    @staticmethod
    def of(recording: Path, most: int) -> Seed:
        """The first frames of a recording's first robot."""
        found = Recording(recording)
        robot = found.robots[0]
        seed = Seed(open_rgbd(found.log(robot)).camera, [], [])
        for record in read_log(found.log(robot), [topics.COLOR.of(robot), topics.DEPTH.of(robot)]):
            message = record.proto()
            if record.topic == topics.COLOR.of(robot):
                seed.colors.append(bytes(message.data))
            else:
                shape = message.height, message.width
                seed.depths.append(np.frombuffer(message.data, "<u2").reshape(shape))
            if len(seed.depths) == len(seed.colors) == most:
                break
        return seed


def patched(data: bytes) -> Message:
    """A message of ROS with another stamp: seconds and nanoseconds stand at byte 4, in ROS 1 and in CDR."""
    return lambda at: data[:4] + struct.pack("<II", at // 10**9, at % 10**9) + data[12:]


def ros_messages(seed: Seed, ros: Ros, packed: bool) -> dict[str, tuple[str, list[Message]]]:
    """By topic: type and the messages that are repeated. packed: depth as compressedDepth."""
    serialize: Any = ros.store.serialize_ros1 if ros.version == 1 else ros.store.serialize_cdr
    text = "jpeg" if seed.colors[0].startswith(b"\xff\xd8") else "png"
    still = ros.make("geometry_msgs/msg/Vector3", x=0.01, y=0.02, z=9.81)
    imu = ros.make(
        "sensor_msgs/msg/Imu",
        header=ros.header(START_NS, IMU_FRAME),
        orientation=ros.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        angular_velocity=still,
        linear_acceleration=still,
        orientation_covariance=np.zeros(9),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration_covariance=np.zeros(9),
    )
    found = {
        **{info: [ros.info(START_NS, FRAME, seed.camera)] for info in INFOS},
        STATIC: [ros.tf(ros.transform(START_NS, FRAME, IMU_FRAME, np.eye(4)))],
        IMU: [imu],
        f"{COLOR}/compressed": [ros.compressed(START_NS, FRAME, c, text) for c in seed.colors],
        DEPTH: [ros.image(START_NS, FRAME, d, "16UC1") for d in seed.depths],
    }
    if packed:
        found[DEPTH] = [
            ros.compressed(
                START_NS,
                FRAME,
                bytes(12) + cv2.imencode(".png", d)[1].tobytes(),
                "16UC1; compressedDepth png",
            )
            for d in seed.depths
        ]
    out: dict[str, tuple[str, list[Message]]] = {}
    for topic, rows in found.items():
        encoded = [bytes(serialize(m, m.__msgtype__)) for m in rows]
        timed = [lambda at, d=d: d for d in encoded] if topic == STATIC else [patched(d) for d in encoded]
        out[topic] = rows[0].__msgtype__, timed
    return out


def foxglove_messages(seed: Seed, kind: str) -> dict[str, tuple[str, list[Message]]]:
    """The same of Foxglove, without the IMU, in "protobuf" or "json"."""
    c = seed.camera
    K = [c.fx, 0.0, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0]
    size = {"width": c.width, "height": c.height}
    info = {**size, "distortion_model": "plumb_bob", "D": [0.0] * 5, "K": K, "R": np.eye(3).ravel().tolist()}
    info["P"] = [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]
    text = "jpeg" if seed.colors[0].startswith(b"\xff\xd8") else "png"
    depth = {**size, "encoding": "16UC1", "step": 2 * c.width}

    def message(schema: str, fields: dict[str, Any]) -> Message:
        made = foxglove.message_class(schema)(frame_id=FRAME, **fields)

        def protobuf(at: int) -> bytes:
            made.timestamp.seconds, made.timestamp.nanos = at // 10**9, at % 10**9
            return bytes(made.SerializeToString())

        plain = {k: base64.b64encode(v).decode() if isinstance(v, bytes) else v for k, v in fields.items()}
        rest = json.dumps({"frame_id": FRAME, **plain})[1:].encode()

        def as_json(at: int) -> bytes:
            return b'{"timestamp":{"sec":%d,"nsec":%d},%s' % (at // 10**9, at % 10**9, rest)

        return protobuf if kind == "protobuf" else as_json

    names = "foxglove.CameraCalibration", "foxglove.CompressedImage", "foxglove.RawImage"
    return {
        **{topic: (names[0], [message(names[0], info)]) for topic in INFOS},
        f"{COLOR}/compressed": (
            names[1],
            [message(names[1], {"format": text, "data": color}) for color in seed.colors],
        ),
        DEPTH: (names[2], [message(names[2], {**depth, "data": d.tobytes()}) for d in seed.depths]),
    }


@contextmanager
def rosbag(path: Path, ros: Ros, types: dict[str, str]) -> Iterator[Callable[[str, int, bytes], None]]:
    """Writes a bag of ROS 1, or a folder with the .db3 of ROS 2."""
    if ros.version == 1:
        writer: Any = BagWriter(path)
    else:
        writer = Ros2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
    with writer as bag:
        connections = {t: bag.add_connection(t, kind, typestore=ros.store) for t, kind in types.items()}
        yield lambda topic, at, data: bag.write(connections[topic], at, data)


@contextmanager
def mcap(path: Path, kind: str, types: dict[str, str]) -> Iterator[Callable[[str, int, bytes], None]]:
    """Writes an MCAP: CDR uncompressed, as recorders of ROS 2 do, else with zstd, as Foxglove's do."""
    ros, packed = Ros(2), CompressionType.NONE if kind == "cdr" else CompressionType.ZSTD
    with path.open("wb") as stream:
        writer = Writer(stream, compression=packed)
        writer.start(profile="ros2" if kind == "cdr" else "")
        channels = {}
        for topic, name in types.items():
            if kind == "cdr":
                text = ros.store.generate_msgdef(name, ros_version=2)[0].encode()
                schema = writer.register_schema(name, "ros2msg", text)
            elif kind == "protobuf":
                schema = writer.register_schema(name, kind, foxglove.descriptor_set(name))
            else:
                schema = writer.register_schema(name, "jsonschema", b'{"type": "object"}')
            channels[topic] = writer.register_channel(topic, kind, schema)
        yield lambda topic, at, data: writer.add_message(channels[topic], at, data, at)
        writer.finish()


def write(seed: Seed, path: Path, kind: str, most_bytes: float) -> int:
    """Write a log of about so many bytes of messages. Returns the number of frames."""
    ros = Ros(1 if kind in ("bag", PACKED) else 2)
    if kind in ("protobuf", "json"):
        found = foxglove_messages(seed, kind)
    else:
        found = ros_messages(seed, ros, kind == PACKED)
    types = {topic: name for topic, (name, _) in found.items()}
    opened: AbstractContextManager[Callable[[str, int, bytes], None]]
    opened = rosbag(path, ros, types) if kind in ("bag", PACKED, "db3") else mcap(path, kind, types)
    order = [*range(len(seed.colors)), *range(len(seed.colors) - 2, 0, -1)]
    frames = written = readings = 0
    with opened as put:
        for topic, (_, messages) in found.items():
            if len(messages) == 1 and topic != IMU:
                put(topic, START_NS, messages[0](START_NS))
        while written < most_bytes:
            at = START_NS + frames * STEP_NS
            while IMU in found and (now := START_NS + readings * IMU_STEP_NS) <= at:
                put(IMU, now + DELAY_NS, found[IMU][1][0](now))
                readings += 1
            for topic in (f"{COLOR}/compressed", DEPTH):
                data = found[topic][1][order[frames % len(order)]](at)
                put(topic, at + DELAY_NS, data)
                written += len(data)
            frames += 1
    return frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--kind", choices=(*KINDS, PACKED), default="bag")
    parser.add_argument("--gigabytes", type=float, default=2.0)
    parser.add_argument("--frames", type=int, default=60, help="of the recording that are repeated")
    said = parser.parse_args()
    frames = write(Seed.of(said.recording, said.frames), said.out, said.kind, said.gigabytes * 1e9)
    size = sum(p.stat().st_size for p in ([said.out] if said.out.is_file() else said.out.iterdir()))
    print(f"{said.out}: {frames} frames, {size / 1e9:.2f} GB")


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
