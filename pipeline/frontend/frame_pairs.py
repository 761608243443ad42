"""Pairs of frames of a log between which the velocity of the camera changes, and their images.

Several estimates compare the same frames (`depth_delay`, `readout_time`); what they read in common is read once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import RgbdFrame, RgbdLog

STEP_NS = 10_000_000  # in which a velocity is taken
FARTHEST_NS = 700_000_000  # between the frames of a pair
MOST_OF_VIEW = 0.2  # of the width of the image that the view moves between them
TYPICAL_DEPTH_M = 2.0  # at which a translation counts as a motion of the view
MAX_BYTES = 176 << 20  # 80 frames of 640x480


@dataclass(frozen=True)
class MovingView:
    """A frame with its pose and velocity.

    Attributes:
        index: in the log.
        stamp_ns: its time.
        T_map_camera: [4, 4].
        velocity: [6], right tangent, 1/s.
    """

    index: int
    stamp_ns: int
    T_map_camera: Array
    velocity: Array

    def pose_of(self, other: MovingView) -> Array:
        """T_view_other [4, 4] of another view.

        Args:
            other: posed in the same map.
        """
        return np.asarray(se3.inverse(self.T_map_camera) @ other.T_map_camera)


class FramePairs:
    """Pairs of frames of a log, by the poses of those that were tracked, and the frames themselves.

    Frames that were asked for first are kept, as many as fit into a number of bytes. What is moved by what is known of
    the motion is read again: its depth or its rows are of another time than its color.
    """

    def __init__(self, log: RgbdLog, parts: Sequence[Trajectory], max_bytes: int = MAX_BYTES) -> None:
        """Begin with none.

        Args:
            log: of the robot.
            parts: T_map_camera of the frames that were tracked; of every part that has a frame of its own.
            max_bytes: of the frames that are kept.
        """
        self.log, self.parts = log, parts
        self._free_bytes = max_bytes
        self._spread: dict[tuple[int, int, float], list[tuple[MovingView, MovingView]]] = {}
        self._frames: dict[tuple[int, int], RgbdFrame] = {}

    def spread(self, count: int, quantile: float = 1.0) -> list[tuple[MovingView, MovingView]]:
        """Pairs spread over the log, in order of time, between which the velocity changes most.

        Args:
            count: about how many.
            quantile: of the changes to the views near one, in that to which it is paired: 1: the largest.
        """
        key = self.log.depth_delay_ns, count, quantile
        if key not in self._spread:
            self._spread[key] = _spread(self.log, self.parts, count, quantile)
        return self._spread[key]

    def frame(self, index: int) -> RgbdFrame:
        """A frame, as the log reads it now.

        Args:
            index: position in the log.
        """
        log = self.log
        key = log.depth_delay_ns, index
        if log.readout.rolls or log.frame_offset_ns(index):
            return log.frame(index)
        if (kept := self._frames.get(key)) is not None:
            return kept
        frame = log.frame(index)
        if frame.nbytes <= self._free_bytes:
            self._frames[key] = frame
            self._free_bytes -= frame.nbytes
        return frame

    @property
    def has_sigma(self) -> bool:
        """Whether the log has sigma of its depth, pixel by pixel: depth that was computed from images or sweeps."""
        first = next((k for k, (_, depth) in enumerate(self.log.pairing.pairs) if depth is not None), None)
        return first is not None and self.frame(first).depth_sigma is not None


def change(T_first_second: Array, first: Array, second: Array) -> Array:
    """Change [..., 6] of a velocity from one view to another, right tangent of the second.

    Args:
        T_first_second: [..., 4, 4].
        first: [6], velocity of the first view.
        second: [..., 6], that of the second.
    """
    return np.asarray(second - se3.adjoint(se3.inverse(T_first_second)) @ first)


def _spread(
    log: RgbdLog, parts: Sequence[Trajectory], count: int, quantile: float
) -> list[tuple[MovingView, MovingView]]:
    """`FramePairs.spread`."""
    views, found = [_views(log, part) for part in parts], []
    total = max(sum(len(part) for part in views), 1)
    for part in views:
        share = min(-(-count * len(part) // total), len(part))
        for first in (part[k] for k in evenly_spaced(len(part), share)):
            second = _changed(first, part, log.camera.fx, MOST_OF_VIEW * log.camera.width, quantile=quantile)
            if second is not None:
                found.append((first, second))
    return found


def _views(log: RgbdLog, part: Trajectory) -> list[MovingView]:
    """Frames with depth, pose and velocity that are not held out."""
    motion, index_of = log.motion_along(part), {color: k for k, (color, _) in enumerate(log.pairing.pairs)}
    found = []
    for stamp, T in zip(part.stamps_ns.tolist(), part.poses, strict=True):
        index = index_of[stamp]
        if is_held_out(index) or log.pairing.pairs[index][1] is None:
            continue
        T_step = motion.between(stamp, stamp + STEP_NS)
        if T_step is not None:
            found.append(MovingView(index, stamp, T, se3.log(T_step) / (1e-9 * STEP_NS)))
    return found


def _changed(
    first: MovingView, views: Sequence[MovingView], focal_px: float, reach_px: float, *, quantile: float
) -> MovingView | None:
    """The view next to one, in time and place, in which the camera moves most differently; None if there is none."""
    near = [v for v in views if v is not first and abs(v.stamp_ns - first.stamp_ns) <= FARTHEST_NS]
    if not near:
        return None
    px = focal_px * np.array([*[1 / TYPICAL_DEPTH_M] * 3, 1.0, 1.0, 1.0])
    T = se3.inverse(first.T_map_camera) @ np.array([view.T_map_camera for view in near])
    velocities = np.array([view.velocity for view in near])
    changed = np.linalg.norm(px * change(T, first.velocity, velocities), axis=1)
    reached = (changed > 0) & (np.linalg.norm(px * se3.log(T), axis=1) <= reach_px)
    ranked = np.flatnonzero(reached)[np.argsort(-changed[reached], kind="stable")]
    return near[int(ranked[round((1 - quantile) * (len(ranked) - 1))])] if len(ranked) else None
