"""Registrations near the last pose: each is stated with the keyframe that it is to."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from duagc.pipeline import registration
from duagc.pipeline.experiments.disturbed_tracking import Undisturbed
from duagc.pipeline.frontend import feature_checks, nearby_registration, reach, stable_registration
from duagc.pipeline.frontend.current_frame import CurrentFrame, PoseCandidate
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.frame_images import RgbdImages
from duagc.pipeline.frontend.pose_checks import DepthColorConsistency
from duagc.pipeline.frontend.tracking_state import TrackingState
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import Outcome
from duagc.pipeline.registration.align import reach_factor
from tests.frontend.conftest import START_OF_COMPARISONS as START
from tests.frontend.conftest import STARTS


def prepared(run: Undisturbed, start: int = START) -> tuple[TrackingState, CurrentFrame]:
    tracker, shot = run.tracker(start), run.shots[start]
    image = shot.color.astype(np.float32) / 255
    frame = tracker.prepared(
        RgbdImages(frame_index=shot.index, stamp_ns=shot.stamp_ns, image=image, depth_m=shot.depth)
    )
    return tracker.state, frame


def test_wide_gates_are_of_the_latest_keyframe_whatever_features_find(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, frame = prepared(run)
    T_first_latest = se3.inverse(state.keyframes[0].T_map_keyframe) @ state.keyframe.T_map_keyframe
    elsewhere = [(0, T_first_latest @ state.T_keyframe_camera)]
    monkeypatch.setattr(nearby_registration, "initial_motions", lambda state, frame: iter(elsewhere))
    found = [candidate for candidate, _ in nearby_registration._attempts(state, frame)]
    assert state.keyframe_index > 0
    *_, by_features, _, wide = found
    assert by_features.keyframe_index == 0
    assert wide.keyframe_index == state.keyframe_index
    assert distance_m(run, state, wide) < 2e-3


def off_by(offset_m: float, gray_of_usual: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame that is followed ends well in a wrong minimum, where it looks so much worse than usual."""

    def register(reference, pyramid, T_guess, config, **options):
        result = registration.register(reference, pyramid, T_guess, config, **options)
        T = result.T_reference_target @ se3.exp(np.array([offset_m, 0.0, 0.0, 0.0, 0.0, 0.0]))
        return replace(result, T_reference_target=T, rms_gray=gray_of_usual * result.rms_gray)

    monkeypatch.setattr(nearby_registration, "register", register)


def distance_m(
    run: Undisturbed, state: TrackingState, found: PoseCandidate | Reason | None, start: int = START
) -> float:
    assert isinstance(found, PoseCandidate)
    T_map_camera = state.keyframes[found.keyframe_index].T_map_keyframe @ found.result.T_reference_target
    return float(se3.distance(T_map_camera, run.poses[start])[0])


def test_a_frame_that_looks_worse_than_usual_is_where_features_make_it_look_as_usual(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, frame = prepared(run)
    off_by(0.02, 2.0, monkeypatch)  # so little that features do not contradict
    assert distance_m(run, state, nearby_registration.register_nearby(state, frame)) < 2e-3


def test_without_such_a_place_it_stays_where_it_was_found(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, frame = prepared(run)
    off_by(0.02, 2.0, monkeypatch)
    monkeypatch.setattr(nearby_registration, "initial_motions", lambda state, frame: iter(()))
    assert distance_m(run, state, nearby_registration.register_nearby(state, frame)) == pytest.approx(
        0.02, abs=2e-3
    )


def test_features_reject_a_frame_that_looks_worse_than_usual(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, frame = prepared(run)
    off_by(0.1, 2.0, monkeypatch)
    monkeypatch.setattr(nearby_registration, "_looking_as_usual", lambda state, frame, found: found)
    assert distance_m(run, state, nearby_registration.register_nearby(state, frame)) < 2e-3


@pytest.mark.parametrize(("predicted_px", "off_m"), [(1.0, 0.02), (6.0, 0.0)])
def test_a_frame_far_from_its_prediction_is_where_it_fits_best_though_it_looks_as_usual(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch, predicted_px: float, off_m: float
) -> None:
    """Where a registration went farther than it converges from, it may have slid along a wall."""
    state, frame = prepared(run)
    predicted = state.predict(frame.stamp_ns)
    tangent = np.array([0.0, 0.0, 0.0, 0.0, state.deviation_rad(predicted_px), 0.0])
    aside = replace(predicted, T_keyframe_camera=predicted.T_keyframe_camera @ se3.exp(tangent))
    assert not state.weakly_predicted(aside)
    monkeypatch.setattr(state, "predict", lambda stamp_ns: aside)

    def unexpected(*_: object) -> None:
        raise AssertionError("residuals do not tell which of two keyframes is right")

    monkeypatch.setattr(nearby_registration, "initial_motions", unexpected)
    off_by(0.02, 1.3, monkeypatch)
    found = distance_m(run, state, nearby_registration.register_nearby(state, frame))
    assert found == pytest.approx(off_m, abs=2e-3)


@pytest.mark.parametrize(("off_m", "asked"), [(0.0, 0), (0.02, 1)])
def test_a_frame_far_from_its_prediction_is_registered_again_unless_features_have_it_there(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch, off_m: float, asked: int
) -> None:
    state, frame = prepared(run)
    monkeypatch.setattr(nearby_registration, "went_far", lambda state, frame, found: True)
    again = []

    def register_until_stable(*arguments, **options):
        again.append(arguments)
        return stable_registration.register_until_stable(*arguments, **options)

    monkeypatch.setattr(nearby_registration, "register_until_stable", register_until_stable)
    off_by(off_m, 1.0 + 15 * off_m, monkeypatch)
    assert distance_m(run, state, nearby_registration.register_nearby(state, frame)) < 2e-3
    assert len(again) == asked


@pytest.mark.parametrize(("sigma_px", "off_m"), [(1.0, 0.02), (2.0, 0.0)])
def test_where_a_frame_may_be_out_of_reach_a_coarser_image_is_tried_too(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch, sigma_px: float, off_m: float
) -> None:
    """And the registration that fits better counts."""
    state, frame = prepared(run)
    predicted = replace(state.predict(frame.stamp_ns), sigma_px=sigma_px)
    assert not state.weakly_predicted(predicted)
    monkeypatch.setattr(state, "predict", lambda stamp_ns: predicted)
    monkeypatch.setattr(nearby_registration, "initial_motions", lambda state, frame: iter(()))
    usual = state.config.tracking.registration

    def register(reference, pyramid, T_guess, config, **options):
        result = registration.register(reference, pyramid, T_guess, config, **options)
        if len(config.iterations) > len(usual.iterations):
            return result
        T = result.T_reference_target @ se3.exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]))
        return replace(result, T_reference_target=T, rms_gray=1.3 * result.rms_gray)

    monkeypatch.setattr(nearby_registration, "register", register)
    found = distance_m(run, state, nearby_registration.register_nearby(state, frame))
    assert found == pytest.approx(off_m, abs=2e-3)


def test_of_two_minima_the_one_that_fewer_samples_fit_is_the_worse(run: Undisturbed) -> None:
    state, frame = prepared(run)
    found = nearby_registration.register_nearby(state, frame)
    assert isinstance(found, PoseCandidate)
    T = found.result.T_reference_target @ se3.exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]))
    slid = replace(found.result, T_reference_target=T, rms_gray=0.8 * found.result.rms_gray)
    for overlap, better in ((0.9, True), (0.5, False)):
        other = replace(found, result=replace(slid, overlap=overlap * found.result.overlap))
        assert nearby_registration.fits_better(state, other, found) == better


@pytest.mark.parametrize(("steps_m", "speed_m_s"), [([0.3] * 8, 18.0), ([0.3, -0.3] * 4, 3.0)])
def test_what_is_driven_may_be_faster_and_what_is_shaken_not(
    run: Undisturbed, steps_m: list[float], speed_m_s: float
) -> None:
    state, _ = prepared(run)
    for step_m in steps_m:
        state.stamp_ns += 33_333_333
        state.T_keyframe_camera = state.T_keyframe_camera @ se3.exp(np.array([step_m, 0, 0, 0, 0, 0]))
        state.remember_pose()
    fastest_m_s = reach.fastest_m_s(state.followed_m_s, state.config.tracking.failure)
    assert fastest_m_s == pytest.approx(speed_m_s, rel=0.02)
    depth_m = state.keyframe.median_depth_m
    in_a_second_m = speed_m_s * reach_factor(depth_m)
    assert reach.farthest_m(fastest_m_s, 1.0, depth_m) == pytest.approx(in_a_second_m, rel=0.02)


def test_features_are_not_asked_of_a_frame_that_looks_as_usual(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, frame = prepared(run)

    def unexpected(*_: object) -> None:
        raise AssertionError("features were asked")

    for module, name in ((nearby_registration, "initial_motions"), (feature_checks, "judge_motion")):
        monkeypatch.setattr(module, name, unexpected)
    assert distance_m(run, state, nearby_registration.register_nearby(state, frame)) < 2e-3


def all_around(state: TrackingState, frame: CurrentFrame, sigma_px: float) -> PoseCandidate | None:
    predicted = replace(state.predict(frame.stamp_ns), sigma_px=sigma_px)
    return nearby_registration._from_all_around(state, frame, predicted)


def test_what_all_starts_around_a_weak_prediction_lead_to_is_a_place(run: Undisturbed) -> None:
    state, frame = prepared(run)
    assert distance_m(run, state, all_around(state, frame, 3.0)) < 2e-3


@pytest.mark.parametrize("end", [Outcome.OK, Outcome.RESIDUAL])
def test_where_one_of_them_leads_elsewhere_or_nowhere_there_is_none(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch, end: Outcome
) -> None:
    state, frame = prepared(run)
    true_register, calls = nearby_registration.register_until_stable, count()

    def register(*arguments, **options):
        result = true_register(*arguments, **options)
        if next(calls) != 2:
            return result
        T = result.T_reference_target @ se3.exp(np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.0]))
        return replace(result, T_reference_target=T, outcome=end)

    monkeypatch.setattr(nearby_registration, "register_until_stable", register)
    assert all_around(state, frame, 3.0) is None


def test_a_camera_with_a_weak_prediction_and_few_features_is_followed_from_all_around(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = STARTS[1]  # from everywhere around it a registration converges
    state, frame = prepared(run, start)
    predicted = replace(state.predict(frame.stamp_ns), sigma_px=5.0)
    monkeypatch.setattr(state, "predict", lambda stamp_ns: predicted)
    monkeypatch.setattr(nearby_registration, "initial_motions", lambda state, frame: iter(()))
    monkeypatch.setattr(feature_checks, "features_agree", lambda *_: False)
    assert distance_m(run, state, nearby_registration.register_nearby(state, frame), start) < 2e-3
    monkeypatch.setattr(nearby_registration, "_from_all_around", lambda *_: None)
    assert nearby_registration.register_nearby(state, frame) is Reason.OBSTRUCTED


def test_features_verify_a_frame_that_shares_little_with_its_keyframe(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after a held-out frame, where every frame moves on by a third of the view."""
    state, frame = prepared(run)
    assert not state.weakly_predicted(state.predict(frame.stamp_ns))
    more, usual = {"min_overlap": 0.999}, state.config.tracking
    settings = {name: getattr(usual, name).model_copy(update=more) for name in ("registration", "recovery")}
    tracking = usual.model_copy(update=settings)
    state.config = state.config.model_copy(update={"tracking": tracking})
    assert distance_m(run, state, nearby_registration.register_nearby(state, frame)) < 2e-3
    monkeypatch.setattr(feature_checks, "features_agree", lambda *_: False)
    assert nearby_registration.register_nearby(state, frame) is Reason.LOW_OVERLAP


class ByColor:
    """A check that leaves color alone, which is off by a shift to the right."""

    def __init__(self, shift_m: float = 0.0) -> None:
        self.T_camera_color = se3.exp(np.array([shift_m, 0.0, 0.0, 0.0, 0.0, 0.0]))

    def judge(
        self, state: TrackingState, frame: CurrentFrame, candidate: PoseCandidate
    ) -> PoseCandidate | Reason:
        result = candidate.result
        moved = replace(result, T_reference_target=result.T_reference_target @ self.T_camera_color)
        return replace(candidate, result=moved, without=Reason.CONTRADICTION)


def test_color_alone_gives_way_to_where_features_make_a_frame_look_as_usual(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, frame = prepared(run)
    monkeypatch.setattr(nearby_registration, "FOLLOWED", (ByColor(0.03),))
    found = nearby_registration.register_nearby(state, frame)
    assert distance_m(run, state, found) < 2e-3
    assert isinstance(found, PoseCandidate)
    assert found.without is Reason.NONE
    monkeypatch.setattr(nearby_registration, "initial_motions", lambda state, frame: iter(()))
    found = nearby_registration.register_nearby(state, frame)
    assert isinstance(found, PoseCandidate)
    assert found.without is Reason.CONTRADICTION


def test_color_alone_does_not_take_the_place_of_color_and_depth(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame that looks worse than usual; from features depth contradicts color."""
    state, frame = prepared(run)
    off_by(0.02, 2.0, monkeypatch)
    monkeypatch.setattr(nearby_registration, "FOUND_NEARBY", (ByColor(),))
    found = nearby_registration.register_nearby(state, frame)
    assert isinstance(found, PoseCandidate)
    assert found.without is Reason.NONE
    assert distance_m(run, state, found) == pytest.approx(0.02, abs=2e-3)


@pytest.mark.parametrize("off_m", [0.03, -0.03])
def test_features_decide_whether_color_alone_contradicts_depth(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch, off_m: float
) -> None:
    """A pattern of light that moves with the camera takes color alone along; late depth holds back the other pose."""
    state, frame = prepared(run)
    predicted = state.predict(frame.stamp_ns)
    assert not state.weakly_predicted(predicted)
    right = nearby_registration.register_predicted(
        state, frame, predicted, state.config.tracking.registration
    )
    off = right.T_reference_target @ se3.exp(np.array([off_m, 0.0, 0.0, 0.0, 0.0, 0.0]))
    wrong = replace(right, T_reference_target=off)

    def judged(both: registration.Registration, color: registration.Registration) -> PoseCandidate | Reason:
        state.depth_color_inconsistent = False
        monkeypatch.setattr(state, "register_color", lambda frame: color)
        unusual = replace(both, rms_gray=2.0 * state.usual_gray_rms)
        candidate = PoseCandidate(state.keyframe_index, unusual)
        return DepthColorConsistency().judge(state, frame, candidate)

    found = judged(right, wrong)
    assert isinstance(found, PoseCandidate)
    assert found.without is Reason.NONE
    assert distance_m(run, state, found) < 2e-3
    found = judged(wrong, right)
    assert found is Reason.CONTRADICTION or distance_m(run, state, found) < 2e-3
