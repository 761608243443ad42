"""Whether depth, intrinsics, color and motion belong together."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.checks.findings import Finding, Severity
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import visible
from duagc.pipeline.recording import RgbdFrame, RgbdLog
from duagc.pipeline.registration import Reference, RgbdPyramid, register

Array = NDArray[np.float64]
Image = NDArray[np.float32]

# --- intrinsics

OFF_CENTER = 0.1  # of the image's width or height
SQUARE = 0.05
VIEWS_DEG = (15.0, 150.0)

# --- depth moved into a later frame

MOVES = 8  # pairs of frames
MOVE_NS = 150_000_000  # between the frames of a pair
RESIDUAL = 0.03  # of the depth
FEW_REGISTERED = 0.5

# --- scale

SCALES = (0.6, 1.6)  # of lengths by registration relative to those by another sensor
FAR_ENOUGH_M = 0.004  # a pair that moved less determines no scale
NEAR_M, FAR_M = 0.1, 100.0
SENSOR_M = 14.0  # no camera with its own light sees farther
FAST_M_PER_S = 4.0
MEASURED_AFAR = ("stereo", "lidar", "render", "simulat")  # words about a sensor that may see farther

# --- color edges

STEP = 0.06  # relative step of depth that is an edge
EDGE_PIXELS = 200
SHIFTS = 4  # frames
WINDOWS = 8
SHIFT_PX = 24
CLEARLY = 1.15  # ratio of two mean gradients


def check_camera(robot: str, camera: PinholeCamera) -> Iterator[Finding]:
    """Findings about the intrinsics alone."""
    for axis, center, size in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        if abs(center - (size - 1) / 2) > OFF_CENTER * size:
            yield Finding(
                Severity.WARNING,
                "intrinsics",
                robot,
                f"{axis} = {center:.1f} px in an image of {camera.width}x{camera.height}",
                f"within {OFF_CENTER:.0%} of its middle, {(size - 1) / 2:.1f}",
                "see whether cx and cy are exchanged, or the calibration is of another resolution",
            )
    if abs(camera.fx / camera.fy - 1) > SQUARE:
        yield Finding(
            Severity.WARNING,
            "intrinsics",
            robot,
            f"focal lengths {camera.fx:.1f} and {camera.fy:.1f} px",
            f"equal to {SQUARE:.0%}",
            "pixels are square in almost all cameras",
        )
    view = float(np.degrees(2 * np.arctan2(camera.width / 2, camera.fx)))
    if not VIEWS_DEG[0] <= view <= VIEWS_DEG[1]:
        yield Finding(
            Severity.WARNING,
            "intrinsics",
            robot,
            f"a focal length of {camera.fx:.1f} px sees {view:.0f} degrees of {camera.width} px",
            f"{VIEWS_DEG[0]:g} to {VIEWS_DEG[1]:g} degrees",
            "see whether the calibration is of another resolution",
        )


@dataclass(frozen=True)
class Move:
    """A pair of frames. T_first_second [4, 4], by registration; None if that failed. residual: median difference of
    depth moved into the other frame, relative."""

    first_ns: int
    second_ns: int
    T_first_second: Array | None
    residual: float


def moves(log: RgbdLog) -> list[Move]:
    """Pairs of frames spread over the log, each registered and the depth of one moved into the other."""
    stamps = np.array([color for color, _ in log.pairing.pairs], dtype=np.int64)
    found = []
    last = len(stamps) - 1
    for first in np.unique(np.linspace(0, last - 1, min(MOVES, last)).astype(int)).tolist():
        near = int(np.searchsorted(stamps, stamps[first] + MOVE_NS, side="right")) - 1
        frame = log.frame(first)
        for second in sorted({max(near, first + 1), first + 1}, reverse=True):
            move = _move(frame, log.frame(second), log.camera)
            if move.T_first_second is not None:
                break
        found.append(move)
    return found


def _move(first: RgbdFrame, second: RgbdFrame, camera: PinholeCamera) -> Move:
    a, b = (
        RgbdPyramid.build(
            frame.color.astype(np.float32) / 255,
            frame.usable_depth,
            camera,
            depth_sigma_m=frame.depth_sigma,
        )
        for frame in (first, second)
    )
    result = register(Reference.from_pyramid(a), b, np.eye(4))
    T = result.T_reference_target if result.ok else None
    residual = np.nan if T is None else _residual(first.usable_depth, second.usable_depth, T, camera)
    return Move(first.stamp_ns, second.stamp_ns, T, residual)


def _residual(first_m: Image, second_m: Image, T_first_second: Array, camera: PinholeCamera) -> float:
    points = camera.back_project(first_m)[::4, ::4].reshape(-1, 3)
    points = se3.transform(se3.inverse(T_first_second), points[points[:, 2] > 0])
    index, u, v = visible(camera, points, near_m=0.0)
    expected, found = points[index, 2], second_m[v, u]
    both = found > 0
    return float(np.median(np.abs(found - expected)[both] / expected[both])) if both.any() else np.nan


def check_moves(robot: str, found: list[Move]) -> Iterator[Finding]:
    """Findings about depth moved into later frames."""
    registered = [move for move in found if move.T_first_second is not None]
    if found and len(registered) < FEW_REGISTERED * len(found):
        yield Finding(
            Severity.WARNING,
            "reprojection",
            robot,
            f"{len(registered)} of {len(found)} pairs of near frames could be registered",
            f"{FEW_REGISTERED:.0%} or more",
            "tracking will be lost; see whether color and depth are of one time and place, and the rate is enough",
        )
    residuals = [move.residual for move in registered if np.isfinite(move.residual)]
    if residuals and np.median(residuals) > RESIDUAL:
        yield Finding(
            Severity.WARNING,
            "reprojection",
            robot,
            f"depth moved into a later frame differs by {np.median(residuals):.1%} (median)",
            f"less than {RESIDUAL:.0%}",
            "see whether depth is along z and not along the ray, and the intrinsics are those of these images",
        )


def check_scale(
    robot: str, found: list[Move], sensor: str, lengths: Callable[[int, int], float | None]
) -> Iterator[Finding]:
    """Compare lengths by registration with those of another sensor.

    Args:
        sensor: its name in words. lengths: meters moved between two times (ns), None where it does not know.
    """
    ratios = []
    for move in found:
        other = lengths(move.first_ns, move.second_ns)
        if move.T_first_second is None or other is None or other < FAR_ENOUGH_M:
            continue
        ratios.append(float(np.linalg.norm(move.T_first_second[:3, 3])) / other)
    if len(ratios) >= 2 and not SCALES[0] <= np.median(ratios) <= SCALES[1]:
        yield Finding(
            Severity.ERROR,
            "depth scale",
            robot,
            f"the camera moves {np.median(ratios):.3g} times as far by its depth as by {sensor}",
            "1",
            "depth_scale, or the unit of the poses, is wrong by this factor",
        )


def check_range(
    robot: str, depth_m: tuple[float, float, float], found: list[Move], sensors: str
) -> Iterator[Finding]:
    """Findings about distances and speeds that nothing else contradicts. sensors: what the log says about them."""
    _, middle, high = depth_m
    if not NEAR_M <= middle <= FAR_M:
        yield Finding(
            Severity.ERROR,
            "depth scale",
            robot,
            f"half of the depth is beyond {middle:.3g} m",
            f"{NEAR_M:g} to {FAR_M:g} m",
            "depth_scale must be meters per unit: 0.001 for millimeters",
        )
    elif high > SENSOR_M and not any(word in sensors.lower() for word in MEASURED_AFAR):
        yield Finding(
            Severity.WARNING,
            "depth scale",
            robot,
            f"depth reaches {high:.1f} m (99 %)",
            f"at most {SENSOR_M:g} m, unless from stereo, a LiDAR or a simulator",
            "see whether depth_scale is meters per unit",
        )
    speeds = [
        np.linalg.norm(move.T_first_second[:3, 3]) / ((move.second_ns - move.first_ns) * 1e-9)
        for move in found
        if move.T_first_second is not None
    ]
    if speeds and np.median(speeds) > FAST_M_PER_S:
        yield Finding(
            Severity.WARNING,
            "depth scale",
            robot,
            f"the camera moves at {np.median(speeds):.1f} m/s (median)",
            f"at most {FAST_M_PER_S:g} m/s",
            "see whether depth_scale is meters per unit, and the times are right",
        )


@dataclass(frozen=True)
class DepthEdges:
    """Mean gray gradient under the edges of depth, relative to that of the images.

    by_frames: [2 * SHIFTS + 1] with the depth of -SHIFTS ... SHIFTS frames later. by_pixels: [2 * SHIFT_PX + 1] with
    the depth moved by -SHIFT_PX ... SHIFT_PX px to the right. windows: how many frames it is the mean of.
    """

    by_frames: Array
    by_pixels: Array
    windows: int


def edges_of(log: RgbdLog) -> DepthEdges | None:
    """How well edges of depth fall on edges of gray; None if the log is short or has no edges."""
    frames = len(log)
    if frames < 2 * SHIFTS + 2:
        return None
    by_frames, by_pixels = [], []
    for middle in np.unique(np.linspace(SHIFTS, frames - 1 - SHIFTS, WINDOWS).astype(int)).tolist():
        frame = log.frame(middle)
        gradient = _gradient(frame.color)
        near = [_depth_edges(log.frame(middle + k).depth) for k in range(-SHIFTS, SHIFTS + 1)]
        if min(int(edges.sum()) for edges in near) < EDGE_PIXELS:
            continue
        by_frames.append([gradient[edges].mean() for edges in near])
        v, u = np.nonzero(near[SHIFTS])
        inner = (u >= SHIFT_PX) & (u < gradient.shape[1] - SHIFT_PX)
        if inner.sum() < EDGE_PIXELS:
            continue
        moved = [gradient[v[inner], u[inner] + d].mean() for d in range(-SHIFT_PX, SHIFT_PX + 1)]
        by_pixels.append(moved)
    if not by_frames or not by_pixels:
        return None
    return DepthEdges(np.mean(by_frames, axis=0), np.mean(by_pixels, axis=0), len(by_frames))


def _gradient(color: NDArray[np.uint8]) -> Image:
    """Size of the gray gradient, relative to its mean over the image."""
    import cv2

    gray = cv2.GaussianBlur(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 0.8)
    size = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    return np.asarray(size / max(float(size.mean()), 1e-6), dtype=np.float32)


def _depth_edges(depth_m: Image) -> NDArray[np.bool_]:
    """Pixels of the nearer surface at a step of depth."""
    out = np.zeros(depth_m.shape, dtype=bool)
    for a, b, at_a, at_b in (
        (depth_m[:-1], depth_m[1:], out[:-1], out[1:]),
        (depth_m[:, :-1], depth_m[:, 1:], out[:, :-1], out[:, 1:]),
    ):
        step = (a > 0) & (b > 0) & (np.abs(a - b) > STEP * np.minimum(a, b))
        at_a |= step & (a < b)
        at_b |= step & (b < a)
    return out


def check_edges(robot: str, edges: DepthEdges | None) -> Iterator[Finding]:
    """Findings about depth that is not of the time, or not of the place, of its color."""
    if edges is None or edges.windows < WINDOWS // 2:
        return
    frames, pixels = (int(np.argmax(a)) for a in (edges.by_frames, edges.by_pixels))
    if edges.by_frames[frames] > CLEARLY * edges.by_frames[SHIFTS]:
        shift = frames - SHIFTS
        yield Finding(
            Severity.WARNING,
            "depth in time",
            robot,
            f"edges of color fit the depth {abs(shift)} frames {'later' if shift > 0 else 'earlier'} better by "
            f"{edges.by_frames[frames] / edges.by_frames[SHIFTS] - 1:.0%}",
            "best fit at its own time",
            "color and depth are of different times; correct the times of one of them",
        )
    elif edges.by_pixels[pixels] > CLEARLY * edges.by_pixels[SHIFT_PX] and abs(pixels - SHIFT_PX) > 2:
        yield Finding(
            Severity.WARNING,
            "depth in place",
            robot,
            f"edges of color fit the depth {pixels - SHIFT_PX:+d} px to the right better by "
            f"{edges.by_pixels[pixels] / edges.by_pixels[SHIFT_PX] - 1:.0%}",
            "best fit where it is",
            "register the depth to the color camera",
        )
