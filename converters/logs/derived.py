"""Depth that a log does not hold as images: of a stereo pair whose left eye is the color camera, or of a LiDAR."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.derived_depth import (
    ROW_PAIRS,
    STEREO_SCALE_M,
    LidarSource,
    StereoFrames,
    spread,
)
from duagc.converters.layouts.ros_camera import RosCamera, between_images
from duagc.converters.layouts.ros_images import check_decodes, color_bytes
from duagc.converters.layouts.ros_points import PointTimes
from duagc.converters.layouts.stereo import RawCamera, StereoRig
from duagc.converters.logs.cameras import realsense_extrinsics
from duagc.converters.logs.files import Log
from duagc.converters.logs.frames import Transforms, body_axes_of_camera
from duagc.converters.logs.motion import extrinsics_of
from duagc.converters.logs.options import LogOptions
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.masks import Mask
from duagc.pipeline.recording.lidar import lidar_depth
from duagc.pipeline.recording.motion import MotionPrior

TIMED_SWEEPS = 8  # by which it is found how points say their times


@dataclass(frozen=True)
class Picture:
    """What is written of a frame: encoded color; depth in units of the log with sigma [h, w] in meters; or a sweep."""

    color: bytes
    color_format: str
    depth: NDArray[np.uint16] | None = None
    depth_sigma_m: NDArray[np.float32] | None = None
    points_lidar: Array | None = None


class Derived(Protocol):
    """A source of depth.

    camera: of the recording. T_color_camera [4, 4]: where it is in that of the log's color images. valid: bool [h, w],
    pixels of the recording's images that show the scene; None: all.
    """

    camera: PinholeCamera
    T_color_camera: Array
    scale: float
    words: str
    valid: Mask | None

    def picture(self, color: Any, partner: Any, color_ns: int, partner_ns: int) -> Picture:
        """Of a color message and that which goes with it.

        Args:
            color: message with the color image (of a stereo pair, the left one).
            partner: message with the right image, or with the points of a LiDAR.
            color_ns: time of the color message.
            partner_ns: time of the other message.
        """
        ...

    def depth_m(self, picture: Picture) -> Array:
        """Depth [h, w] in meters of a picture, 0 = none.

        Args:
            picture: as from `picture`.
        """
        ...


class Stereo:
    """Color is the left image, and is rectified."""

    scale = STEREO_SCALE_M
    words = "stereo"

    def __init__(self, rig: StereoRig, size: tuple[int, int], where: str) -> None:
        """Take the camera of the rectified images, and its rotation from that of the left ones.

        Args:
            rig: rectification and maps of the pair.
            size: width and height of the images as they come, pixels.
            where: begins the line of an error.
        """
        self._frames, self._where = StereoFrames(rig, size), where
        self.camera, self.valid = rig.camera, rig.valid
        self.T_color_camera = se3.from_rotation_translation(rig.R_rectified_left.T, np.zeros(3))

    def check(self, pairs: Sequence[tuple[Any, Any]]) -> dict[str, Any]:
        """The test of the rectification on some pairs of messages.

        Args:
            pairs: messages of the left and the right image.
        """
        return self._frames.check_rows(pairs, self._where)

    def picture(self, color: Any, partner: Any, color_ns: int, partner_ns: int) -> Picture:
        """The rectified left image, and depth with its standard deviation by matching.

        Args:
            color: message with the left image.
            partner: message with the right image.
            color_ns: time of the left image.
            partner_ns: not used.
        """
        data, depth, sigma_m = self._frames.frame(color, partner, f"{self._where} at {color_ns} ns")
        return Picture(data, "png", depth, sigma_m)

    def depth_m(self, picture: Picture) -> Array:
        """Depth [h, w] in meters of a picture, 0 = none.

        Args:
            picture: with depth.
        """
        assert picture.depth is not None
        return np.asarray(picture.depth, dtype=np.float64) * self.scale


class Sweeps:
    """Points of a LiDAR as of the time of the color image; they are drawn when the recording is read."""

    scale = 0.001  # no depth image is written
    words = "lidar, drawn on reading"
    valid: Mask | None = None
    T_color_camera = np.eye(4)

    def __init__(
        self, lidar: LidarSource, color: RosCamera, where: tuple[str, str], warnings: Sequence[str] = ()
    ) -> None:
        """Compute the pose of the LiDAR in the camera of the images.

        Args:
            lidar: seen from the frame of color, as its motion is.
            color: the camera of the images.
            where: of color and points, for the line of an error.
            warnings: what users should know of it.
        """
        self._lidar, self.camera, self._where, self.warnings = lidar, color.camera, where, warnings
        self.T_camera_lidar = color.T_images_frame(where[0]) @ lidar.T_camera_lidar
        self.range_sigma_m = lidar.range_sigma_m

    def picture(self, color: Any, partner: Any, color_ns: int, partner_ns: int) -> Picture:
        """The color image and the points of the sweep, moved to its time.

        Args:
            color: message with the color image.
            partner: message with the points.
            color_ns: time of the color image.
            partner_ns: time of the points.

        Raises:
            DuagError: a message cannot be read.
        """
        where = f"{self._where[0]} at {color_ns} ns"
        data, color_format = color_bytes(color, where)
        if hasattr(color, "format"):
            check_decodes(data, where)
        points = self._lidar.points(partner, partner_ns, color_ns, f"{self._where[1]} at {partner_ns} ns")
        return Picture(data, color_format, points_lidar=points)

    def depth_m(self, picture: Picture) -> Array:
        """Depth [h, w] in meters, 0 = none, drawn from the points of a picture.

        Args:
            picture: with points.
        """
        assert picture.points_lidar is not None
        depth_m, _ = lidar_depth(picture.points_lidar, self.T_camera_lidar, self.camera, self.range_sigma_m)
        return depth_m.astype(np.float64)


def stereo_of(
    log: Log,
    color: tuple[str, str, RosCamera],
    right: tuple[str, str, RosCamera],
    rectified: bool,
    *,
    transforms: Transforms,
    settings: LogOptions,
) -> Stereo:
    """The pair of two image topics.

    Where the right camera is comes from `T_color_depth`, else from the P of its CameraInfo, else from constant
    transforms, or what RealSense's own software recorded.

    Args:
        log: the log.
        color: of the left camera: topic, topic of the CameraInfo, camera.
        right: likewise, of the right camera.
        rectified: whether the images are rectified already.
        transforms: between frames of the log.
        settings: options of the converter.
    Raises:
        DuagError: the pose of the right camera is nowhere.
    """
    where = f"{log.name}: {color[0]} and {right[0]}"
    cameras = [c.camera for c in (color[2], right[2])]
    size = cameras[0].width, cameras[0].height
    raw = [
        RawCamera(c.camera.matrix(), c.distortion, c.camera.width, c.camera.height, c.fisheye)
        for c in (color[2], right[2])
    ]
    if settings.T_color_depth:
        T_right_left = se3.inverse(extrinsics_of("T_color_depth", settings.T_color_depth))
        return Stereo(StereoRig.of(raw[0], raw[1], T_right_left, where, options=settings), size, where)
    infos = [log.first(topic) for topic in (color[1], right[1]) if topic]
    R, P = (
        [np.array(getattr(m, name if hasattr(m, name) else name.lower()), dtype=np.float64) for m in infos]
        for name in ("R", "P")
    )
    if len(P) == 2 and all(p.size == 12 for p in P) and P[1][3] != 0:
        if rectified:
            return Stereo(
                StereoRig.rectified(cameras[0], cameras[1], -P[1][3] / P[1][0], where, options=settings),
                size,
                where,
            )
        for topic, turn in zip((color[1], right[1]), R, strict=True):
            if turn.size != 9:
                raise DuagError(f"{log.name}: {topic}: R of {turn.size} numbers, expected 9")
        projections = [
            _projection(RosCamera.of(info, True, f"{log.name}: {topic}").camera, p)
            for info, topic, p in zip(infos, (color[1], right[1]), P, strict=True)
        ]
        rig = StereoRig.projected(raw[0], raw[1], R, projections, where=where, options=settings)
        return Stereo(rig, size, where)
    frames = color[2].frame_id, right[2].frame_id
    T_left_right = (
        transforms.lookup(*frames) if any(frames) else realsense_extrinsics(log, color[0], right[0], log.name)
    )
    if T_left_right is None:
        raise DuagError(
            f"{where}: P of {right[1] or 'the right camera'} has no base line, and /tf_static does not tie "
            f"{right[2].frame_id!r} to {color[2].frame_id!r}; expected --set T_color_depth='x y z qw qx qy qz' of "
            "the right camera"
        )
    if any(frames):
        T_left_right = between_images(T_left_right, color[2], right[2], log.name)
    rig = StereoRig.of(raw[0], raw[1], se3.inverse(T_left_right), where, options=settings)
    return Stereo(rig, size, where)


def _projection(camera: PinholeCamera, P: Array) -> Array:
    """P [3, 4] of the images, which may be a part of those of the sensor, or have fewer pixels."""
    found = np.array(P, dtype=np.float64).reshape(3, 4)
    found[0, 3] *= camera.fx / found[0, 0]
    found[0, 0], found[1, 1], found[0, 2], found[1, 2] = camera.fx, camera.fy, camera.cx, camera.cy
    return found


def sweeps_of(
    log: Log,
    color: tuple[str, RosCamera],
    topic: str,
    transforms: Transforms,
    *,
    motion: MotionPrior | None,
    settings: LogOptions,
) -> Sweeps:
    """The LiDAR of a topic of points; where it is comes from `T_color_depth`, else from constant transforms.

    Args:
        log: with the points.
        color: topic and camera of the color images.
        topic: of the points.
        transforms: constant transforms of the log.
        motion: how the robot moves meanwhile; None: not known, and the sweeps stay as they are.
        settings: options of the conversion, with `T_color_depth` and `range_sigma_m`.

    Raises:
        DuagError: nothing says where it is.
    """
    frame = log.first(topic).header.frame_id
    where = f"{log.name}: {color[0]}", f"{log.name}: {topic}"
    if settings.T_color_depth:
        T_images_lidar = extrinsics_of("T_color_depth", settings.T_color_depth)
        T: Array | None = se3.inverse(color[1].T_images_frame(where[0])) @ T_images_lidar
    else:
        T = transforms.lookup(color[1].frame_id, frame)
    if T is None:
        raise DuagError(
            f"{log.name}: {topic} is of {frame!r}, and /tf_static does not tie it to {color[1].frame_id!r}; "
            "expected --set T_color_depth='x y z qw qx qy qz' of the LiDAR"
        )
    some = list(islice(log.messages(topic), TIMED_SWEEPS))
    lidar = LidarSource(T, settings.range_sigma_m, motion, PointTimes.found(some, where[1]))
    warnings = list[str]()
    if motion is None:
        warnings.append(
            "sweeps hold what the LiDAR moved meanwhile; expected --set imu=TOPIC or odometry=TOPIC to take it out"
        )
    elif lidar.times.words:
        warnings.append(f"{topic}: {lidar.times.words}")
    if not settings.T_color_depth:
        warnings += body_axes_of_camera(color[1].frame_id, frame, T, "T_color_depth")
    return Sweeps(lidar, color[1], where, warnings)


def some_pairs(pairs: dict[int, int]) -> list[tuple[int, int]]:
    """Up to `ROW_PAIRS` pairs of times, evenly spread.

    Args:
        pairs: time of the partner by time of the color image, ns.
    """
    stamps = sorted(pairs)
    return [(stamps[k], pairs[stamps[k]]) for k in sorted(spread(len(stamps), ROW_PAIRS))]
