"""Tests that a registered pose must pass before it is accepted, each with one verdict.

A registration can end well and be wrong. A frame that was simply followed passes FOLLOWED; one that was found with wide
gates or among all keyframes passes PLAUSIBLE.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.frontend.current_frame import CurrentFrame, PoseCandidate
from duagc.pipeline.frontend.failure import Reason, free_space_violations
from duagc.pipeline.frontend.feature_checks import (
    BearingsDoNotContradict,
    DoesNotFollowMovedThings,
    FeaturesAllowWorseLook,
    FeaturesConfirm,
    FeaturesDoNotContradict,
    from_prediction,
)
from duagc.pipeline.frontend.reach import farthest_m, fastest_m_s
from duagc.pipeline.frontend.tracked import TrackedKeyframe
from duagc.pipeline.frontend.tracking_state import TrackingState
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration.descriptors import matches
from duagc.pipeline.registration.feature_judgment import angles_between
from duagc.pipeline.registration.feature_motion import features_agree


class PoseCheck(Protocol):
    """One test of a candidate pose."""

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """The candidate, maybe corrected, or why it is rejected.

        Args:
            state: what the tracker knows.
            frame: the current frame.
            candidate: whose registration ended well.
        """
        ...


def verify(
    checks: Sequence[PoseCheck], state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
) -> PoseCandidate | Reason:
    """The candidate after all checks, or the first reason against it.

    Args:
        checks: in order.
        state: what the tracker knows.
        frame: the current frame.
        candidate: where it may be.
    """
    if not candidate.result.ok:
        return Reason(candidate.result.outcome.value)
    for check in checks:
        verdict = check.judge(state, frame, candidate)
        if isinstance(verdict, Reason):
            return verdict
        candidate = verdict
    return candidate


class WellConstrained:
    """What an object in front of the camera leaves visible must still determine where the camera is."""

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """Reject it if its position is uncertain and something is in front of the camera.

        Args:
            state: what the tracker knows.
            frame: the current frame.
            candidate: whose registration ended well.
        """
        # along weak directions a prior knows the pose, or the outcome would not be OK
        covariance = np.linalg.pinv(candidate.result.information, rcond=1e-12, hermitian=True)
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
        if sigma_m <= state.config.tracking.failure.max_sigma_occluded_m:
            return candidate
        if frame.hidden is not None and frame.hidden.share > 0:
            return Reason.OBSTRUCTED
        occluded, _ = state.occlusion.judge(frame.pyramid.levels[-1], state.viewpoint(candidate))
        return Reason.OBSTRUCTED if occluded else candidate


class MatchesPrediction:
    """A frame that looks unlike its keyframe must see much of it, where it was predicted, and contradict no depth.

    Exposure that jumps makes frames look unlike, and a hand does; another place that looks somewhat alike is also
    elsewhere: in RedKitchen a mirrored room would be followed 11 cm and 14 degrees off the path. Burnt out images, of
    which half a keyframe is seen, are 11 cm off there.
    """

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """Reject it if it looks unlike its keyframe and is not where it was predicted.

        Args:
            state: what the tracker knows.
            frame: the current frame.
            candidate: whose registration ended well.
        """
        tracking, result = state.config.tracking, candidate.result
        predicted = state.predict(frame.stamp_ns).T_keyframe_camera
        moved_m, turned_rad = se3.distance(predicted, result.T_reference_target)
        matches = result.rms_gray <= state.largest_gray_rms or (
            min(result.overlap, result.view) >= tracking.failure.min_overlap_unlike
            and moved_m <= tracking.failure.slack_m
            and turned_rad <= tracking.failure.slack_rad
            and result.conflict <= tracking.relocalization.max_conflict
        )
        return candidate if matches else Reason.OBSTRUCTED


class DepthColorConsistency:
    """A frame that looks worse than usual must be where color alone puts it, as far as that can be determined.

    If the two contradict each other, depth of another time holds the camera back: then the pose by color alone is
    used, unless by it the camera moved less, or something is in front of the camera. But color alone also goes along
    with light that moves with the camera, of its lamp or a flare: they do not, where features prefer the other pose.
    """

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """Correct or reject it if color alone puts the camera elsewhere.

        Args:
            state: what the tracker knows; gets whether depth and color contradict each other.
            frame: the current frame.
            candidate: whose registration ended well.
        """
        limits = state.config.tracking.failure
        if state.last_good is None or not state.looks_worse_than_usual(candidate.result):
            return candidate
        color_only = state.register_color(frame)
        if not color_only.ok or state.looks_worse_than_usual(color_only):
            return Reason.CONTRADICTION if state.depth_color_inconsistent else candidate
        T, T_color_only = state.in_keyframe(candidate), color_only.T_reference_target
        agree = state.last_good.agrees(T, T_color_only, limits, state.depth_color_inconsistent)
        if agree or _features_prefer(T, T_color_only, state.keyframe, frame):
            return replace(candidate, unlike=True)
        state.depth_color_inconsistent = True
        view, viewpoint = frame.pyramid.levels[-1], state.viewpoint(candidate)
        occluded = state.occlusion.active or state.occlusion.judge(view, viewpoint)[0]
        held_back = state.last_good.translation_m(T) < state.last_good.translation_m(T_color_only)
        if state.lost or occluded or not held_back or not state.looks_as_usual(color_only):
            return Reason.CONTRADICTION
        return PoseCandidate(state.keyframe_index, color_only, Reason.CONTRADICTION)


class SharesEnough:
    """The frame and its keyframe must show enough of the same surfaces and little that contradicts them."""

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """Reject it if too little is shared, or too much contradicts.

        Args:
            state: what the tracker knows.
            frame: the current frame.
            candidate: whose registration ended well.
        """
        limits, result = state.config.tracking.relocalization, candidate.result
        shares = result.overlap >= limits.min_overlap and result.conflict <= limits.max_conflict
        return candidate if shares else Reason.OBSTRUCTED


class LooksAlike:
    """Gray values must fit the keyframe: rooms built alike agree in shape, not in their pictures."""

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """Reject it if gray values differ too much.

        Args:
            state: what the tracker knows.
            frame: the current frame.
            candidate: whose registration ended well.
        """
        return candidate if candidate.result.rms_gray <= state.largest_gray_rms else Reason.OBSTRUCTED


class LooksNoWorseThanUsual:
    """Gray values must fit the keyframe about as well as those of other frames do."""

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """Reject it if gray values differ by more than usual.

        Args:
            state: what the tracker knows.
            frame: the current frame.
            candidate: whose registration ended well.
        """
        return Reason.OBSTRUCTED if state.looks_worse_than_usual(candidate.result) else candidate


class RespectsFreeSpace:
    """Little of the frame may be in space that the keyframe saw to be free."""

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """Reject it if much of the frame is in space that its keyframe saw to be free.

        Args:
            state: what the tracker knows.
            frame: the current frame.
            candidate: whose registration ended well.
        """
        limits, keyframe = state.config.tracking.failure, state.keyframes[candidate.keyframe_index]
        T = candidate.result.T_reference_target
        violations, visible = free_space_violations(frame.pyramid.levels[-1], keyframe.coarsest, T, limits)
        return Reason.OBSTRUCTED if violations > limits.max_free_space_violations * visible else candidate


class WithinReach:
    """A camera of finite speed can have come no farther since it was last tracked.

    Before anything is known of its speed, features may show that it is faster: a log of a vehicle may begin in motion.
    """

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        """Reject it if the camera cannot have come so far.

        Args:
            state: what the tracker knows.
            frame: the current frame.
            candidate: whose registration ended well.
        """
        limits, keyframe = state.config.tracking.failure, state.keyframes[candidate.keyframe_index]
        moved_m, _ = from_prediction(state, frame, candidate)
        speed_m_s, elapsed_s = fastest_m_s(state.followed_m_s, limits), state.elapsed_s(frame.stamp_ns)
        reach_m = farthest_m(speed_m_s, elapsed_s, keyframe.median_depth_m, slack_m=limits.slack_m)
        if moved_m <= reach_m or self._shows_its_speed(state, frame, candidate):
            return candidate
        return Reason.OBSTRUCTED

    @staticmethod
    def _shows_its_speed(state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate) -> bool:
        """Whether it is the first frame after one whose velocity is not known, and most features are there."""
        if state.lost or len(state.recent) > 1:
            return False
        first, T = state.keyframes[candidate.keyframe_index].features, candidate.result.T_reference_target
        return features_agree(first, frame.features, T, state.config.keyframes.judgment)


def _features_prefer(T: Array, T_other: Array, keyframe: TrackedKeyframe, frame: CurrentFrame) -> bool:
    """Whether features say that the camera is at T rather than at T_other.

    The keyframe's features, with their depth, are compared with where the frame's color shows them: its depth, which
    may be of another time, takes no part.
    """
    limits = frame.relocalization
    pairs = matches(keyframe.features.descriptors, frame.features.descriptors, limits.ratio)
    seen = frame.features.points[pairs[:, 1]].astype(np.float64)
    points = keyframe.features.points[pairs[:, 0]].astype(np.float64)
    angles, other = (angles_between(se3.transform(se3.inverse(X), points), seen) for X in (T, T_other))
    agree = np.minimum(angles, other) < limits.max_angle_rad
    if agree.sum() < limits.min_inliers:
        return False
    return bool(np.median(angles[agree]) <= np.median(other[agree]))


FOLLOWED: tuple[PoseCheck, ...] = (
    WellConstrained(),
    MatchesPrediction(),
    DepthColorConsistency(),
    FeaturesAllowWorseLook(),
    BearingsDoNotContradict(),
)
"""Checks of a frame that was registered from where it was predicted."""

PLAUSIBLE: tuple[PoseCheck, ...] = (
    SharesEnough(),
    LooksAlike(),
    RespectsFreeSpace(),
    WithinReach(),
    FeaturesConfirm(),
    BearingsDoNotContradict(),
)
"""Checks of a pose that was not simply followed."""

FOUND_AGAIN: tuple[PoseCheck, ...] = (*PLAUSIBLE, DoesNotFollowMovedThings())
"""Checks of the place of a camera that was lost for long: meanwhile things may have moved."""

FOUND_NEARBY: tuple[PoseCheck, ...] = (*PLAUSIBLE, DepthColorConsistency())
"""Checks of a pose that was found near the last one."""

FOUND_BY_FEATURES: tuple[PoseCheck, ...] = (
    RespectsFreeSpace(),
    WithinReach(),
    FeaturesConfirm(),
    FeaturesDoNotContradict(),
    BearingsDoNotContradict(),
)
"""Checks of a pose that was found from matched features, whose descriptors say that it looks alike: far from its
keyframe a frame overlaps little, and its gray values fit less well than from near."""

FOUND_BY_BEARINGS: tuple[PoseCheck, ...] = (
    LooksNoWorseThanUsual(),
    RespectsFreeSpace(),
    WithinReach(),
    FeaturesDoNotContradict(),
)
"""Checks of a pose that features with and without depth agree on: they may be of what moves with the camera."""

FOUND_FROM_ALL_AROUND: tuple[PoseCheck, ...] = (
    LooksNoWorseThanUsual(),
    RespectsFreeSpace(),
    WithinReach(),
    FeaturesDoNotContradict(),
    BearingsDoNotContradict(),
)
"""Checks of a pose that registrations from all around the prediction lead to."""
