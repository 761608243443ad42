"""How much earlier than its stamps say depth was taken, by the motions that color and depth see for themselves.

Two frames are registered by color alone, and by depth alone. With a delay d the depth of each is what the camera saw d
before. Where the camera has the velocities v and w (right tangents per second), the two motions then differ by
d (Ad v - w), and by how the depth camera stands in the color camera (`motion_differences`).
"""

from __future__ import annotations

import numpy as np

from duagc.pipeline.config.motion_times import DelayConfig
from duagc.pipeline.frontend.frame_images import pyramid_of
from duagc.pipeline.frontend.frame_pairs import FramePairs, MovingView, change
from duagc.pipeline.frontend.motion_differences import (
    BY_COLOR,
    BY_DEPTH,
    LEVELS,
    MEASURED,
    STRIDES,
    MotionDifference,
    estimated_time,
    joint_information,
)
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import Reference, RgbdPyramid, register


def certain_delay_ns(pairs: FramePairs, config: DelayConfig) -> int:
    """The delay of a log's depth if it is certain, and long enough to matter; else 0.

    A log that has sigma of every depth computed it from images or sweeps: its errors look alike in views that are near
    each other, which passes for a delay, and a stereo pair has none.

    Args:
        pairs: of frames of the log, its depth as it was taken.
        config: of the estimate.
    """
    if not config.enabled or pairs.has_sigma:
        return 0
    differences = (_difference(pairs, *pair) for pair in pairs.spread(config.pairs))
    found = estimated_time([difference for difference in differences if difference is not None], config)
    return round(1e9 * found.time_s) if found is not None and found.is_certain(config) else 0


def _difference(pairs: FramePairs, first: MovingView, second: MovingView) -> MotionDifference | None:
    """The difference of a pair; None if either motion cannot be found."""
    seen, other = (_half_size(pairs, view.index) for view in (first, second))
    reference, T_start = Reference.from_pyramid(seen, STRIDES), first.pose_of(second)
    by_color = register(reference, other.without_depth(), T_start, BY_COLOR)
    by_depth = register(reference, other, T_start, BY_DEPTH)
    if by_color.outcome not in MEASURED or by_depth.outcome not in MEASURED:
        return None
    T = by_color.T_reference_target
    Ad = se3.adjoint(se3.inverse(T))
    late_s = [1e-9 * pairs.log.frame_offset_ns(view.index) for view in (first, second)]
    stated = second.velocity * late_s[1] - Ad @ first.velocity * late_s[0]
    return MotionDifference(
        se3.log(se3.inverse(T) @ by_depth.T_reference_target) - stated,
        -change(T, first.velocity, second.velocity),
        np.eye(6) - Ad,
        joint_information(by_color.information, by_depth.information),
    )


def _half_size(pairs: FramePairs, index: int) -> RgbdPyramid:
    return RgbdPyramid(pyramid_of(pairs.frame(index), pairs.log.camera, LEVELS).levels[1:])
