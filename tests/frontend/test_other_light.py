"""A camera that carries its lamp through the dark, with a pattern of light that moves with it, and noisy images."""

import numpy as np
import pytest

from duagc.pipeline.config.frontend import FrontendConfig, TrackingConfig
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import Outcome, Reference, Registration, RgbdPyramid, register
from tests.fixtures.frame_images import rgbd
from tests.fixtures.room import CAMERA, detailed, pose

CONFIG = FrontendConfig(tracking=TrackingConfig(strides=(2, 1, 1, 1)))
U, V = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))


def walk(step: float) -> np.ndarray:
    """T_world_camera of a slow turn with a sideways step."""
    return pose(x=-0.4 + 0.02 * step, z=-0.9, yaw=0.5 - 0.02 * step)


def lit(gray: np.ndarray, depth_m: np.ndarray, *, half: float, power: float, seed: int) -> np.ndarray:
    """The image of a scene in the light of a lamp at the camera, with the noise of a dark image.

    Args:
        gray: in even light, [h, w].
        depth_m: [h, w], meters.
        half: standard deviation of the beam, a share of the width.
        power: light at one meter.
        seed: of the noise.
    """
    r2 = ((U - CAMERA.cx) ** 2 + (V - CAMERA.cy) ** 2) / (half * CAMERA.width) ** 2
    light = power * np.exp(-0.5 * r2) / np.maximum(depth_m, 0.3) ** 2
    noise = 0.004 * np.random.default_rng(seed).standard_normal(gray.shape)
    linear = np.clip(gray.astype(np.float64) ** 2.2 * light + noise, 0, 1)
    return (np.rint(255 * linear ** (1 / 2.2)) / 255).astype(np.float32)


def shot(step: float) -> tuple[np.ndarray, np.ndarray]:
    """Gray image in even light, and depth."""
    color, depth_m = detailed(walk(step))
    return (color[..., 0] / 255).astype(np.float32), depth_m


@pytest.mark.parametrize(("half", "power"), [(0.3, 0.2), (0.2, 0.3)])
def test_a_lamp_on_the_camera_is_followed_through_the_dark(half: float, power: float) -> None:
    tracker, frames = Tracker(CAMERA, CONFIG), []
    for k in range(24):
        gray, depth_m = shot(k)
        dark = lit(gray, depth_m, half=half, power=power, seed=k)
        frames.append(tracker.track(rgbd(k, dark, depth_m)))
    assert [f.status for f in frames] == [Status.OK] * 24
    assert len(tracker.keyframes) >= 3  # partly black, as all images there
    poses = [tracker.keyframes[f.keyframe_index].T_map_keyframe @ f.T_keyframe_camera for f in frames]
    errors = [se3.distance(T, se3.inverse(walk(0)) @ walk(k))[0] for k, T in enumerate(poses)]
    assert max(errors) < 0.01


def registered(power: float = 0.2, mirrored: bool = False) -> Registration:
    """A dark view from where it is; with other pictures on the same surfaces, or in other light."""
    pyramids = []
    for k, light in ((0, 0.2), (1, power)):
        gray, depth_m = shot(k)
        shown = gray[:, ::-1] if mirrored and k == 1 else gray
        dark = lit(shown, depth_m, half=0.3, power=light, seed=k)
        pyramids.append(RgbdPyramid.build(dark, depth_m, CAMERA))
    reference = Reference.from_pyramid(pyramids[0], (2, 1, 1))
    return register(reference, pyramids[1], se3.inverse(walk(0)) @ walk(1))


def test_noise_that_makes_the_gain_small_does_not_reject_a_dark_view() -> None:
    result = registered()
    assert result.exposure[0] < 0.5
    assert result.ok


def test_other_pictures_and_a_black_image_are_rejected_in_the_dark_too() -> None:
    assert registered(mirrored=True).outcome is Outcome.RESIDUAL
    assert registered(power=0.0).outcome is Outcome.RESIDUAL
