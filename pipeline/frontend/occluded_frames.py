"""Tracking of frames while an object is in front of the camera: its pixels are left out.

What the object hides is found where the frame is predicted, and again where it was found. So a keyframe that is made
meanwhile does not contain the object, and the camera keeps a keyframe however long the object stays.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.frontend.bearing_registration import register_few_depths
from duagc.pipeline.frontend.current_frame import CurrentFrame, PoseCandidate
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.hidden_pixels import HiddenPixels, hidden_pixels
from duagc.pipeline.frontend.nearby_registration import fits_better, register_nearby, went_far
from duagc.pipeline.frontend.pose_checks import FOLLOWED, FOUND_BY_BEARINGS, verify
from duagc.pipeline.frontend.tracking_state import TrackingState
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import Level, register

LITTLE = 0.2
"""Of the share of a view by which an object is noticed anyway: less of it is only left out of what the view says."""


def register_visible(
    state: TrackingState, frame: CurrentFrame
) -> tuple[CurrentFrame, PoseCandidate | Reason]:
    """Register a frame near the last pose, without what an object hides of it if there is one in front of the camera.

    Where none is known, the whole frame is registered. An object that comes in slowly is then noticed by how much it
    hides, or because the frame is elsewhere without it, or is only found so.

    Args:
        state: what the tracker knows; such an object is noticed.
        frame: the current frame.

    Returns:
        The frame, without the pixels of the object where its pose was found without them; and where it is, or why that
        is not known.
    """
    T_map_predicted = state.keyframe.T_map_keyframe @ state.predict(frame.stamp_ns).T_keyframe_camera
    if state.occlusion.active:
        without = _register_without(state, frame, T_map_predicted)
        if without is not None and _usual(state, without[1]):
            return without
        return frame, _believed(state, register_nearby(state, frame))
    whole = register_nearby(state, frame)
    most = state.config.tracking.failure.max_free_space_violations
    if isinstance(whole, Reason):
        hidden = _hidden(state, frame, T_map_predicted)
        if hidden.share > most:
            without = _register_without(state, frame, T_map_predicted)
            if without is not None and _usual(state, without[1]) and _hides(without[0]) > most:
                state.occlusion.active = True
                return without
        return frame, whole
    if whole.without is not Reason.NONE:
        return frame, whole
    return _checked(state, frame, whole)


def _checked(
    state: TrackingState, frame: CurrentFrame, whole: PoseCandidate
) -> tuple[CurrentFrame, PoseCandidate | Reason]:
    """A frame that was registered as a whole, or without an object that hides much of it or moved it."""
    T_map_camera = state.in_map(whole)
    hidden = _hidden(state, frame, T_map_camera)
    if hidden.share == 0:
        return frame, whole
    most = state.config.tracking.failure.max_free_space_violations
    if hidden.share <= LITTLE * most:
        return replace(frame, suspected=hidden), whole
    there = None
    if hidden.share <= most and not went_far(state, frame, whole):
        there = _registered_there(state, frame, whole, hidden)
        if there is not None and _hides(there[0]) <= most:
            return replace(frame, suspected=hidden), whole
    without = _register_without(state, frame, T_map_camera)
    if without is not None and _apart(state, whole, without[1]):
        there = there or _registered_there(state, frame, whole, hidden)
        if there is not None and fits_better(state, there[1], without[1]):
            without = there  # from the prediction it ended in a wrong minimum
    usual = without is not None and _usual(state, without[1])
    if without is not None and usual and (_hides(without[0]) > most or _apart(state, whole, without[1])):
        state.occlusion.active = True
        return without
    found = _believed(state, whole) if hidden.share > most else whole
    return replace(frame, suspected=hidden), found


def _registered_there(
    state: TrackingState, frame: CurrentFrame, whole: PoseCandidate, hidden: HiddenPixels
) -> tuple[CurrentFrame, PoseCandidate] | None:
    """A frame without what may hide it, from where it was found as a whole; None: it does not stay there."""
    there = _registered_from(state, frame.without(hidden), whole)
    if not there.result.ok or _apart(state, whole, there):
        return None
    return frame.without(_hidden(state, frame, state.in_map(there))), there


def _hides(frame: CurrentFrame) -> float:
    """The share of a frame that an object hides."""
    return 0.0 if frame.hidden is None else frame.hidden.share


def _believed(state: TrackingState, whole: PoseCandidate | Reason) -> PoseCandidate | Reason:
    """What was found with a whole frame, unless it looks worse than usual: part of the object may be in the way."""
    return Reason.OBSTRUCTED if isinstance(whole, PoseCandidate) and not _usual(state, whole) else whole


def _usual(state: TrackingState, found: PoseCandidate) -> bool:
    """Whether a frame looks no worse than usual, as far as it was compared by color and depth."""
    return found.without is not Reason.NONE or not state.looks_worse_than_usual(found.result)


def _apart(state: TrackingState, one: PoseCandidate, other: PoseCandidate) -> bool:
    """Whether a camera is at two places, by more than a registration that is stable may move."""
    tracking = state.config.tracking
    moved_m, turned_rad = se3.distance(state.in_map(one), state.in_map(other))
    return bool(moved_m > tracking.stable_m or turned_rad > tracking.stable_rad)


def _register_without(
    state: TrackingState, frame: CurrentFrame, T_map_camera: Array
) -> tuple[CurrentFrame, PoseCandidate] | None:
    """The frame without an object, and where it is, from a pose [4, 4] near it; None: it is not found so."""
    clear = frame.without(_hidden(state, frame, T_map_camera))
    found = register_nearby(state, clear)
    if not isinstance(found, PoseCandidate):
        return None
    clear = frame.without(_hidden(state, frame, state.in_map(found)))
    if found.without is not Reason.NONE:
        return clear, found
    again = _registered_from(state, clear, found)
    verified = verify(FOUND_BY_BEARINGS if again.by_bearings else FOLLOWED, state, clear, again)
    return (clear, verified) if isinstance(verified, PoseCandidate) else None


def _registered_from(state: TrackingState, clear: CurrentFrame, found: PoseCandidate) -> PoseCandidate:
    """A frame without what may hide it, registered to the same keyframe from where it was found."""
    tracking, keyframe = state.config.tracking, state.keyframes[found.keyframe_index]
    T_found = found.result.T_reference_target
    result = register_few_depths(keyframe, clear, T_found, tracking)
    if result is not None:
        return replace(found, result=result, by_bearings=True)
    result = register(keyframe.reference, clear.pyramid, T_found, tracking.registration)
    return replace(found, result=result, by_bearings=False)


def _hidden(state: TrackingState, frame: CurrentFrame, T_map_camera: Array) -> HiddenPixels:
    """What an object hides of a frame, if the camera is at T_map_camera [4, 4]."""
    return hidden_pixels(frame.pyramid.levels[-1], T_map_camera, _seen(state), state.config)


def _seen(state: TrackingState) -> Iterator[tuple[Level, Array]]:
    """The last view without an object, and the keyframes that tracking came from: little drift lies between those."""
    if state.occlusion.unoccluded is not None:
        yield state.occlusion.unoccluded
    index = state.keyframe_index
    for _ in range(state.config.moving.views):
        if index < 0:
            return
        keyframe = state.keyframes[index]
        yield keyframe.seen, keyframe.T_map_keyframe
        index = keyframe.previous_index
