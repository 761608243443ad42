"""Registration of a frame near the last pose of the camera, from several starts, each with the checks to pass."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import product

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import TrackingConfig
from duagc.pipeline.frontend.bearing_registration import register_by_bearings
from duagc.pipeline.frontend.current_frame import CurrentFrame, PoseCandidate
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.feature_initialization import feature_motion, initial_motions
from duagc.pipeline.frontend.pose_checks import (
    FOLLOWED,
    FOUND_BY_BEARINGS,
    FOUND_BY_FEATURES,
    FOUND_FROM_ALL_AROUND,
    FOUND_NEARBY,
    PLAUSIBLE,
    PoseCheck,
    verify,
)
from duagc.pipeline.frontend.prediction import Prediction
from duagc.pipeline.frontend.stable_registration import register_until_stable
from duagc.pipeline.frontend.tracking_state import TrackingState
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.statistics import CHI2_6_MEDIAN
from duagc.pipeline.registration import Outcome, Registration, RegistrationConfig, register

REACH_SIGMAS = 3.0
"""Standard deviations of a prediction within which a view is taken to be."""


def register_nearby(state: TrackingState, frame: CurrentFrame) -> PoseCandidate | Reason:
    """The first registration near the last pose that passes its checks, or why the first one failed.

    Args:
        state: what the tracker knows.
        frame: the current frame.
    """
    reason = Reason.NONE
    for candidate, checks in _attempts(state, frame):
        found = verify(checks, state, frame, candidate)
        if isinstance(found, PoseCandidate):
            return found if found.by_bearings else _looking_as_usual(state, frame, found)
        reason = reason if reason is not Reason.NONE else found
    return reason


def register_predicted(
    state: TrackingState, frame: CurrentFrame, predicted: Prediction, config: RegistrationConfig
) -> Registration:
    """Register a frame to the latest keyframe from where it is predicted, with what the prediction knows.

    Args:
        state: what the tracker knows.
        frame: the current frame.
        predicted: where it should be.
        config: of the registration.
    """
    return register(
        state.keyframe.reference,
        frame.pyramid,
        predicted.T_keyframe_camera,
        config,
        prior_information=predicted.information,
    )


def _looking_as_usual(state: TrackingState, frame: CurrentFrame, found: PoseCandidate) -> PoseCandidate:
    """What was found, or where features have the frame, if only there it looks as usual, or it fits better there.

    A registration that went farther from the prediction than it converges from may have ended in a wrong minimum that
    looks as usual, too: unless features have the frame no farther from there than they are uncertain.
    """
    usual, motions = _looks_as_usual(state, found), None
    if usual:
        if not went_far(state, frame, found):
            return found
        index = found.keyframe_index  # residuals tell which of the minima of one keyframe is deeper
        motion = feature_motion(state, frame, index)
        T = motion.accepted_motion
        if T is None or motion.chi2(found.result.T_reference_target) < CHI2_6_MEDIAN:
            return found
        motions = ((index, T),)
    for candidate in _from_features(state, frame, state.config.tracking, motions):
        other = verify(FOUND_NEARBY, state, frame, candidate)
        if isinstance(other, PoseCandidate) and (
            (not usual and _looks_as_usual(state, other)) or fits_better(state, other, found)
        ):
            return other
    return found


def went_far(state: TrackingState, frame: CurrentFrame, found: PoseCandidate) -> bool:
    """Whether a view is, or may well be, farther from its prediction than dense registration converges from.

    Args:
        state: what the tracker knows.
        frame: the current frame.
        found: where it was found.
    """
    if found.without is not Reason.NONE or state.lost:
        return False
    predicted = state.predict(frame.stamp_ns)
    if _may_be_beyond_reach(state, predicted):
        return True
    moved_px = state.distance_px(predicted.T_keyframe_camera, state.in_keyframe(found))
    return predicted.sigma_px > 0 and moved_px > state.config.tracking.prior.max_deviation_px


def _may_be_beyond_reach(state: TrackingState, predicted: Prediction) -> bool:
    """Whether a view may be farther from its prediction than dense registration converges from."""
    return REACH_SIGMAS * predicted.sigma_px > state.config.tracking.prior.max_deviation_px


def fits_better(state: TrackingState, candidate: PoseCandidate, found: PoseCandidate) -> bool:
    """Whether another minimum of the same registration is the deeper one, by both residuals of unknown scales.

    Args:
        state: what the tracker knows.
        candidate: the other minimum.
        found: the one that was found.
    """
    other, result, tracking = candidate.result, found.result, state.config.tracking
    if candidate.keyframe_index != found.keyframe_index or candidate.without is not found.without:
        return False
    apart_m, apart_rad = se3.distance(result.T_reference_target, other.T_reference_target)
    apart = apart_m > tracking.stable_m or apart_rad > tracking.stable_rad
    return bool(apart and _misfit(other) < _misfit(result))


def _misfit(result: Registration) -> float:
    """How badly views fit: both residuals, of unknown scales, and the share of the samples that they are of.

    Residuals are of samples that agree. A wrong minimum may have small ones, for it leaves out what does not fit.
    """
    return result.rms_gray * result.rms_depth_m / max(result.overlap, 1e-6)


def _or_from_coarser(
    state: TrackingState, frame: CurrentFrame, predicted: Prediction, found: PoseCandidate
) -> PoseCandidate:
    """The same, or a registration that begins one image coarser, where that fits better.

    A view is rarely farther from its prediction than `REACH_SIGMAS` standard deviations. Where that is beyond what a
    registration reaches, a coarser image reaches twice as far; but it shows less, and may lead astray itself.
    """
    tracking = state.config.tracking
    usual, iterations = tracking.registration, tracking.recovery.iterations
    if not _may_be_beyond_reach(state, predicted) or len(iterations) <= len(usual.iterations):
        return found
    coarser = usual.model_copy(
        update={"iterations": (*usual.iterations, *iterations[len(usual.iterations) :])}
    )
    result = register_predicted(state, frame, predicted, coarser)
    other = PoseCandidate(found.keyframe_index, result)
    if result.ok and (not found.result.ok or fits_better(state, other, found)):
        return other
    return found


def _looks_as_usual(state: TrackingState, candidate: PoseCandidate) -> bool:
    """Whether color and depth were used, and gray values fit no worse than usual."""
    return candidate.without is Reason.NONE and not state.looks_worse_than_usual(candidate.result)


def _attempts(
    state: TrackingState, frame: CurrentFrame
) -> Iterator[tuple[PoseCandidate, Sequence[PoseCheck]]]:
    """Registrations near the last pose, each with its checks.

    From the prediction, from the motion that features agree on, then with wider gates. Where the prediction is
    weak, features come first and may outweigh what looks unlike, and color alone, which starts from it, is no
    check. Where it is not, what looks unlike is another place; of a keyframe little may be seen all the same.
    """
    tracking, index = state.config.tracking, state.keyframe_index
    last, predicted = state.T_keyframe_camera, state.predict(frame.stamp_ns)
    weak = state.weakly_predicted(predicted)
    starts = [predicted]
    if predicted.T_keyframe_camera is not last:
        starts.append(Prediction(last, None))
    few = frame.has_few_depths or state.keyframe.features.bearings.few_depths
    if few and (by_bearings := _by_bearings(state, frame, predicted)) is not None:
        yield by_bearings, FOUND_BY_BEARINGS
    if weak:
        for candidate in _from_features(state, frame, tracking.verified_by_features()):
            yield candidate, FOUND_BY_FEATURES
    little = False
    if not state.lost:
        for start in starts:
            candidate = PoseCandidate(index, register_predicted(state, frame, start, tracking.registration))
            little |= candidate.result.outcome is Outcome.LOW_OVERLAP
            if start is predicted and not weak:
                candidate = _or_from_coarser(state, frame, predicted, candidate)
            yield candidate, PLAUSIBLE if weak else FOLLOWED
    if not weak:
        for candidate in _from_features(state, frame, tracking):
            yield candidate, FOUND_NEARBY
    for start in starts:
        result = register_until_stable(
            state.keyframe, frame.pyramid, start.T_keyframe_camera, tracking, first=tracking.recovery
        )
        yield PoseCandidate(index, result), PLAUSIBLE if weak else FOUND_NEARBY
    if weak and (agreed := _from_all_around(state, frame, predicted)) is not None:
        yield agreed, FOUND_FROM_ALL_AROUND
    if little and not weak:
        for candidate in _sharing_little(state, frame, predicted):
            yield candidate, FOUND_BY_FEATURES
    if not few and (by_bearings := _by_bearings(state, frame, predicted)) is not None:
        yield by_bearings, FOUND_BY_BEARINGS


def _by_bearings(state: TrackingState, frame: CurrentFrame, predicted: Prediction) -> PoseCandidate | None:
    """The registration that features with and without depth lead to, from the prediction or from the last pose."""
    tracking = state.config.tracking
    result = register_by_bearings(
        state.keyframe,
        frame.pyramid,
        frame.features,
        [predicted.T_keyframe_camera, state.T_keyframe_camera],
        config=tracking.verified_by_features().registration,
        ratio=tracking.relocalization.ratio,
    )
    return None if result is None else PoseCandidate(state.keyframe_index, result, by_bearings=True)


def _sharing_little(
    state: TrackingState, frame: CurrentFrame, predicted: Prediction
) -> Iterator[PoseCandidate]:
    """Registrations that features verify, and that need less overlap for it.

    Every frame moves on by much where baselines are wide, and a held-out one leaves no keyframe: the next then shares
    what two steps leave of the view, less where depth has holes.
    """
    tracking = state.config.tracking.verified_by_features()
    result = register_predicted(state, frame, predicted, tracking.registration)
    yield PoseCandidate(state.keyframe_index, result)
    yield from _from_features(state, frame, tracking)


def _from_all_around(
    state: TrackingState, frame: CurrentFrame, predicted: Prediction
) -> PoseCandidate | None:
    """The registration that is reached from all around the prediction, as far as the camera may be from it.

    Where views share few features, and the prediction is weak, a registration may end in a wrong minimum near its
    start. One that all starts lead to is the only minimum there. None: they do not.
    """
    tracking, turn_rad = state.config.tracking, state.deviation_rad(predicted.sigma_px)
    found: list[Registration] = []
    for axis, sign in product((3, 4), (-1.0, 1.0)):  # up, down, left and right
        tangent = np.zeros(6)
        tangent[axis] = sign * turn_rad
        start = predicted.T_keyframe_camera @ se3.exp(tangent)
        result = register_until_stable(
            state.keyframe, frame.pyramid, start, tracking, first=tracking.recovery
        )
        if not result.ok:
            return None
        found.append(result)
    first = found[0].T_reference_target
    distances = [se3.distance(first, other.T_reference_target) for other in found[1:]]
    agree = all(m < tracking.stable_m and rad < tracking.stable_rad for m, rad in distances)
    return PoseCandidate(state.keyframe_index, found[0]) if agree else None


def _from_features(
    state: TrackingState,
    frame: CurrentFrame,
    tracking: TrackingConfig,
    motions: Iterable[tuple[int, Array]] | None = None,
) -> Iterator[PoseCandidate]:
    """Registrations by some settings from motions, keyframes each with T_keyframe_camera; None: `initial_motions`."""
    for index, guess in initial_motions(state, frame) if motions is None else motions:
        result = register_until_stable(
            state.keyframes[index], frame.pyramid, guess, tracking, first=tracking.registration
        )
        yield PoseCandidate(index, result)
