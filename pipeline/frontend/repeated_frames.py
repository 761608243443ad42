"""Frames that repeat both images of the one before, after which the camera turns out to have moved.

Such a frame shows where the camera was when its images came first. If it stood still, that is where it is. If a driver
was stuck, the next new images show it elsewhere, farther than it goes in the time since the last repeat, and nothing
says where it was in between.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.submaps import lost
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, tracked_path
from duagc.pipeline.geometry import se3

MOVED = np.array([0.05, 0.05])  # m, rad: what a pose of a repeated frame may be off by
PACE = 1.5  # times the speed afterwards, that the camera may have had since the last repeat


def without_stuck(frames: Sequence[TrackedFrame], T_map_keyframe: Array) -> list[TrackedFrame]:
    """The frames; those of a driver that was stuck while the camera moved are lost.

    Args:
        frames: of one path, in order.
        T_map_keyframe: [n, 4, 4], of its keyframes.
    """
    out = list(frames)
    placed = [k for k, frame in enumerate(frames) if frame.status is not Status.LOST]
    poses = tracked_path(frames, T_map_keyframe).poses
    stamps_s = np.array([frames[k].stamp_ns for k in placed]) * 1e-9
    last = len(placed) - 1
    for m in range(last):
        if not frames[placed[m]].repeats or frames[placed[m + 1]].repeats:
            continue
        after = min(m + 2, last)
        speed = _motion(poses[m + 1], poses[after]) / max(stamps_s[after] - stamps_s[m + 1], 1e-9)
        since_s = stamps_s[m + 1] - stamps_s[m]
        if (_motion(poses[m], poses[m + 1]) > MOVED + PACE * speed * since_s).any():
            k = placed[m]
            while k >= 0 and frames[k].repeats:
                if frames[k].status is not Status.LOST:
                    out[k] = lost(frames[k], Reason.REPEATED)
                k -= 1
    return out


def _motion(T_map_a: Array, T_map_b: Array) -> Array:
    """Distance and angle [2] (m, rad) of two poses [4, 4]."""
    return np.array(se3.distance(T_map_a, T_map_b))
