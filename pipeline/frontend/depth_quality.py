"""How good the depth of a log is: its noise, what distance it shows, how near in time to the color it was taken."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.submaps import TrackedLog
from duagc.pipeline.frontend.tracked import Status, TrackedFrame

HARDLY_WORSE_S = 0.01
NEAREST_PERCENT = 10


def median_depth_m(tracked: TrackedLog) -> float:
    """Median over all keyframes of the median depth that each shows, meters; infinite if none shows any.

    Args:
        tracked: the log.
    """
    depths_m = [keyframe.median_depth_m for submap in tracked.submaps for keyframe in submap.keyframes]
    return float(np.median(depths_m)) if depths_m else np.inf


def largest_depth_offset_s(pairs: Sequence[tuple[int, int | None]], usual_s: float) -> float:
    """By which depth may be earlier or later than its color, of a frame that others are registered to.

    Cameras that are not synchronized may never be as near as usual: then the tenth of the frames that are nearest
    count, and those that are hardly worse.

    Args:
        pairs: time of the color and of the depth of every frame of a log, ns; those that are held out do not count.
        usual_s: where a tenth of the frames has depth as near.
    """
    offsets_ns = [
        abs(depth - color)
        for k, (color, depth) in enumerate(pairs)
        if depth is not None and not is_held_out(k)
    ]
    nearest_s = float(np.percentile(offsets_ns, NEAREST_PERCENT)) * 1e-9 if offsets_ns else 0.0
    return usual_s if nearest_s <= usual_s else nearest_s + HARDLY_WORSE_S


def depth_noise_m(frames: Sequence[TrackedFrame]) -> float | None:
    """Noise of the depth images, meters: the median depth residual of registration over frames that are not held out.

    Args:
        frames: of the log, as tracked.

    Returns:
        The noise; None if no frame was tracked with depth.
    """
    rms_m = [
        frame.rms_depth_m
        for frame in frames
        if frame.status is Status.OK
        and frame.reason is Reason.NONE
        and frame.rms_depth_m > 0
        and not is_held_out(frame.frame_index)
    ]
    return float(np.median(rms_m)) if rms_m else None
