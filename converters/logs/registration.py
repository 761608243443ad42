"""Whether depth is seen from the color camera, by name, frame and camera; and where its camera is, if not."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from duagc.converters.layouts.ros_camera import RosCamera, between_images
from duagc.converters.logs.cameras import realsense_extrinsics
from duagc.converters.logs.files import Log
from duagc.converters.logs.frames import Transforms
from duagc.converters.logs.motion import extrinsics_of
from duagc.converters.logs.options import LogOptions
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording.register_depth import MOST_SAMPLES, sample_steps

SAME_CAMERA = 0.01  # share of focal length and size up to which two cameras agree
LEAST_BASE_M = 0.001


@dataclass(frozen=True)
class ImageTopic:
    """An image topic and its camera.

    Attributes:
        frame: of its first image.
        info: topic of its CameraInfo; empty where the options state the camera.
    """

    topic: str
    frame: str
    info: str
    camera: RosCamera


def check_infos(color: ImageTopic, depth: ImageTopic, settings: LogOptions, name: str) -> None:
    """Refuse the only CameraInfo of a log as that of two cameras.

    Args:
        color: of the color images.
        depth: of the depth images, or the right ones.
        settings: options of the converter.
        name: of the log.
    Raises:
        DuagError: the images are of different frames.
    """
    shared = bool(color.info) and color.info == depth.info
    if not shared or color.frame == depth.frame or not (color.frame and depth.frame):
        return
    if settings.registered == "yes" or (settings.depth_from == "image" and is_named_registered(depth.topic)):
        return
    lost, option = (color, "color") if depth.frame == color.camera.frame_id else (depth, "depth")
    if getattr(settings, f"{option}_info"):
        return
    registered = ", or registered=yes" if lost is depth and settings.depth_from == "image" else ""
    raise DuagError(
        f"{name}: {lost.topic} of {lost.frame!r} has no CameraInfo of its own, found only {color.info} of "
        f"{color.camera.frame_id!r}; expected --set {option}_info=TOPIC or {option}_camera='fx fy cx cy'{registered}"
    )


def check_samples(color: PinholeCamera, depth: PinholeCamera, where: str, topic: str) -> None:
    """Refuse depth that is far coarser than the color that it is to be registered to.

    Args:
        color: the camera of color.
        depth: the camera of depth.
        where: begins the line of an error.
        topic: of depth.
    Raises:
        DuagError: it would be drawn by more samples than registration takes.
    """
    steps = sample_steps(depth, color)
    if steps**2 * depth.width * depth.height > MOST_SAMPLES:
        finer = max(color.fx / depth.fx, color.fy / depth.fy)
        most = math.isqrt(MOST_SAMPLES // (depth.width * depth.height)) / 1.5
        raise DuagError(
            f"{where} are {finer:.0f} times as fine as those of {topic}, expected at most {most:.0f} times"
        )


def is_named_registered(topic: str) -> bool:
    """Whether depth is registered to color by a part of the topic's name: aligned_depth_to_color, depth_registered.

    Args:
        topic: of the depth images.
    """
    for part in PurePosixPath(topic.lower()).parts:
        words = part.split("_")
        target = words[words.index("to") + 1 :] if "to" in words else ["color"]
        to_color = any(word.startswith(("color", "rgb")) for word in target)
        if to_color and {"aligned", "registered"} & set(words):
            return True
    return False


def extrinsics(
    log: Log, color: ImageTopic, depth: ImageTopic, transforms: Transforms, *, settings: LogOptions
) -> Array | None:
    """T_color_depth [4, 4]; None if depth is registered already.

    Args:
        log: the log.
        color: of the color images.
        depth: of the depth images.
        transforms: between frames of the log.
        settings: options of the converter.
    Raises:
        DuagError: nothing says where the depth camera is, or registered depth has another size than color.
    """
    s, a, b = settings, color.camera.camera, depth.camera.camera
    of_one_size = (a.width, a.height) == (b.width, b.height)
    if s.registered == "yes" and not of_one_size:
        raise DuagError(
            f"{log.name}: {depth.topic} is {b.width}x{b.height}, expected {a.width}x{a.height} of color that it "
            "is registered to, or registered=no"
        )
    if s.registered == "yes" or (
        s.registered == "auto" and not s.T_color_depth and of_one_size and _is_registered(color, depth)
    ):
        return None
    if s.T_color_depth:
        return extrinsics_of("T_color_depth", s.T_color_depth)
    color_frame, depth_frame = _frames(color, depth)
    if color_frame == depth_frame and _differ(color.frame, depth.frame):
        color_frame, depth_frame = color.frame, depth.frame
    T = (
        transforms.lookup(color_frame, depth_frame)
        if color_frame and depth_frame
        else realsense_extrinsics(log, color.topic, depth.topic, log.name)
    )
    if T is None:
        raise DuagError(
            f"{log.name}: {depth.topic} is seen from {depth_frame!r}, color from {color_frame!r}, and "
            f"/tf_static does not tie them{transforms.moving_words()}; expected --set T_color_depth="
            "'x y z qw qx qy qz' or registered=yes"
        )
    if words := body_axes_of_cameras(color_frame, depth_frame, T):
        transforms.warnings.append(words)
    if not (color_frame and depth_frame):
        return T
    return between_images(T, color.camera, depth.camera, log.name)


def body_axes_of_cameras(color_frame: str, depth_frame: str, T_color_depth: Array) -> str:
    """What to warn of where the axes of two cameras may be x forward, z up, and not optical ones; empty: nothing.

    Args:
        color_frame: of the color camera.
        depth_frame: of the depth camera.
        T_color_depth: [4, 4], by the log's transforms.
    """
    named = ["optical" in frame.lower() for frame in (color_frame, depth_frame)]
    base = np.abs(T_color_depth[:3, 3])
    apart = T_color_depth[2, 2] < np.sqrt(0.5)  # cameras of one view look the same way
    sideways = base.max() > LEAST_BASE_M and int(base.argmax()) != 0  # along x of optical frames, most often
    if all(named) or not (apart or (sideways and not any(named))):
        return ""
    return (
        f"{color_frame!r} and {depth_frame!r} are taken as optical frames (z forward), which their transform leaves "
        "open: with x forward, depth is wrong; expected --set T_color_depth='x y z qw qx qy qz'"
    )


def _is_registered(color: ImageTopic, depth: ImageTopic) -> bool:
    a, b = color.camera, depth.camera
    color_frame, depth_frame = _frames(color, depth)
    one_frame = color_frame == depth_frame != "" and not _differ(color.frame, depth.frame)
    if a.camera == b.camera and one_frame:
        return True
    return is_named_registered(depth.topic) and (one_frame or _agree(a.camera, b.camera))


def _frames(*views: ImageTopic) -> list[str]:
    """Frames by CameraInfo; where only some have one, those of the images stand in for the others."""
    stated = [view.camera.frame_id for view in views]
    return [frame or view.frame for frame, view in zip(stated, views, strict=True)] if any(stated) else stated


def _differ(a: str, b: str) -> bool:
    """Whether two images say that they are of different frames."""
    return bool(a and b) and a != b


def _agree(a: PinholeCamera, b: PinholeCamera) -> bool:
    """Whether two pinholes are the same, up to rounding and the calibration of the day."""
    if (a.width, a.height) != (b.width, b.height):
        return False
    focal = max(abs(b.fx / a.fx - 1), abs(b.fy / a.fy - 1))
    center = max(abs(b.cx - a.cx) / a.width, abs(b.cy - a.cy) / a.height)
    return max(focal, center) < SAME_CAMERA
