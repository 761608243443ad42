"""Times of frames: images that a driver repeats, or gives in bursts, and what they say of the velocity."""

import numpy as np

from duagc.pipeline.config.frontend import FrontendConfig, TrackingConfig
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3
from tests.fixtures.frame_images import rgbd
from tests.fixtures.room import CAMERA, pose, render

CONFIG = FrontendConfig(tracking=TrackingConfig(strides=(2, 1, 1, 1)))


def walk(step: float) -> np.ndarray:
    """T_world_camera [4, 4] of a sideways step with a slow turn, 2 cm and 1 degree a frame."""
    return pose(x=-0.4 + 0.022 * step, z=-0.9 + 0.008 * step, yaw=0.5 - 0.019 * step)


def test_frames_that_come_again_were_taken_when_they_came_first() -> None:
    """A driver under load repeats images; the camera goes on at its speed."""
    shown = [0, 1, 2, 2, 4, 5, 5, 5, 8]
    tracker = Tracker(CAMERA, CONFIG)
    for k, step in enumerate(shown):
        frame = tracker.track(rgbd(k, *render(walk(step))))
        assert frame.status is Status.OK
        if k > 1:  # 0.7 m/s, 0.6 rad/s, which would become 0 and then twice that
            speed = se3.log(se3.inverse(walk(step - 1)) @ walk(step)) * 30
            np.testing.assert_allclose(tracker.state.velocity, speed, atol=0.08)


def test_a_camera_that_stands_still_has_no_velocity() -> None:
    tracker = Tracker(CAMERA, CONFIG)
    for k in range(12):
        tracker.track(rgbd(k, *render(walk(min(k, 3)))))
    np.testing.assert_allclose(tracker.state.velocity, np.zeros(6), atol=1e-3)


def test_a_velocity_predicts_for_some_intervals_only() -> None:
    """Images that waited in a driver come in bursts: 1 ms apart, then none for 130 ms."""
    tracker = Tracker(CAMERA, CONFIG)
    for k in range(8):
        tracker.track(rgbd(k, *render(walk(0.1 * k)), stamp_ns=1_000_000 * k))
    late_ns = 1_000_000
    assert tracker.state.depth_motion(8_000_000, late_ns) is not None
    assert tracker.state.depth_motion(137_000_000, late_ns) is None
