"""A camera that goes back sees all of its keyframe, and more and more that no keyframe has."""

from types import SimpleNamespace

import numpy as np
import pytest

from duagc.pipeline.config.frontend import KeyframeConfig
from duagc.pipeline.frontend.keyframe_graph import becomes_keyframe, shared_view
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.registration import RgbdPyramid

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 159.5, 119.5)


def wall(distance_m: float) -> RgbdPyramid:
    depth = np.full((240, 320), distance_m, np.float32)
    return RgbdPyramid.build(np.full((240, 320, 3), 128, np.uint8), depth, CAMERA, 3)


@pytest.mark.parametrize(("back_m", "becomes"), [(0.1, False), (0.2, False), (0.3, True), (0.5, True)])
def test_a_camera_that_goes_back_makes_keyframes(back_m: float, becomes: bool) -> None:
    """Two meters from a wall: before, the first one came 0.6 m on, when half of the view was in no keyframe."""
    result = SimpleNamespace(
        overlap=1.0, view=1.0, T_reference_target=se3.exp(np.array([0, 0, -back_m, 0, 0, 0]))
    )
    assert shared_view(result, wall(2.0 + back_m)) == pytest.approx((2.0 / (2.0 + back_m)) ** 2, abs=0.02)
    assert becomes_keyframe(result, wall(2.0 + back_m), KeyframeConfig()) is becomes


def test_a_camera_that_goes_on_shares_what_it_sees_of_its_keyframe() -> None:
    result = SimpleNamespace(
        overlap=0.7, view=0.6, T_reference_target=se3.exp(np.array([0, 0, 0.3, 0, 0, 0]))
    )
    assert shared_view(result, wall(1.7)) == 0.6
