"""Messages of our logs as arrays, and back: `message.pack()`, `Message.unpack(proto)`.

Poses, information and arrays read back bit for bit. Times are integer nanoseconds. Frames, units and shapes stand
at the fields; their place in the log in `schemas/*.proto`, their topics in `schemas/topics.py`.
"""

from duagc.pipeline.messages.estimates import (
    CorrectedKeyframes,
    FrameExposure,
    GaussianInformation,
    GaussianMap,
    Keyframe,
    KeyframeFactor,
    MapUpdate,
    Odometry,
    Submap,
    unpack,
)
from duagc.pipeline.messages.parts import (
    WORLD_FRAME,
    camera_frame,
    map_frame,
    pack_pose,
    pack_stamp,
    unpack_pose,
    unpack_stamp,
)
from duagc.pipeline.messages.peers import PeerColors, PeerMapReport
from duagc.pipeline.messages.sensors import (
    pack_calibration,
    pack_color,
    pack_depth,
    pack_imu,
    pack_mask,
    pack_points,
    pack_pose_in_frame,
    pack_transform,
    pack_valid,
    unpack_calibration,
    unpack_depth,
    unpack_mask,
    unpack_points,
    unpack_pose_in_frame,
    unpack_transform,
    unpack_valid,
)

__all__ = [
    "WORLD_FRAME",
    "CorrectedKeyframes",
    "FrameExposure",
    "GaussianInformation",
    "GaussianMap",
    "Keyframe",
    "KeyframeFactor",
    "MapUpdate",
    "Odometry",
    "PeerColors",
    "PeerMapReport",
    "Submap",
    "camera_frame",
    "map_frame",
    "pack_calibration",
    "pack_color",
    "pack_depth",
    "pack_imu",
    "pack_mask",
    "pack_points",
    "pack_pose",
    "pack_pose_in_frame",
    "pack_stamp",
    "pack_transform",
    "pack_valid",
    "unpack",
    "unpack_calibration",
    "unpack_depth",
    "unpack_mask",
    "unpack_points",
    "unpack_pose",
    "unpack_pose_in_frame",
    "unpack_stamp",
    "unpack_transform",
    "unpack_valid",
]
