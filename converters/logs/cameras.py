"""Cameras of a log: those that the options state, and whether the others stay as they are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from duagc.converters.layouts.ros_camera import RosCamera
from duagc.converters.layouts.ros_images import size_of
from duagc.converters.layouts.sound_camera import check_camera
from duagc.converters.logs.entries import Entry
from duagc.converters.logs.files import Log
from duagc.converters.logs.frames import frame_name, pose_matrix
from duagc.converters.logs.options import LogOptions
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording.names import DEPTH_SCALE_KEY
from duagc.schemas import topics

RECTIFIED = "rect"
"""How a word begins in the name of images that are: image_rect_color, image_color_rect, left_rectified."""
TRANSPORTS = ("compressed", "compressedDepth", "ffmpeg", "foxglove")
"""Last parts of topics, below the name of their images."""
SAME_CAMERA_PX = 1.0  # up to which a camera has not changed


def stated(settings: LogOptions, option: str, has_infos: bool) -> str:
    """What the options say of the camera of an image topic; empty: its CameraInfo does.

    Args:
        settings: the options.
        option: which CameraInfo it would be, "color_info" or "depth_info".
        has_infos: whether the log has any CameraInfo.
    """
    if option == "color_info":
        return settings.color_camera
    registered = settings.registered == "yes" and not has_infos
    return settings.depth_camera or (settings.color_camera if registered else "")


def stated_camera(text: str, image: Any, where: str) -> RosCamera:
    """The camera of a text "fx fy cx cy", or with "k1 k2 p1 p2 k3" after it.

    Args:
        text: the numbers, pixels.
        image: a message, whose size and frame are those of the camera.
        where: begins the line of an error.
    Raises:
        DuagError: the text is no camera.
    """
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) not in (4, 8, 9) or not np.all(np.isfinite(numbers)):
        raise DuagError(f"{where}: camera {text!r}, expected fx fy cx cy, or these and k1 k2 p1 p2 k3")
    camera = PinholeCamera(*size_of(image, where), *numbers[:4])
    check_camera(camera, where)
    distortion = tuple(numbers[4:]) if any(numbers[4:]) else ()
    return RosCamera(camera, distortion, False, frame_name(image.header.frame_id))


class CameraWatch:
    """Watches that what a CameraInfo says does not change: a camera of the recording is one camera."""

    def __init__(self, first: Mapping[str, tuple[RosCamera, bool]], name: str) -> None:
        """Begin with the first message of every topic.

        Args:
            first: by topic, the camera that it says, and whether its images are rectified.
            name: of the log.
        """
        self._first, self._name = first, name
        self._seen: dict[str, bytes] = {}

    def see(self, entry: Entry) -> None:
        """Compare a message with the first one of its topic.

        Args:
            entry: the message.

        Raises:
            DuagError: the difference can be seen in images.
        """
        rest = entry.data[16:]  # in ROS what follows the times of the header, most often the same bytes
        if self._seen.get(entry.topic) == rest:
            return
        first, rectified = self._first[entry.topic]
        where = f"{self._name}: {entry.topic}"
        now = RosCamera.of(entry.read(), rectified, where)
        self._seen[entry.topic] = rest
        a, b = (np.array([c.camera.fx, c.camera.fy, c.camera.cx, c.camera.cy]) for c in (first, now))
        if np.abs(a - b).max() > SAME_CAMERA_PX or first.distortion != now.distortion:
            raise DuagError(
                f"{where} changes at {entry.log_ns} ns from fx fy cx cy = {a.round(2).tolist()} px to "
                f"{b.round(2).tolist()}, expected one camera (a zoom or autofocus has to be fixed while recording)"
            )


def image_path(topic: str) -> PurePosixPath:
    """The topic of images by that of a transport of them: /image_raw of /image_raw/compressed.

    Args:
        topic: of images.
    """
    path = PurePosixPath(topic)
    return path.parent if path.name in TRANSPORTS and path.parent.name else path


def is_rectified(topic: str, own: bool = False) -> bool:
    """Whether images are undistorted, by the name of their topic.

    Args:
        topic: of the images.
        own: whether DUAG-C wrote the log.
    """
    words = image_path(topic).name.split("_")
    return any(word.startswith(RECTIFIED) for word in words) or is_own_depth(topic, own)


def is_own_depth(topic: str, own: bool) -> bool:
    """Whether images are depth that belongs to the pinhole camera of color, as DUAG-C writes it.

    Args:
        topic: of the images.
        own: whether DUAG-C wrote the log.
    """
    row = topics.find(topic) if own else None
    return row is not None and row[0] is topics.DEPTH


def realsense_extrinsics(log: Log, color: str, depth: str, name: str) -> Array | None:
    """T_color_depth [4, 4] of a recording by RealSense's own software: each stream states T_stream_reference.

    Args:
        log: the log.
        color: topic of the images.
        depth: topic of the depth images.
        name: of the log, for errors.
    """
    found = []
    for image in (color, depth):
        topic = f"{image.removesuffix('/image/data')}/tf/0"
        if not log.of_type("geometry_msgs/msg/Transform", below=topic.removesuffix("/0")):
            return None
        m = log.first(topic)
        found.append(pose_matrix(m.translation, m.rotation, f"{name}: {topic}"))
    return found[0] @ se3.inverse(found[1])


def as_stated(log: Log, depth: str, settings: LogOptions, *, own: bool) -> LogOptions:
    """The settings with what is known of depth by its log, unless they state it.

    That is the unit where RealSense's own software or DUAG-C recorded it, and that DUAG-C's is registered.

    Args:
        log: the log.
        depth: topic of the depth images.
        settings: options of the converter.
        own: whether DUAG-C wrote the log.
    Raises:
        DuagError: what the log states is no unit.
    """
    known: dict[str, object] = {}
    if is_own_depth(depth, own) and settings.registered == "auto":
        known["registered"] = "yes"
    if "depth_scale" not in settings.model_fields_set and (unit := _stated_unit(log, depth, own)):
        where, meters = unit
        if not 0 < meters < 1:
            raise DuagError(
                f"{log.name}: {where} is {meters:g}, expected meters per unit, or --set depth_scale=METERS"
            )
        known["depth_scale"] = meters
    return settings.model_copy(update=known)


def _stated_unit(log: Log, depth: str, own: bool) -> tuple[str, float] | None:
    """Meters per unit of a depth image, and where the log states them."""
    text = log.topics[depth].metadata.get(DEPTH_SCALE_KEY) if own else None
    if text is not None:
        try:
            return f"{DEPTH_SCALE_KEY} of {depth}", float(text)
        except ValueError:
            return f"{DEPTH_SCALE_KEY} of {depth}", math.nan
    sensor = depth.removesuffix("/image/data").rpartition("/")[0]
    named = [f"{sensor}/option/Depth{blank}Units/value" for blank in " _"]  # of older and newer software
    found = [topic for topic in log.of_type("std_msgs/msg/Float32") if topic in named]
    if not found or not depth.endswith("/image/data"):
        return None
    return found[0], float(f"{log.first(found[0]).data:.6g}")  # 0.001 is not one of the 32-bit numbers
