"""Whether depth, intrinsics, color and motion belong together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.checks.confidence import share_above
from duagc.pipeline.checks.findings import Finding, Severity
from duagc.pipeline.checks.images import FEW_FRAMES, Sight
from duagc.pipeline.checks.moves import Move
from duagc.pipeline.config.checks import CameraChecks, EdgeChecks, MotionChecks
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import RgbdLog

Image = NDArray[np.float32]

MEASURED_AFAR = ("stereo", "lidar", "render", "simulat")  # words about a sensor that may see farther
LESS = 0.99  # of another residual: less by more than rounding


def check_camera(robot: str, camera: PinholeCamera, config: CameraChecks) -> Iterator[Finding]:
    """Findings about the intrinsics alone.

    Args:
        robot: whose camera it is.
        camera: of its color images, pixels.
        config: thresholds.
    """
    for axis, center, size in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        if abs(center - (size - 1) / 2) > config.max_off_center * size:
            yield Finding(
                Severity.WARNING,
                "intrinsics",
                robot,
                f"{axis} = {center:.1f} px in an image of {camera.width}x{camera.height}",
                f"within {config.max_off_center:.0%} of its middle, {(size - 1) / 2:.1f}",
                "see whether cx and cy are exchanged, or the calibration is of another resolution",
            )
    if abs(camera.fx / camera.fy - 1) > config.max_focal_difference:
        yield Finding(
            Severity.WARNING,
            "intrinsics",
            robot,
            f"focal lengths {camera.fx:.1f} and {camera.fy:.1f} px",
            f"equal to {config.max_focal_difference:.0%}",
            "pixels are square in almost all cameras",
        )
    view = float(np.degrees(2 * np.arctan2(camera.width / 2, camera.fx)))
    if not config.views_deg[0] <= view <= config.views_deg[1]:
        yield Finding(
            Severity.WARNING,
            "intrinsics",
            robot,
            f"a focal length of {camera.fx:.1f} px sees {view:.0f} degrees of {camera.width} px",
            f"{config.views_deg[0]:g} to {config.views_deg[1]:g} degrees",
            "see whether the calibration is of another resolution",
        )


def check_moves(robot: str, found: list[Move], config: MotionChecks) -> Iterator[Finding]:
    """Findings about depth moved into later frames.

    Args:
        robot: whose frames they are.
        found: pairs of near frames; none: no findings.
        config: thresholds.
    """
    registered = [move for move in found if move.T_first_second is not None]
    if found and len(registered) < config.min_registered * len(found):
        yield Finding(
            Severity.WARNING,
            "reprojection",
            robot,
            f"{len(registered)} of {len(found)} pairs of near frames could be registered",
            f"{config.min_registered:.0%} or more",
            "tracking will be lost; see whether color and depth are of one time and place, and the rate is enough",
            confidence=share_above(len(found) - len(registered), len(found), 1 - config.min_registered),
        )
    both = [m for m in registered if np.isfinite(m.residual) and np.isfinite(m.residual_as_range)]
    if both:
        z, ray = np.median([(m.residual, m.residual_as_range) for m in both], axis=0)
        yield Finding(
            Severity.WARNING,
            "depth along z",
            robot,
            f"depth moved into a later frame differs by {z:.2%}, and by {ray:.2%} if it is a distance along the ray",
            "depth along z",
            "convert the log with --set depth_along=ray, or divide depth by the length of the ray of its pixel",
            confidence=share_above(sum(m.residual_as_range < LESS * m.residual for m in both), len(both)),
        )
    residuals = np.array([move.residual for move in registered if np.isfinite(move.residual)])
    if len(residuals) and np.median(residuals) > config.max_residual:
        yield Finding(
            Severity.WARNING,
            "reprojection",
            robot,
            f"depth moved into a later frame differs by {np.median(residuals):.1%} (median)",
            f"less than {config.max_residual:.0%}",
            "see whether depth is along z and not along the ray, and the intrinsics are those of these images",
            confidence=share_above(int((residuals > config.max_residual).sum()), len(residuals)),
        )


def check_range(
    robot: str, sight: Sight, found: list[Move], sensors: str, *, config: MotionChecks
) -> Iterator[Finding]:
    """Findings about distances and speeds that nothing else contradicts.

    Args:
        robot: whose frames they are.
        sight: what some frames show.
        found: pairs of near frames.
        sensors: what the log says about them, as text.
        config: thresholds.
    """
    _, middle, high = sight.depth_m
    low_m, high_m = config.median_depth_m
    middles, highs = sight.depth_of_frames[:, 1], sight.depth_of_frames[:, 2]
    if not low_m <= middle <= high_m:
        yield Finding(
            Severity.ERROR,
            "depth scale",
            robot,
            f"half of the depth is beyond {middle:.3g} m",
            f"{low_m:g} to {high_m:g} m",
            "depth_scale must be meters per unit: 0.001 for millimeters",
            confidence=share_above(int(((middles < low_m) | (middles > high_m)).sum()), len(middles)),
        )
    elif high > config.max_depth_m and not any(word in sensors.lower() for word in MEASURED_AFAR):
        far = int((highs > config.max_depth_m).sum())
        yield Finding(
            Severity.WARNING,
            "depth scale",
            robot,
            f"depth reaches {high:.1f} m (99 %)",
            f"at most {config.max_depth_m:g} m, unless from stereo, a LiDAR or a simulator",
            "see whether depth_scale is meters per unit",
            confidence=share_above(far, len(highs), FEW_FRAMES),
        )
    speeds = np.array([move.speed_m_s for move in found if move.T_first_second is not None])
    if len(speeds) and np.median(speeds) > config.max_speed_m_per_s:
        yield Finding(
            Severity.WARNING,
            "depth scale",
            robot,
            f"the camera moves at {np.median(speeds):.1f} m/s (median)",
            f"at most {config.max_speed_m_per_s:g} m/s",
            "see whether depth_scale is meters per unit, and the times are right",
            confidence=share_above(int((speeds > config.max_speed_m_per_s).sum()), len(speeds)),
        )


@dataclass(frozen=True)
class DepthEdges:
    """Mean gray gradient under the edges of depth of some frames, relative to that of the images.

    Attributes:
        frames_of: [windows, 2 n + 1] with the depth of -n ... n frames later, n being `shift_frames`.
        pixels_of: [k, 2 m + 1] with the depth moved by -m ... m px to the right, m being `shift_px`.
    """

    frames_of: Array
    pixels_of: Array

    @property
    def by_frames(self) -> Array:
        """Mean of `frames_of`."""
        return np.asarray(self.frames_of.mean(axis=0))

    @property
    def by_pixels(self) -> Array:
        """Mean of `pixels_of`."""
        return np.asarray(self.pixels_of.mean(axis=0))

    @property
    def windows(self) -> int:
        """How many frames it is the mean of."""
        return len(self.frames_of)


def edges_of(log: RgbdLog, config: EdgeChecks) -> DepthEdges | None:
    """How well edges of depth fall on edges of gray; None if the log is short or has no edges.

    Args:
        log: of the robot.
        config: number of frames, shifts (frames, pixels), step of depth that is an edge.
    """
    frames, shifts, reach = len(log), config.shift_frames, config.shift_px
    if frames < 2 * shifts + 2:
        return None
    by_frames, by_pixels = [], []
    spread = np.linspace(shifts, frames - 1 - shifts, config.frames)
    for middle in np.unique(spread.astype(int)).tolist():
        frame = log.frame(middle)
        gradient = _gradient(frame.color)
        near = [_depth_edges(log.usable_depth(middle + k), config.step) for k in range(-shifts, shifts + 1)]
        if min(int(edges.sum()) for edges in near) < config.min_pixels:
            continue
        by_frames.append([gradient[edges].mean() for edges in near])
        v, u = np.nonzero(near[shifts])
        inner = (u >= reach) & (u < gradient.shape[1] - reach)
        if inner.sum() < config.min_pixels:
            continue
        moved = [gradient[v[inner], u[inner] + d].mean() for d in range(-reach, reach + 1)]
        by_pixels.append(moved)
    if not by_frames or not by_pixels:
        return None
    return DepthEdges(np.array(by_frames), np.array(by_pixels))


def _gradient(color: NDArray[np.uint8]) -> Image:
    """Size of the gray gradient, relative to its mean over the image."""
    import cv2

    gray = cv2.GaussianBlur(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 0.8)
    size = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    return np.asarray(size / max(float(size.mean()), 1e-6), dtype=np.float32)


def _depth_edges(depth_m: Image, step: float) -> NDArray[np.bool_]:
    """Pixels of the nearer surface at a relative step of depth."""
    out = np.zeros(depth_m.shape, dtype=bool)
    for a, b, at_a, at_b in (
        (depth_m[:-1], depth_m[1:], out[:-1], out[1:]),
        (depth_m[:, :-1], depth_m[:, 1:], out[:, :-1], out[:, 1:]),
    ):
        edge = (a > 0) & (b > 0) & (np.abs(a - b) > step * np.minimum(a, b))
        at_a |= edge & (a < b)
        at_b |= edge & (b < a)
    return out


def check_edges(robot: str, edges: DepthEdges | None, config: EdgeChecks) -> Iterator[Finding]:
    """Findings about depth that is not of the time, or not of the place, of its color.

    Args:
        robot: whose frames they are.
        edges: of `edges_of`; None: no findings.
        config: thresholds.
    """
    if edges is None or edges.windows < config.frames // 2:
        return
    shifts, reach = config.shift_frames, config.shift_px
    frames, pixels = (int(np.argmax(a)) for a in (edges.by_frames, edges.by_pixels))
    # late depth fits better from frame to frame up to its own; of smoothed depth few edges are left, which fit anywhere
    own_time, others = edges.by_frames[shifts], edges.by_frames[[shifts - 1, shifts + 1]]
    if edges.by_frames[frames] > config.clear_ratio * own_time and own_time < others.max():
        shift = frames - shifts
        yield Finding(
            Severity.WARNING,
            "depth in time",
            robot,
            f"edges of color fit the depth {abs(shift)} frames {'later' if shift > 0 else 'earlier'} better by "
            f"{edges.by_frames[frames] / edges.by_frames[shifts] - 1:.0%}",
            "best fit at its own time",
            "color and depth are of different times: `duagc run --calibrate` estimates the delay; "
            "what a run finds with certainty, it takes out by itself",
            confidence=_agreeing(edges.frames_of, frames, shifts),
        )
    elif edges.by_pixels[pixels] > config.clear_ratio * edges.by_pixels[reach] and abs(pixels - reach) > 2:
        yield Finding(
            Severity.WARNING,
            "depth in place",
            robot,
            f"edges of color fit the depth {pixels - reach:+d} px to the right better by "
            f"{edges.by_pixels[pixels] / edges.by_pixels[reach] - 1:.0%}",
            "best fit where it is",
            "register the depth to the color camera; `duagc run --calibrate` estimates how it is turned",
            confidence=_agreeing(edges.pixels_of, pixels, reach),
        )


def _agreeing(fits: Array, shifted: int, unshifted: int) -> float:
    """Confidence that a shift fits better, by how many frames [n, shifts] fit better with it."""
    return share_above(int((fits[:, shifted] > fits[:, unshifted]).sum()), len(fits))
