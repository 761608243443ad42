"""Definitions of messages for logs that carry none, as those of ROS 2 before Iron: Humble's, and of drivers'."""

from __future__ import annotations

from functools import cache
from typing import Any

OF_DRIVERS = {
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": """std_msgs/Header header
int32 width
int32 height
string encoding
uint64 pts
uint8 flags
bool is_bigendian
uint8[] data""",
    "foxglove_msgs/msg/CompressedVideo": """builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format""",
    "realsense2_camera_msgs/msg/RGBD": """std_msgs/Header header
sensor_msgs/CameraInfo rgb_camera_info
sensor_msgs/CameraInfo depth_camera_info
sensor_msgs/Image rgb
sensor_msgs/Image depth""",
    "rtabmap_msgs/msg/GlobalDescriptor": """std_msgs/Header header
int32 type
uint8[] info
uint8[] data""",
    "rtabmap_msgs/msg/KeyPoint": """rtabmap_msgs/Point2f pt
float32 size
float32 angle
float32 response
int32 octave
int32 class_id""",
    "rtabmap_msgs/msg/Point2f": "float32 x\nfloat32 y",
    "rtabmap_msgs/msg/Point3f": "float32 x\nfloat32 y\nfloat32 z",
    "rtabmap_msgs/msg/RGBDImage": """std_msgs/Header header
sensor_msgs/CameraInfo rgb_camera_info
sensor_msgs/CameraInfo depth_camera_info
sensor_msgs/Image rgb
sensor_msgs/Image depth
sensor_msgs/CompressedImage rgb_compressed
sensor_msgs/CompressedImage depth_compressed
rtabmap_msgs/KeyPoint[] key_points
rtabmap_msgs/Point3f[] points
uint8[] descriptors
rtabmap_msgs/GlobalDescriptor global_descriptor""",
}


@cache
def of_ros2() -> Any:
    """A `rosbags` type store of ROS 2 Humble, with the messages of drivers that are read here."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in OF_DRIVERS.items():
        store.register(get_types_from_msg(text, name))
    return store
