"""Depth that was taken at another time than its color image, as the camera saw it when the color was taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.inverse_depth import inverse_or_zero
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording.depth_sources import DepthImage
from duagc.pipeline.recording.read import log_metadata, read_log
from duagc.schemas import topics

Image = NDArray[np.float32]
DELAY_KEY = "depth_delay_ns"
"""In the metadata of a front end's log: how much earlier than its stamps say depth was taken; without it, not."""
LEAST_MOVE_PX = 0.25  # of a point at the median depth: less is not worth to interpolate for
FARTHEST_EDGE_PX = 24  # of a nearer surface that may come to lie over a pixel


def depth_delay_ns(frontend: Path) -> int:
    """How much earlier than its stamps say depth was taken, as the front end found it, nanoseconds.

    Args:
        frontend: frontend.mcap of a robot, or of a component.
    """
    text = log_metadata(frontend).get(DELAY_KEY, "0")
    try:
        return int(text)
    except ValueError:
        raise DuagError(f"{frontend}: {DELAY_KEY} is {text!r}, expected nanoseconds") from None


def tracked_frames(frontend: Path) -> Trajectory:
    """T_map_camera of the frames that a front end gave a pose.

    Args:
        frontend: frontend.mcap of a robot, or of a component.
    """
    frames = [record.message() for record in read_log(frontend, (topics.ODOMETRY,))]
    placed = [frame for frame in frames if frame.status != "lost"]
    stamps = np.array([frame.stamp_ns for frame in placed], dtype=np.int64)
    return Trajectory(stamps, np.array([frame.T_map_camera for frame in placed]).reshape(-1, 4, 4))


def move_depth(depth: DepthImage, camera: PinholeCamera, T_color_depth: Array) -> DepthImage:
    """A depth image as the same camera saw it from a place next to it.

    For each pixel the point is looked up that projects there (`kernels.moved_depth`); the search begins at the nearest
    surface around, which hides the others. What no point projects to, as behind an edge, is unknown. A motion of less
    than a quarter of a pixel changes nothing.

    Args:
        depth: meters along z of the camera when depth was taken, 0 = unknown.
        camera: of both.
        T_color_depth: [4, 4], from the camera when depth was taken to the camera when color was.
    """
    import cv2

    from duagc.pipeline.kernels.moved_depth import found_points

    if not _move_px(depth.depth_m, camera, T_color_depth, 50) >= LEAST_MOVE_PX:
        return depth
    known = depth.depth_m > 0
    inverse = inverse_or_zero(depth.depth_m).astype(np.float32)
    farthest_px = _move_px(depth.depth_m, camera, T_color_depth, 1)
    side = 2 * min(int(np.ceil(farthest_px)) + 1, FARTHEST_EDGE_PX) + 1
    nearest = np.asarray(cv2.dilate(inverse, np.ones((side, side), dtype=np.uint8)), dtype=np.float32)
    middle = float(np.median(inverse[known]))
    found, u, v = found_points(inverse, nearest, camera, T_color_depth, middle=middle)
    moved = inverse_or_zero(found)
    if depth.sigma_m is None:
        return DepthImage(moved)
    return DepthImage(moved, np.where(found > 0, _nearest(depth.sigma_m, u, v), np.float32(0)))


def _move_px(depth_m: Image, camera: PinholeCamera, T_color_depth: Array, percentile: float) -> float:
    """About how far a point at a percentile of the depth moves in the image; 0 where there is no depth."""
    near = depth_m[::8, ::8]
    near = near[near > 0]
    if not len(near):
        return 0.0
    angle = float(np.linalg.norm(so3.log(T_color_depth[:3, :3])))
    return camera.fx * (
        angle + float(np.linalg.norm(T_color_depth[:3, 3])) / float(np.percentile(near, percentile))
    )


def _nearest(image: Image, u: Image, v: Image) -> Image:
    """Values of the nearest pixels; 0 outside."""
    import cv2

    return np.asarray(cv2.remap(image, u, v, cv2.INTER_NEAREST), dtype=np.float32)
