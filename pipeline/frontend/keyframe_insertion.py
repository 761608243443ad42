"""New keyframes: added to those of a tracker, and registered to the earlier ones that see most of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.frontend.bearing_registration import register_few_depths
from duagc.pipeline.frontend.current_frame import CurrentFrame, PoseCandidate
from duagc.pipeline.frontend.keyframe_graph import predicted_overlap
from duagc.pipeline.frontend.tracked import TrackedKeyframe
from duagc.pipeline.frontend.tracking_state import TrackingState
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.registration import Reference, register


def insert_first_keyframe(state: TrackingState, frame: CurrentFrame, reference: Reference) -> None:
    """Make a frame keyframe 0, the origin of the map.

    Args:
        state: whose keyframes are added to.
        frame: the current frame.
        reference: its samples.
    """
    state.keyframes.append(_keyframe(frame, 0, -1, np.eye(4), reference=reference))


def insert_keyframe(state: TrackingState, frame: CurrentFrame, tracked: PoseCandidate) -> int:
    """Make a tracked frame the next keyframe, and register it to earlier ones.

    Args:
        state: whose keyframes and registrations are added to.
        frame: the current frame.
        tracked: where it was tracked.

    Returns:
        Its index.
    """
    result, previous = tracked.result, state.keyframes[tracked.keyframe_index]
    T_map_keyframe = previous.T_map_keyframe @ result.T_reference_target
    new = len(state.keyframes)
    state.pairs.append(
        RelativePose(previous.keyframe_index, new, result.T_reference_target, result.information)
    )
    state.pairs += _neighbor_registrations(state, frame, previous.keyframe_index, T_map_keyframe)
    gain_before, offset_before = previous.exposure
    gain, offset = result.exposure
    reference = Reference.from_pyramid(frame.pyramid, state.config.tracking.strides)
    keyframe = _keyframe(frame, new, previous.keyframe_index, T_map_keyframe, reference=reference)
    exposure = gain * gain_before, gain * offset_before + offset
    state.keyframes.append(replace(keyframe, exposure=exposure))
    return new


def _keyframe(
    frame: CurrentFrame, index: int, previous: int, T_map_keyframe: Array, *, reference: Reference
) -> TrackedKeyframe:
    """A frame as a keyframe, exposed as keyframe 0 is; its arrays are laid into a file."""
    reference, features, coarsest, seen = SHELF.put(
        (reference, frame.features, frame.pyramid.levels[-1], frame.seen)
    )
    return TrackedKeyframe(
        keyframe_index=index,
        frame_index=frame.frame_index,
        stamp_ns=frame.stamp_ns,
        previous_index=previous,
        T_map_keyframe=T_map_keyframe,
        reference=reference,
        features=features,
        coarsest=coarsest,
        seen=seen,
    )


def _neighbor_registrations(
    state: TrackingState, frame: CurrentFrame, previous: int, T_map_keyframe: Array
) -> list[RelativePose]:
    """A new keyframe registered to the earlier ones that see most of it, the one it was tracked from excepted."""
    limits = state.config.keyframes
    # where it was tracked from looks at nearly the same place
    centers = np.array([keyframe.center_map for keyframe in state.keyframes])
    distance = np.linalg.norm(centers - centers[previous], axis=1)
    nearest = np.sort(np.argsort(distance, kind="stable")[: limits.optimization_candidates])
    candidates = []
    for keyframe in (state.keyframes[k] for k in nearest):
        T_keyframe_new = se3.inverse(keyframe.T_map_keyframe) @ T_map_keyframe
        overlap = predicted_overlap(keyframe.reference, frame.pyramid, T_keyframe_new)
        if keyframe.keyframe_index != previous and overlap >= limits.neighbor_overlap:
            candidates.append((-overlap, -keyframe.keyframe_index, T_keyframe_new))
    candidates.sort(key=lambda candidate: candidate[:2])
    pairs = []
    for _, negative_index, guess in candidates[: limits.neighbors]:
        tracking, keyframe = state.config.tracking, state.keyframes[-negative_index]
        result = register_few_depths(keyframe, frame, guess, tracking)
        if result is None:
            result = register(keyframe.reference, frame.pyramid, guess, tracking.registration)
        if result.ok and result.overlap >= limits.neighbor_overlap:
            new = len(state.keyframes)
            pairs.append(RelativePose(-negative_index, new, result.T_reference_target, result.information))
    return pairs
