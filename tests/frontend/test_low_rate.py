"""A camera whose frames are far apart: matched features give the start that no prediction gives."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from duagc.pipeline.experiments.disturbed_tracking import Undisturbed, track
from duagc.pipeline.experiments.shots import Shot
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3
from tests.fixtures.films import CAMERA
from tests.frontend.conftest import CONFIG

TURNING_BACK = (
    0,
    30,
    5,
    40,
    10,
    50,
    25,
    70,
    35,
    80,
    55,
    94,
)  # frames 22 mm apart: up to 1.2 m from one to the next


def poses_of(shots: list[Shot]) -> dict[int, np.ndarray]:
    """T_map_camera of the frames that were tracked, by their place in the film."""
    tracker = Tracker(CAMERA, CONFIG)
    found = {}
    for k, shot in enumerate(shots):
        frame, T_map_camera = track(tracker, replace(shot, index=k))
        if frame.status is not Status.LOST:
            found[shot.index] = T_map_camera
    return found


def test_a_camera_that_turns_back_at_a_low_rate_is_followed(run: Undisturbed) -> None:
    shots = [replace(run.shots[k], stamp_ns=400_000_000 * place) for place, k in enumerate(TURNING_BACK)]
    found = poses_of(shots)
    assert sorted(found) == sorted(TURNING_BACK)
    for k, T_map_camera in found.items():
        moved_m, turned_rad = se3.distance(run.poses[k], T_map_camera)
        assert moved_m < 0.005
        assert turned_rad < 0.003


@pytest.mark.parametrize("interval_s", [0.033, 0.2, 0.25, 0.4])
def test_the_last_velocity_predicts_the_next_frame_at_any_rate(run: Undisturbed, interval_s: float) -> None:
    tracker = Tracker(CAMERA, CONFIG)
    track(tracker, replace(run.shots[0], index=0, stamp_ns=0))
    state = tracker.state
    for k in range(1, 4):
        state.intervals.update(round(k * interval_s * 1e9))
    state.stamp_ns = round(3 * interval_s * 1e9)
    state.velocity = np.array([0.3, 0, 0, 0, 0.1, 0])
    late_s = interval_s + 0.01  # no camera is exact
    predicted = state.predict(state.stamp_ns + round(late_s * 1e9))
    assert se3.distance(predicted.T_keyframe_camera, se3.exp(late_s * state.velocity))[0] < 1e-6
    gap_s = 0.19 if interval_s < 0.1 else 0.0
    after = state.predict(state.stamp_ns + round((2.0 * max(interval_s, 0.2) + gap_s) * 1e9))
    np.testing.assert_array_equal(after.T_keyframe_camera, np.eye(4))


def test_a_log_may_begin_in_motion(run: Undisturbed) -> None:
    """No velocity is known after one frame: features come first, unless a sensor measures the whole motion."""
    tracker = Tracker(CAMERA, CONFIG)
    state, step_ns = tracker.state, 33_333_333
    track(tracker, replace(run.shots[0], index=0, stamp_ns=0))
    predicted = state.predict(step_ns)
    assert predicted.sigma_px < CONFIG.tracking.prior.max_deviation_px
    assert state.weakly_predicted(predicted)
    assert not state.weakly_predicted(replace(predicted, information=np.eye(6), sigma_px=0.0))
    track(tracker, replace(run.shots[1], index=1, stamp_ns=step_ns))
    assert not state.weakly_predicted(state.predict(2 * step_ns))


def test_the_gain_is_that_of_frames_with_depth(run: Undisturbed) -> None:
    """Color alone is compared with the last good frame, as dark as it is, not with the keyframe."""
    tracker = Tracker(CAMERA, CONFIG)
    for k in range(9):
        shot = replace(run.shots[k], index=k)
        if k > 0:
            shot = replace(shot, color=np.rint(0.6 * shot.color).astype(np.uint8))
        if k in (4, 6):
            shot = replace(shot, depth=np.zeros_like(shot.depth))
        frame, _ = track(tracker, shot)
        assert frame.status is Status.OK
        if k > 1:
            assert 0.55 < tracker.state.gain < 0.65
            assert 0.95 < tracker.state.gain_step < 1.05


def test_a_pose_by_an_older_keyframe_is_that_by_the_current_one(run: Undisturbed) -> None:
    tracker = Tracker(CAMERA, CONFIG)
    for k, shot in enumerate(run.shots[::4]):
        _, T_map_camera = track(tracker, replace(shot, index=k, stamp_ns=k * 133_333_333))
    state = tracker.state
    assert state.keyframe_index > 0
    for k, keyframe in enumerate(state.keyframes):
        T = se3.inverse(keyframe.T_map_keyframe) @ T_map_camera
        candidate = SimpleNamespace(keyframe_index=k, result=SimpleNamespace(T_reference_target=T))
        np.testing.assert_allclose(state.in_keyframe(candidate), state.T_keyframe_camera, atol=1e-9)
