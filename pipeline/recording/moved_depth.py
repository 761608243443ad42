"""Depth that was taken at another time than its color image, as the camera saw it when the color was taken."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording.depth_sources import DepthImage
from duagc.pipeline.recording.read import log_metadata, read_log
from duagc.schemas import topics

Image = NDArray[np.float32]
DELAY_KEY = "depth_delay_ns"
"""In the metadata of a front end's log: how much earlier than its stamps say depth was taken; without it, not."""
SAME_SURFACE = np.float32(0.03)  # relative step of depth up to which neighbors are one surface
LEAST_MOVE_PX = 0.25  # of a point at the median depth: less is not worth to interpolate for
ROUNDS = 3  # of looking up where in the depth image a pixel was; each brings it nearer by the share that depth changes
MOST_OFF_PX = 0.7  # of a found point from its pixel
FARTHEST_EDGE_PX = 24  # of a nearer surface that may come to lie over a pixel
STRIP_PX = 1 << 14  # pixels at a time: what is computed of them stays in the cache
REACH_NS = 250_000_000  # from a frame to those by which its motion is known
FRAMES_AROUND = 3  # of these, before and after it


class DepthMotion:
    """How the camera moved between the times of color and depth, by the poses of its frames.

    A pose that was found with color and depth of different times lies between the two. So the motion is that of a
    smooth curve through the poses of the frames around, not that from one to the next.
    """

    def __init__(self, *parts: Trajectory) -> None:
        """Set up.

        Args:
            parts: T_map_camera of the tracked frames; of every part that has a frame of its own.
        """
        self._parts = parts

    def between(self, color_ns: int, depth_ns: int) -> Array | None:
        """T_color_depth [4, 4], from the camera when depth was taken to the camera when color was.

        Args:
            color_ns: time of a frame.
            depth_ns: time of its depth.

        Returns:
            The motion; None where the poses do not say.
        """
        found = self.at(color_ns, np.array([depth_ns], dtype=np.int64))
        return None if found is None else found[0]

    def at(self, color_ns: int, times_ns: NDArray[np.int64]) -> Array | None:
        """T_color_then [n, 4, 4], from the camera at some times to the camera when a color image was taken.

        Args:
            color_ns: time of a frame.
            times_ns: [n], near it.

        Returns:
            The motions; None where the poses do not say.
        """
        for part in self._parts:
            at = int(np.searchsorted(part.stamps_ns, color_ns))
            if at < len(part.stamps_ns) and part.stamps_ns[at] == color_ns:
                return _motion_in(part, at, times_ns - color_ns)
        return None


def _motion_in(part: Trajectory, at: int, durations_ns: NDArray[np.int64]) -> Array | None:
    """Motions [n, 4, 4] of the camera in some times from a frame; None without other frames near it."""
    offsets_ns = part.stamps_ns - part.stamps_ns[at]
    near = np.flatnonzero(np.abs(offsets_ns) <= REACH_NS)
    first = max(int(np.searchsorted(near, at)) - FRAMES_AROUND, 0)
    first = max(min(first, len(near) - 2 * FRAMES_AROUND - 1), 0)
    chosen = near[first : first + 2 * FRAMES_AROUND + 1]
    if len(chosen) < 2:
        return None
    seconds = 1e-9 * offsets_ns[chosen]
    motions = se3.log(se3.inverse(part.poses[at]) @ part.poses[chosen])
    degree = 2 if len(chosen) > 3 else 1
    curve = np.linalg.lstsq(np.vander(seconds, degree + 1), motions, rcond=None)[0]
    then = np.vander(1e-9 * durations_ns, degree + 1) @ curve
    return np.asarray(se3.inverse(se3.exp(curve[-1])) @ se3.exp(then))


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

    For each pixel the point is looked up that projects there: from the depth of the last round to the pixel of the
    depth image, inverse depth there (interpolated within a surface, exact on planes), and back. The search begins at
    the nearest surface around, which hides the others. What no point projects to, as behind an edge, is unknown. A
    motion of less than a quarter of a pixel changes nothing.

    Args:
        depth: meters along z of the camera when depth was taken, 0 = unknown.
        camera: of both.
        T_color_depth: [4, 4], from the camera when depth was taken to the camera when color was.
    """
    import cv2

    if not _move_px(depth.depth_m, camera, T_color_depth, 50) >= LEAST_MOVE_PX:
        return depth
    known = depth.depth_m > 0
    inverse = np.where(known, 1 / np.where(known, depth.depth_m, 1), 0).astype(np.float32)
    search = _Search(camera, T_color_depth, inverse)
    farthest_px = _move_px(depth.depth_m, camera, T_color_depth, 1)
    side = 2 * min(int(np.ceil(farthest_px)) + 1, FARTHEST_EDGE_PX) + 1
    nearest = np.asarray(cv2.dilate(inverse, np.ones((side, side), dtype=np.uint8)), dtype=np.float32)
    middle = np.float32(np.median(inverse[known]))
    found, u, v = search.from_start(np.where(nearest > 0, nearest, middle))
    missing = np.nonzero(found == 0)
    others = search.at(missing, np.where(known, inverse, middle)[missing])
    found[missing], u[missing], v[missing] = others
    moved = np.where(found > 0, 1 / np.where(found > 0, found, 1), np.float32(0))
    if depth.sigma_m is None:
        return DepthImage(moved)
    return DepthImage(moved, np.where(found > 0, _nearest(depth.sigma_m, u, v), np.float32(0)))


class _Search:
    """Looks up which point of a depth image projects to each pixel of the camera from another place."""

    def __init__(self, camera: PinholeCamera, T_color_depth: Array, inverse: Image) -> None:
        self._camera, self._T_color_depth, self._inverse = camera, T_color_depth, inverse
        self._T_depth_color = se3.inverse(T_color_depth)
        self._smooth = _smooth(inverse)
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = (np.arange(camera.height) - camera.cy) / camera.fy
        self._x, self._y = np.meshgrid(x.astype(np.float32), y.astype(np.float32), copy=False)

    def from_start(self, start: Image) -> tuple[Image, Image, Image]:
        """Inverse depth [h, w] (0 where nothing was found) and the columns and rows in the depth image.

        Args:
            start: inverse depth [h, w], positive, that the search begins with.
        """
        height, width = start.shape
        found = tuple(np.empty_like(start) for _ in range(3))
        step = max(STRIP_PX // width, 1)
        for rows in (slice(top, top + step) for top in range(0, height, step)):
            for whole, strip in zip(
                found, self._rounds(start[rows], self._x[rows], self._y[rows]), strict=True
            ):
                whole[rows] = strip
        return found[0], found[1], found[2]

    def at(self, pixels: tuple[NDArray[np.intp], ...], start: Image) -> Image:
        """The same [3, n] of some pixels.

        Args:
            pixels: rows and columns, each [n].
            start: inverse depth [n], positive, that the search begins with.
        """
        x, y = self._x[pixels], self._y[pixels]
        found = np.empty((3, len(start)), dtype=np.float32)
        for part in (slice(first, first + STRIP_PX) for first in range(0, len(start), STRIP_PX)):
            found[:, part] = np.stack(self._rounds(start[None, part], x[None, part], y[None, part]))[:, 0]
        return found

    def _rounds(self, start: Image, ray_x: Image, ray_y: Image) -> tuple[Image, Image, Image]:
        """Inverse depth, columns and rows [k, l] of pixels with rays (x, y, 1)."""
        camera, found = self._camera, start
        off = np.full(start.shape, np.inf, dtype=np.float32)
        u, v = ray_x, ray_y
        for _ in range(ROUNDS):
            u, v = _pixels(camera, self._T_depth_color, (ray_x / found, ray_y / found, np.float32(1) / found))
            there = _look_up(self._inverse, self._smooth, u, v)
            seen = there > 0
            depth_m = np.float32(1) / np.where(seen, there, np.float32(1))
            there_x = (u - np.float32(camera.cx)) / np.float32(camera.fx) * depth_m
            there_y = (v - np.float32(camera.cy)) / np.float32(camera.fy) * depth_m
            x, y, z = _transformed(self._T_color_depth, (there_x, there_y, depth_m))
            front = seen & (z > np.float32(0.05))
            z = np.where(front, z, np.float32(1))
            off_u = (x / z - ray_x) * np.float32(camera.fx)
            off_v = (y / z - ray_y) * np.float32(camera.fy)
            off = np.where(front, np.hypot(off_u, off_v), np.float32(np.inf))
            found = np.where(front, np.float32(1) / z, found)
        return np.where(off < np.float32(MOST_OFF_PX), found, np.float32(0)), u, v


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


def _smooth(inverse: Image) -> NDArray[np.uint8]:
    """Pixels (1) whose right, lower and lower right neighbors are on their surface."""
    corners = np.stack([inverse[:-1, :-1], inverse[:-1, 1:], inverse[1:, :-1], inverse[1:, 1:]])
    lowest = corners.min(axis=0)
    smooth = np.zeros(inverse.shape, dtype=np.uint8)
    smooth[:-1, :-1] = (lowest > 0) & (corners.max(axis=0) <= (1 + SAME_SURFACE) * lowest)
    return smooth


def _look_up(inverse: Image, smooth: NDArray[np.uint8], u: Image, v: Image) -> Image:
    """Inverse depth at pixels: interpolated within a surface, else that of the nearest pixel; 0 where unknown."""
    import cv2

    whole = np.asarray(cv2.remap(smooth, np.floor(u), np.floor(v), cv2.INTER_NEAREST), dtype=bool)
    between = cv2.remap(inverse, u, v, cv2.INTER_LINEAR)
    return np.where(whole, between, _nearest(inverse, u, v)).astype(np.float32)


def _nearest(image: Image, u: Image, v: Image) -> Image:
    """Values of the nearest pixels; 0 outside."""
    import cv2

    return np.asarray(cv2.remap(image, u, v, cv2.INTER_NEAREST), dtype=np.float32)


def _transformed(T: Array, points: Sequence[NDArray[np.floating]]) -> list[Image]:
    """Coordinates x, y, z [h, w] of points in another frame, float32."""
    R, t = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
    return [R[k, 0] * points[0] + R[k, 1] * points[1] + R[k, 2] * points[2] + t[k] for k in range(3)]


def _pixels(camera: PinholeCamera, T: Array, points: Sequence[Image]) -> tuple[Image, Image]:
    """Columns and rows [h, w] of points in another frame; far outside where they are behind the camera."""
    x, y, z = _transformed(T, points)
    front = np.maximum(z, np.float32(1e-3))
    u = np.float32(camera.fx) * x / front + np.float32(camera.cx)
    v = np.float32(camera.fy) * y / front + np.float32(camera.cy)
    return np.clip(u, -1e4, 1e4), np.clip(v, -1e4, 1e4)
