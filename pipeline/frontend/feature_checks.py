"""Tests that a registered pose must pass by the features of its frame: see `pose_checks`."""

from __future__ import annotations

import numpy as np

from duagc.pipeline.base import random_streams
from duagc.pipeline.frontend.current_frame import CurrentFrame, PoseCandidate
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.judgment import contradicts
from duagc.pipeline.frontend.tracking_state import TrackingState
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration.bearing_judgment import bearings_contradict
from duagc.pipeline.registration.bearing_motion import BearingMatches
from duagc.pipeline.registration.feature_judgment import judge_motion
from duagc.pipeline.registration.feature_motion import features_agree, follows_something_moved


class FeaturesConfirm:
    """The features of the frame must be where the keyframe has them.

    Where a keyframe has too few features to decide, only a camera that was lost for a moment and is where it was
    predicted passes.
    """

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """Reject it if features are not where the keyframe has them.

        Args:
            state: what the tracker knows.
            frame: the current frame.
            candidate: whose registration ended well.
        """
        limits, relocalization = state.config.tracking.failure, state.config.tracking.relocalization
        features = state.keyframes[candidate.keyframe_index].features
        if len(features) >= limits.min_features_of_inliers * relocalization.min_inliers:
            T = candidate.result.T_reference_target
            return (
                candidate
                if features_agree(features, frame.features, T, relocalization)
                else Reason.OBSTRUCTED
            )
        moved_m, turned_rad = from_prediction(state, frame, candidate)
        expected = moved_m <= limits.slack_m and turned_rad <= limits.slack_rad
        return candidate if expected and not state.is_long_lost(frame.stamp_ns) else Reason.OBSTRUCTED


class DoesNotFollowMovedThings:
    """Where features of frame and keyframe agree on two motions, the camera must be where the wider spread ones say.

    What moved while the camera was lost, a chair or a table, may fill more of its view than the place does, and dense
    registration ends there even from the right start.
    """

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """Reject it if it follows what moved.

        Args:
            state: what the tracker knows.
            frame: the current frame.
            candidate: whose registration ended well.
        """
        limits, features = (
            state.config.tracking.relocalization,
            state.keyframes[candidate.keyframe_index].features,
        )
        T, rng = candidate.result.T_reference_target, _draws("moved_things", frame, candidate)
        moved = follows_something_moved(features, frame.features, T, config=limits, rng=rng)
        return Reason.SOMETHING_MOVED if moved else candidate


class FeaturesDoNotContradict:
    """The features of the frame must not say, by the motion that they agree on, that the camera is elsewhere.

    `FeaturesConfirm` lets pass what is off by as much as depth can be: a decimeter at two meters.
    """

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """Reject it if the motion that features agree on contradicts it.

        Args:
            state: what the tracker knows.
            frame: the current frame.
            candidate: whose registration ended well.
        """
        limits, features = state.config.keyframes.judgment, state.keyframes[candidate.keyframe_index].features
        T, rng = candidate.result.T_reference_target, _draws("frame_judgment", frame, candidate)
        found = judge_motion(features, frame.features, T, config=limits, rng=rng)
        return Reason.OBSTRUCTED if found is not None and contradicts(found, limits) else candidate


class BearingsDoNotContradict:
    """Where few pixels have depth, features without it must not say that the camera moved otherwise."""

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """Reject it if features without depth agree on another motion.

        Args:
            state: what the tracker knows.
            frame: the current frame.
            candidate: whose registration ended well; by bearings they were asked.
        """
        first = state.keyframes[candidate.keyframe_index].features
        if candidate.by_bearings or not (frame.has_few_depths or first.bearings.few_depths):
            return candidate
        matched = BearingMatches.of(first, frame.features, frame.relocalization.ratio)
        T = candidate.result.T_reference_target
        contradicted = matched is not None and bearings_contradict(matched, T)
        return Reason.OBSTRUCTED if contradicted else candidate


class FeaturesAllowWorseLook:
    """A frame that looks worse than usual, by color and depth, must not be elsewhere than where features have it.

    Dense registration ends in a wrong minimum where the camera moved other than predicted by more than it reaches: a
    view along a wall, which only its pictures tell from the next one, was taken to be 6 cm off.
    """

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """Reject it if it looks worse than usual, and features have it elsewhere.

        Args:
            state: what the tracker knows.
            frame: the current frame.
            candidate: whose registration ended well.
        """
        if candidate.without is not Reason.NONE or not state.looks_worse_than_usual(candidate.result):
            return candidate
        return FeaturesDoNotContradict().judge(state, frame, candidate)


def from_prediction(
    state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
) -> tuple[float, float]:
    """Distance in the map, meters, and angle, radians, of a candidate from the prediction.

    A camera may turn back between frames that are far apart: there the last pose is as good a prediction as the last
    velocity, and the nearer one counts.

    Args:
        state: what the tracker knows.
        frame: the current frame.
        candidate: where it may be.
    """
    keyframe, T = state.keyframes[candidate.keyframe_index], candidate.result.T_reference_target
    predicted = state.predict(frame.stamp_ns)
    expected = [predicted.T_keyframe_camera]
    if (
        predicted.information is None
        and state.elapsed_s(frame.stamp_ns) > state.config.tracking.max_extrapolation_s
    ):
        expected.append(state.T_keyframe_camera)
    T_map_expected = state.keyframe.T_map_keyframe @ np.stack(expected)
    moved_m, turned_rad = se3.distance(T_map_expected, (keyframe.T_map_keyframe @ T)[None])
    nearest = int(np.argmin(moved_m))
    return float(moved_m[nearest]), float(turned_rad[nearest])


def _draws(stream: str, frame: CurrentFrame, candidate: PoseCandidate) -> np.random.Generator:
    """Draws that only choose which samples are tried: the same in every run."""
    return random_streams.generator(0, stream, frame=frame.frame_index, keyframe=candidate.keyframe_index)
