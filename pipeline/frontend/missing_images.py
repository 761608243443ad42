"""Frames of which one image cannot be used: which one it is, and how they are followed by the other, for a while."""

from __future__ import annotations

from duagc.pipeline.frontend.current_frame import CurrentFrame, PoseCandidate
from duagc.pipeline.frontend.failure import Reason, has_enough_depth, shows_anything
from duagc.pipeline.frontend.nearby_registration import register_predicted
from duagc.pipeline.frontend.tracking_state import TrackingState


def count_missing_image(state: TrackingState, frame: CurrentFrame) -> Reason:
    """Find which image of a frame cannot be used, and count such frames in a row.

    Args:
        state: what the tracker knows; the counts are updated.
        frame: the current frame.

    Returns:
        NO_PIXEL, FROZEN_COLOR, FROZEN_DEPTH, NO_DEPTH or NONE.
    """
    if not shows_anything(frame.pyramid, state.config.tracking.failure):
        return Reason.NO_PIXEL
    frozen = state.frozen.update(frame.pyramid)
    if frozen is Reason.FROZEN_COLOR:
        state.frames_without_color += 1
        return frozen
    state.frames_without_color = 0
    enough = has_enough_depth(frame.pyramid, state.config.tracking.registration)
    missing = frozen if enough else Reason.NO_DEPTH
    state.frames_without_depth = 0 if missing is Reason.NONE else state.frames_without_depth + 1
    return missing


def follow_by_color(state: TrackingState, frame: CurrentFrame, missing: Reason) -> PoseCandidate | Reason:
    """Follow a frame without depth by its color alone, for a while, if it looks as frames did before.

    Args:
        state: what the tracker knows.
        frame: the current frame.
        missing: why its depth cannot be used.

    Returns:
        Where the frame is; `missing` if that is not known.
    """
    failure = state.config.tracking.failure
    too_many = state.frames_without_depth > failure.max_frames_without_depth
    if too_many or state.lost or state.occlusion.active or state.last_good is None:
        return missing
    result = state.register_color(frame)
    followed = result.ok and state.looks_as_usual(result)
    return PoseCandidate(state.keyframe_index, result, missing) if followed else missing


def follow_by_depth(state: TrackingState, frame: CurrentFrame) -> PoseCandidate | Reason:
    """Follow a frame with frozen color by its depth alone, for a few frames: on walls it drifts soon.

    Args:
        state: what the tracker knows.
        frame: the current frame.

    Returns:
        Where the frame is; FROZEN_COLOR if that is not known.
    """
    tracking = state.config.tracking
    too_many = state.frames_without_color > tracking.failure.max_frames_without_color
    if too_many or state.lost or not state.keyframes:
        return Reason.FROZEN_COLOR
    depth_only = tracking.registration.model_copy(update={"residuals": "depth"})
    result = register_predicted(state, frame, state.predict(frame.stamp_ns), depth_only)
    followed = PoseCandidate(state.keyframe_index, result, Reason.FROZEN_COLOR)
    return followed if result.ok else Reason.FROZEN_COLOR
