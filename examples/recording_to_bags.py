"""Write every robot of a recording as a ROS 1 bag, for a tour of `duagc convert` without a robot.

    duagc simulate --robots 2 --frames 100 --width 320 --height 240 --noise kinect --out recordings/room
    python examples/recording_to_bags.py recordings/room bags

A bag has the compressed color images, raw depth that is registered to them, and both CameraInfo. It has no poses.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from duagc import Recording, open_rgbd, read_log

COLOR, DEPTH = "/camera/color", "/camera/aligned_depth_to_color"
FRAME = "camera_color_optical_frame"
EPOCH_NS = 1_700_000_000_000_000_000  # recordings begin at 0, robots do not
STORE = get_typestore(Stores.ROS1_NOETIC)
TYPES = {
    f"{COLOR}/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    f"{COLOR}/camera_info": "sensor_msgs/msg/CameraInfo",
    f"{DEPTH}/image_raw": "sensor_msgs/msg/Image",
    f"{DEPTH}/camera_info": "sensor_msgs/msg/CameraInfo",
}


def make(kind: str, **values: Any) -> Any:
    return STORE.types[kind](**values)


def header(stamp_ns: int) -> Any:
    stamp = make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return make("std_msgs/msg/Header", seq=0, stamp=stamp, frame_id=FRAME)


def camera_info(stamp_ns: int, camera: Any) -> Any:
    region = make(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=header(stamp_ns),
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob",
        D=np.zeros(5),
        K=camera.matrix().ravel(),
        R=np.eye(3).ravel(),
        P=np.hstack([camera.matrix(), np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


def color_image(message: Any) -> Any:
    return make(
        "sensor_msgs/msg/CompressedImage",
        header=header(EPOCH_NS + message.timestamp.ToNanoseconds()),
        format=message.format,
        data=np.frombuffer(message.data, np.uint8),
    )


def depth_image(message: Any) -> Any:
    return make(
        "sensor_msgs/msg/Image",
        header=header(EPOCH_NS + message.timestamp.ToNanoseconds()),
        height=message.height,
        width=message.width,
        encoding="16UC1",
        is_bigendian=0,
        step=message.step,
        data=np.frombuffer(message.data, np.uint8),
    )


def write_bag(recording: Recording, robot: str, path: Path) -> None:
    """Write one robot's bag; depth keeps its unit, which is that of the recording."""
    with open_rgbd(recording.log(robot)) as log:
        camera, first_ns = log.camera, EPOCH_NS + log.frame(0).stamp_ns
    color, depth = f"/{robot}/camera/color", f"/{robot}/camera/depth"
    with Writer(path) as bag:
        rows = {topic: bag.add_connection(topic, kind, typestore=STORE) for topic, kind in TYPES.items()}

        def put(topic: str, at_ns: int, message: Any) -> None:
            bag.write(rows[topic], at_ns, STORE.serialize_ros1(message, TYPES[topic]))

        for name in (f"{COLOR}/camera_info", f"{DEPTH}/camera_info"):
            put(name, first_ns, camera_info(first_ns, camera))
        for record in read_log(recording.log(robot), [color, depth]):
            if record.topic == color:
                put(
                    f"{COLOR}/image_raw/compressed",
                    EPOCH_NS + record.log_time_ns,
                    color_image(record.proto()),
                )
            else:
                put(f"{DEPTH}/image_raw", EPOCH_NS + record.log_time_ns, depth_image(record.proto()))


def main(source: Path, out: Path) -> None:
    out.mkdir(parents=True)
    recording = Recording(source)
    for robot in recording.robots:
        write_bag(recording, robot, out / f"{robot}.bag")
        print(out / f"{robot}.bag")


if __name__ == "__main__":
    main(*(Path(word) for word in sys.argv[1:3]))
