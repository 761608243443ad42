"""Frames before the first keyframe: followed backward in time from it.

A map begins with the first frame whose depth can be used. Depth cameras often start later than color cameras; what the
color camera saw until then is followed by its color, and by depth that was taken a little later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend.color_only import LastGoodFrame
from duagc.pipeline.frontend.current_frame import CurrentFrame, PoseCandidate
from duagc.pipeline.frontend.depth_quality import largest_depth_offset_s
from duagc.pipeline.frontend.frame_images import RgbdImages, pyramid_of
from duagc.pipeline.frontend.submaps import TrackedLog
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.frontend.tracking_state import RECENT_FRAMES
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import RgbdFrame, RgbdLog


class _Backward(Tracker):
    """Follows frames in reverse order, at times before the first keyframe as if they came after it."""

    def __init__(
        self,
        camera: PinholeCamera,
        keyframe: TrackedKeyframe,
        first: RgbdFrame,
        config: FrontendConfig,
        *,
        max_depth_offset_s: float,
    ) -> None:
        """Start at the first keyframe.

        Args:
            camera: of all frames.
            keyframe: the first one.
            first: its frame.
            config: of the front end.
            max_depth_offset_s: as of `Tracker`.
        """
        super().__init__(camera, config, max_depth_offset_s=max_depth_offset_s)
        state, strides = self.state, config.tracking.strides
        state.keyframes.append(keyframe)
        pyramid = pyramid_of(first, camera, len(strides))
        state.last_good = LastGoodFrame(pyramid, strides, np.eye(4), None)
        state.intervals.update(0)

    def start_from(self, frames: Sequence[TrackedFrame], first: int) -> None:
        """Take the velocity at the first keyframe from the frames after it, in reverse.

        Args:
            frames: as they were tracked forward.
            first: index of the keyframe's frame.
        """
        state, begin = self.state, next(frame for frame in frames if frame.frame_index == first)
        later = [
            frame
            for frame in frames
            if first <= frame.frame_index < first + RECENT_FRAMES
            and frame.status is not Status.LOST
            and frame.keyframe_index == 0
        ]
        state.recent = [
            (begin.stamp_ns - frame.stamp_ns, frame.T_keyframe_camera) for frame in reversed(later)
        ]
        if len(later) > 1:
            seconds = 1e-9 * (later[1].stamp_ns - begin.stamp_ns)
            state.velocity = -se3.log(later[1].T_keyframe_camera) / seconds

    def _becomes_keyframe(self, frame: CurrentFrame, found: PoseCandidate) -> bool:
        """Never: the keyframes of a robot are in the order of time."""
        return False


def track_leading_frames(log: RgbdLog, tracked: TrackedLog, config: FrontendConfig) -> TrackedLog:
    """The log with poses of the frames before the first keyframe, as far as they can be followed.

    Args:
        log: of the robot.
        tracked: the log as it was tracked forward.
        config: of the front end.
    """
    submap = tracked.submaps[0]
    start = submap.keyframes[0]
    frames, submap_of = list(tracked.frames), list(tracked.submap_of)
    leading = [k for k, frame in enumerate(frames) if frame.frame_index < start.frame_index]
    if not leading:
        return tracked
    limit_s = largest_depth_offset_s(log.pairing.pairs, config.keyframes.max_depth_offset_s)
    first = log.frame(start.frame_index)
    backward = _Backward(log.camera, start, first, config, max_depth_offset_s=limit_s)
    backward.start_from(
        [f for f, n in zip(frames, submap_of, strict=True) if n == submap.number], start.frame_index
    )
    for k in reversed(leading):
        frame = log.frame(frames[k].frame_index)
        images = replace(
            RgbdImages.of(frame),
            stamp_ns=start.stamp_ns - frame.stamp_ns,
            depth_offset_ns=-frame.depth_offset_ns,
        )
        found = backward.track_frame(backward.prepared(images))
        if found.status is Status.LOST:
            break
        frames[k], submap_of[k] = replace(found, stamp_ns=frame.stamp_ns), submap.number
    return replace(tracked, frames=frames, submap_of=submap_of)
