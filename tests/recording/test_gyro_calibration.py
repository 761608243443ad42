"""A gyroscope with a bias, mounted otherwise than the log says, or in other units, against what the images say."""

from types import SimpleNamespace

import numpy as np
import pytest

from duagc.pipeline.config.frontend import FrontendConfig, TrackingConfig
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.recording import Motion
from duagc.pipeline.recording.gyro_calibration import FEWEST, GyroCorrection, Turn
from tests.fixtures.frame_images import rgbd
from tests.fixtures.room import CAMERA, pose, render

STATED = 0.02  # rad/s
BIAS = np.array([0.08, -0.05, 0.03])
MOUNTED = so3.exp([0.2, -1.3, 0.6])


def turns(count: int = 60, *, gyro=lambda rate: rate, axes: int = 3) -> list[Turn]:
    """Rates of about 0.7 rad/s by images with a noise of 0.01 rad/s, and what a gyroscope makes of the true ones."""
    rng = np.random.default_rng(0)
    true = np.cumsum(0.15 * rng.standard_normal((count, 3)), axis=0)
    true[:, axes:] = 0
    return [Turn(gyro(rate), rate + 0.01 * rng.standard_normal(3)) for rate in true]


def test_a_bias_is_found() -> None:
    found = GyroCorrection.of(turns(gyro=lambda rate: rate + BIAS), STATED)
    np.testing.assert_array_equal(found.R_camera_gyro, np.eye(3))
    np.testing.assert_allclose(found.bias_rad_s, BIAS, atol=0.005)
    assert 0.005 < found.sigma_rad_s < 0.015
    T = found.corrected(so3.exp(0.1 * (np.array([0.3, 0.0, -0.2]) + BIAS)), 0.1)
    np.testing.assert_allclose(so3.log(T), [0.03, 0.0, -0.02], atol=1e-3)


def test_a_wrong_mounting_is_found_with_its_bias() -> None:
    found = GyroCorrection.of(turns(gyro=lambda rate: MOUNTED.T @ (rate + BIAS)), STATED)
    np.testing.assert_allclose(found.R_camera_gyro, MOUNTED, atol=0.02)
    np.testing.assert_allclose(found.bias_rad_s, BIAS, atol=0.01)
    assert found.helps


def test_a_mounting_is_not_changed_for_what_noise_explains() -> None:
    found = GyroCorrection.of(turns(gyro=lambda rate: so3.exp([0.004, 0, 0]) @ rate), STATED)
    np.testing.assert_array_equal(found.R_camera_gyro, np.eye(3))


def test_turns_about_one_axis_do_not_tell_the_mounting() -> None:
    found = GyroCorrection.of(turns(gyro=lambda rate: MOUNTED.T @ rate, axes=1), STATED)
    np.testing.assert_array_equal(found.R_camera_gyro, np.eye(3))
    assert not found.helps


@pytest.mark.parametrize("gyro", [lambda rate: np.rad2deg(rate), lambda rate: np.roll(rate, 1) * [-1, 1, 1]])
def test_what_no_mounting_explains_is_not_believed(gyro) -> None:
    assert not GyroCorrection.of(turns(gyro=gyro), STATED).helps


def test_few_turns_correct_nothing() -> None:
    found = GyroCorrection.of(turns(FEWEST - 1, gyro=lambda rate: rate + BIAS), STATED)
    assert found.helps
    assert not found.bias_rad_s.any()


def test_turns_that_neither_sensor_sees_are_still() -> None:
    known = GyroCorrection(MOUNTED, BIAS, 0.01)
    noise = np.array([0.02, -0.01, 0.01])
    still = Turn(MOUNTED.T @ (BIAS + noise), noise)
    assert known.is_still(still, STATED)
    assert not known.is_still(Turn(still.by_gyro, np.array([0.1, 0, 0])), STATED)
    assert not known.is_still(Turn(MOUNTED.T @ (BIAS + np.array([0.1, 0, 0])), noise), STATED)


def test_a_pause_does_not_make_the_mounting_forgotten() -> None:
    state = Tracker(CAMERA, FrontendConfig()).state
    moving = turns(90, gyro=lambda rate: MOUNTED.T @ (rate + BIAS))
    rng = np.random.default_rng(1)
    noise = [0.01 * rng.standard_normal((2, 3)) for _ in range(90)]
    still = [Turn(MOUNTED.T @ (BIAS + by_gyro), by_images) for by_gyro, by_images in noise]
    steps = iter([*moving, *still])
    for _ in range(180):
        turn = next(steps)
        rotation = so3.exp(turn.by_gyro / 30)
        T = se3.from_rotation_translation(rotation, np.zeros(3))
        state.motion = SimpleNamespace(between=lambda *_, T=T: Motion(T, knows_translation=False))
        state.compare_gyro(state.stamp_ns + 33_333_333, so3.exp(turn.by_images / 30))
    np.testing.assert_allclose(state.gyro.R_camera_gyro, MOUNTED, atol=0.05)
    np.testing.assert_allclose(state.gyro.bias_rad_s, BIAS, atol=0.02)


class Gyro:
    """Rotations of a walk by a gyroscope of a given mounting and bias."""

    def __init__(self, poses: list[np.ndarray], R: np.ndarray, bias: np.ndarray) -> None:
        self.poses, self.R, self.bias = poses, R, bias

    def between(self, start_ns: int, stop_ns: int) -> Motion:
        a, b = (self.poses[round(ns / 33_333_333)] for ns in (start_ns, stop_ns))
        turned = so3.log(a[:3, :3].T @ b[:3, :3]) + self.bias * (stop_ns - start_ns) * 1e-9
        rotation = so3.exp(self.R @ turned)
        return Motion(se3.from_rotation_translation(rotation, np.zeros(3)), knows_translation=False)


def test_a_tracker_follows_a_walk_whatever_its_gyroscope_says() -> None:
    """Nothing in the poses changes by a bias of 0.3 rad/s or another mounting; after some frames both are known."""
    poses = [
        pose(x=0.3 * np.sin(0.3 * k), z=-0.6, yaw=0.15 * np.sin(0.5 * k), pitch=0.1 * np.sin(0.8 * k))
        for k in range(24)
    ]
    config = FrontendConfig(tracking=TrackingConfig(strides=(2, 1, 1, 1)))
    images = [render(T) for T in poses]
    wrong = (np.eye(3), np.array([0.3, -0.3, 0.3])), (so3.exp([0, 0, np.pi / 2]), np.zeros(3))
    for R, bias in wrong:
        tracker = Tracker(CAMERA, config, Gyro(poses, R, bias))
        frames = [tracker.track(rgbd(k, *image)) for k, image in enumerate(images)]
        assert {frame.status for frame in frames} == {Status.OK}
        for frame, T in zip(frames, poses, strict=True):
            found = tracker.keyframes[frame.keyframe_index].T_map_keyframe @ frame.T_keyframe_camera
            moved_m, turned_rad = se3.distance(se3.inverse(poses[0]) @ T, found)
            assert moved_m < 2e-3
            assert turned_rad < 2e-3
        np.testing.assert_allclose(tracker.state.gyro.bias_rad_s, bias, atol=0.03)
        np.testing.assert_allclose(tracker.state.gyro.R_camera_gyro, R.T, atol=0.05)
