"""Views whose camera moves while its shutter is open: mean of light, and exact derivatives."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.training import SparseStepsConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.open_shutter import color_of, light_of, mean_color
from duagc.pipeline.kernels import LossWeights, Rasterizer
from duagc.pipeline.kernels.sparse_steps import SparseSteps
from duagc.pipeline.kernels.training import TrainingStep, TrainingView
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.optimizer import TRAINED
from tests.kernels.scenes import make_scene

SCENE = make_scene("plain", n=60)
LARGE = SCENE.gaussians.replace(log_scales=SCENE.gaussians.log_scales + np.float32(1.0))
"""Gaussians whose ends, where they are cut off, are outside of the image: no derivative is taken of the cut."""
TWIST = np.array([0.1, 0.05, 0.02, 0.03, -0.05, 0.02])
MOMENTS = se3.exp(np.linspace(-1, 1, 3)[:, None] * TWIST)


def a_view() -> TrainingView:
    rng = np.random.default_rng(3)
    color = rng.random((SCENE.camera.height, SCENE.camera.width, 3)).astype(np.float32)
    depth_m = np.full(color.shape[:2], 2.5, np.float32)
    mask = rng.random(color.shape[:2]) < 0.8
    return TrainingView(color, depth_m, se3.inverse(SCENE.T_camera_map), mask, None, MOMENTS)


def step() -> TrainingStep:
    return TrainingStep(Rasterizer(), LossWeights(0.1, 1.0, 0.02, 0.04), "blended")


def test_light_is_averaged_and_not_color() -> None:
    colors = np.linspace(-0.1, 1.5, 200, dtype=np.float32)
    np.testing.assert_allclose(color_of(light_of(colors)), colors, atol=1e-6)
    black, white = np.zeros((1, 1, 3), np.float32), np.ones((1, 1, 3), np.float32)
    assert mean_color([black, white]).max() == pytest.approx(np.sqrt(0.5), abs=1e-3)
    np.testing.assert_allclose(mean_color([white] * 3), white, atol=1e-6)


@pytest.mark.parametrize("name", [*TRAINED, "pose"])
def test_derivatives_are_those_of_finite_differences(name: str) -> None:
    view, training = a_view(), step()

    def loss(gaussians: Gaussians, seen: TrainingView) -> float:
        return training.loss_of(gaussians, SCENE.camera, seen).value

    _, gradients = training.gradients(LARGE, SCENE.camera, view, pose=True)
    rng, h, ends = np.random.default_rng(5), 2e-3, []
    if name == "pose":
        way = rng.normal(size=6)
        for sign in (-h, h):
            moved = replace(view, T_map_camera=view.T_map_camera @ se3.exp(sign * way))
            ends.append(loss(LARGE, moved))
    else:
        # along the derivative of many Gaussians, whose sum is far above the rounding of the loss
        values = getattr(LARGE, name)
        way = np.sign(getattr(gradients, name)) * rng.random(values.shape)
        for sign in (-h, h):
            changed = LARGE.replace(**{name: (values + sign * way).astype(np.float32)})
            ends.append(loss(changed, view))
    expected = (ends[1] - ends[0]) / (2 * h)
    assert abs(expected) > 1e-3
    assert float((way * getattr(gradients, name)).sum()) == pytest.approx(expected, rel=0.025)


def test_a_camera_that_stands_still_sees_what_a_sharp_view_shows() -> None:
    view, training = a_view(), step()
    still = replace(view, T_camera_moment=np.repeat(np.eye(4)[None], 3, axis=0))
    sharp = replace(view, T_camera_moment=None)
    (a, by_a), (b, by_b) = (
        training.gradients(SCENE.gaussians, SCENE.camera, v, pose=True) for v in (still, sharp)
    )
    assert a.value == pytest.approx(b.value, rel=1e-5)
    for name in (*TRAINED, "pose"):
        np.testing.assert_allclose(getattr(by_a, name), getattr(by_b, name), rtol=2e-3, atol=1e-5)


def test_views_move_only_in_the_last_steps_and_by_halves() -> None:
    steps = SparseSteps(SparseStepsConfig(checkerboard=False, moving_from=0.7), SCENE.camera, 10)
    view = a_view()
    assert steps.at(6, 0).of(view).T_camera_moment is None
    first, second = (steps.at(step, step).of(view) for step in (7, 8))
    assert first.T_camera_moment is view.T_camera_moment
    assert first.mask is not None
    assert second.mask is not None
    assert not (first.mask & second.mask).any()
    still = replace(view, T_camera_moment=None)
    assert steps.at(7, 0).of(still) is still


def test_a_term_of_single_gaussians_is_refused() -> None:
    training = TrainingStep(Rasterizer(), LossWeights(0.1, 1.0, 0.02, 0.04, surface_weight=0.5), "ray_plane")
    with pytest.raises(DuagError, match=r"surface_weight: 0\.5, expected 0"):
        training.loss_of(LARGE, SCENE.camera, a_view())


def test_the_pose_alone_and_with_all_others_is_the_same() -> None:
    view, training = a_view(), step()
    _, both = training.gradients(LARGE, SCENE.camera, view, pose=True)
    _, alone = training.gradients(LARGE, SCENE.camera, view, pose=True, parameters=False)
    assert alone.means is None
    np.testing.assert_array_equal(alone.pose, both.pose)


@pytest.mark.parametrize(("name", "value"), [("color", np.nan), ("depth_m", -1.0)])
def test_images_that_no_camera_gives_are_refused(name: str, value: float) -> None:
    view = a_view()
    image = getattr(view, name).copy()
    image.flat[7] = value
    with pytest.raises(ValueError, match=f"{name} holds"):
        step().gradients(LARGE, SCENE.camera, replace(view, **{name: image}))
