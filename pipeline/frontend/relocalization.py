"""Relocalization: where a lost camera is, by its features and those of all keyframes.

A place counts only when later frames are tracked from there: one image can be mistaken.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import RelocalizationConfig
from duagc.pipeline.frontend.current_frame import CurrentFrame, PoseCandidate
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.keyframe_graph import predicted_overlap
from duagc.pipeline.frontend.matching_keyframes import most_matching
from duagc.pipeline.frontend.nearby_registration import register_nearby
from duagc.pipeline.frontend.pose_checks import FOUND_AGAIN, DoesNotFollowMovedThings, verify
from duagc.pipeline.frontend.reach import farthest_m, fastest_m_s
from duagc.pipeline.frontend.stable_registration import register_until_stable
from duagc.pipeline.frontend.tracking_state import TrackingState
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration.feature_motion import motion_from_features
from duagc.pipeline.registration.features import Features
from duagc.pipeline.registration.place_index import PlaceIndex


def place_candidates(
    view: Features,
    keyframes: Sequence[Features],
    frame_index: int,
    config: RelocalizationConfig,
    *,
    among: Sequence[int],
) -> Iterator[tuple[int, Array]]:
    """Keyframes that a view may show, the best first, each with the motion that its matched features agree on.

    Args:
        view: features of the lost view.
        keyframes: features of every keyframe.
        frame_index: names the random draws.
        config: how many are tried, and what they must share.
        among: indices of the keyframes that are compared.

    Yields:
        Keyframe index and T_keyframe_camera [4, 4].
    """
    for k in most_matching(view, keyframes, config, among):
        # the draws only choose which samples are tried: the same in every run
        rng = random_streams.generator(0, "relocalization", frame=frame_index, keyframe=k)
        motion = motion_from_features(keyframes[k], view, config, rng).accepted_motion
        if motion is not None:
            yield k, motion


@dataclass(frozen=True)
class _Unconfirmed:
    """A place where a lost camera may be, as of a time, and how many later frames agreed."""

    candidate: PoseCandidate
    stamp_ns: int
    agreed: int


class Relocalizer:
    """Finds a camera that has been lost for long: when one frame, and then as many as must confirm it, agree."""

    def __init__(self) -> None:
        self._unconfirmed: _Unconfirmed | None = None
        self._something_moved = False  # while the camera was lost
        self._index = PlaceIndex()

    def __getstate__(self) -> dict[str, object]:
        """Without the index, which follows from the keyframes: a copy makes its own."""
        return {"_unconfirmed": self._unconfirmed, "_something_moved": self._something_moved}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__ |= state | {"_index": PlaceIndex()}

    def reset(self) -> None:
        """Forget the place that waits for confirmation, and what moved: the camera was found."""
        self._unconfirmed, self._something_moved = None, False

    def locate(self, state: TrackingState, frame: CurrentFrame) -> PoseCandidate | Reason:
        """Where a frame is, or why that is not known.

        Where one view shows that something moved, others may show nothing else. Which is the place, a submap decides
        by all of its views (`submap_joining`).

        Args:
            state: what the tracker knows.
            frame: the current frame.
        """
        if self._something_moved:
            return Reason.SOMETHING_MOVED
        if self._unconfirmed is not None:
            confirmed = self._confirm(state, frame)
            if confirmed is not None:
                return confirmed
        place = self._find(state, frame)
        if isinstance(place, Reason):
            return self._noted(place)
        if state.config.tracking.relocalization.confirmations == 0:
            return place
        self._unconfirmed = _Unconfirmed(place, frame.stamp_ns, 0)
        return Reason.UNCONFIRMED

    def alike(self, state: TrackingState, frame: CurrentFrame) -> list[int]:
        """Indices of the keyframes that may show what a frame shows.

        Args:
            state: what the tracker knows.
            frame: the frame.
        """
        for keyframe in state.keyframes[len(self._index) :]:
            self._index.add(keyframe.features.descriptors)
        return self._index.alike(frame.features.descriptors)

    def _find(self, state: TrackingState, frame: CurrentFrame) -> PoseCandidate | Reason:
        """The place of a frame, near the last pose or among all keyframes, or why it is not near the last pose."""
        nearby = register_nearby(state, frame)
        if isinstance(nearby, PoseCandidate):
            return verify([DoesNotFollowMovedThings()], state, frame, nearby)
        return find_place(state, frame, self.alike(state, frame)) or nearby

    def _noted(self, reason: Reason) -> Reason:
        """Why a frame has no place; that something moved is remembered."""
        if reason is Reason.SOMETHING_MOVED:
            self._something_moved = True
        return reason

    def _confirm(self, state: TrackingState, frame: CurrentFrame) -> PoseCandidate | Reason | None:
        """Track on from a place that was found; None if the frame does not agree with it."""
        assert self._unconfirmed is not None
        before, self._unconfirmed = self._unconfirmed, None
        index, last = before.candidate.keyframe_index, before.candidate.result.T_reference_target
        tracking = state.config.tracking
        elapsed_s = (frame.stamp_ns - before.stamp_ns) * 1e-9
        speed_m_s = fastest_m_s(state.followed_m_s, tracking.failure)
        reach_m = farthest_m(speed_m_s, elapsed_s, state.keyframes[index].median_depth_m)
        candidate = None
        for start in _starts(state, frame, index, last):
            result = register_until_stable(
                state.keyframes[index], frame.pyramid, start, tracking, first=tracking.registration
            )
            found = verify(FOUND_AGAIN, state, frame, PoseCandidate(index, result))
            moved_m, _ = se3.distance(last, result.T_reference_target)
            if isinstance(found, PoseCandidate) and moved_m <= reach_m:
                candidate = found
                break
            if found is Reason.SOMETHING_MOVED:
                return self._noted(found)
        if candidate is None:
            return None
        if before.agreed + 1 >= tracking.relocalization.confirmations:
            return candidate
        self._unconfirmed = _Unconfirmed(candidate, frame.stamp_ns, before.agreed + 1)
        return Reason.UNCONFIRMED


def _starts(state: TrackingState, frame: CurrentFrame, keyframe_index: int, last: Array) -> Iterator[Array]:
    """Where the registration to a keyframe may start: at the last pose, or by features if the camera has left it."""
    yield last
    # the draws only choose which samples are tried: the same in every run
    rng = random_streams.generator(0, "confirmation", frame=frame.frame_index, keyframe=keyframe_index)
    features, config = state.keyframes[keyframe_index].features, state.config.tracking.relocalization
    moved = motion_from_features(features, frame.features, config, rng).accepted_motion
    if moved is not None:
        yield moved


def find_place(
    state: TrackingState, frame: CurrentFrame, among: Sequence[int]
) -> PoseCandidate | Reason | None:
    """The first keyframe, in the order of matching features, that a frame can be registered to.

    None if there is none, a reason if something moved between the two.

    Args:
        state: what the tracker knows.
        frame: the current frame.
        among: indices of the keyframes that are compared.
    """
    tracking = state.config.tracking
    features = [keyframe.features for keyframe in state.keyframes]
    for index, guess in place_candidates(
        frame.features, features, frame.frame_index, tracking.relocalization, among=among
    ):
        result = register_until_stable(
            state.keyframes[index], frame.pyramid, guess, tracking, first=tracking.registration
        )
        found = verify(FOUND_AGAIN, state, frame, PoseCandidate(index, result))
        if isinstance(found, PoseCandidate):
            return by_latest_keyframe(state, frame, found)
        if found is Reason.SOMETHING_MOVED:
            return found
    return None


def by_latest_keyframe(
    state: TrackingState, frame: CurrentFrame, found: PoseCandidate
) -> PoseCandidate | None:
    """A place that was found, by the latest keyframe that shows enough of it; None if one contradicts.

    Between keyframes far apart in time lies the drift of tracking. The path goes on from its end: by an early keyframe
    the camera would jump by all of that drift (5 cm in RedKitchen). A later keyframe whose pose is not plausible, but
    that has the camera elsewhere, leaves it open where the camera is.

    Args:
        state: what the tracker knows.
        frame: the current frame.
        found: the place.
    """
    tracking, limits = state.config.tracking, state.config.tracking.relocalization
    T_map_camera = state.keyframes[found.keyframe_index].T_map_keyframe @ found.result.T_reference_target
    tried = 0
    for keyframe in reversed(state.keyframes[found.keyframe_index + 1 :]):
        guess = se3.inverse(keyframe.T_map_keyframe) @ T_map_camera
        if predicted_overlap(keyframe.reference, frame.pyramid, guess) < limits.min_overlap:
            continue
        result = register_until_stable(keyframe, frame.pyramid, guess, tracking, first=tracking.registration)
        later = verify(FOUND_AGAIN, state, frame, PoseCandidate(keyframe.keyframe_index, result))
        if isinstance(later, PoseCandidate):
            return later
        if (
            result.ok
            and se3.distance(guess, result.T_reference_target)[0] > limits.max_keyframe_disagreement_m
        ):
            return None
        tried += 1
        if tried == limits.candidates:
            break
    return found
