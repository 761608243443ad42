"""Losses agree with their cotangents; metrics with their definitions."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from duagc.pipeline.config.training import LossConfig, SurfaceLossConfig
from duagc.pipeline.splat.losses import depth_certainty, halve, huber, rgbd_loss


@dataclass(frozen=True)
class Drawn:
    color: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray


def test_certainty_is_one_up_to_the_huber_width() -> None:
    sigma = np.array([[0.0, 0.01, 0.02, 0.04, 0.2]], np.float32)
    found = depth_certainty(np.ones_like(sigma), sigma, LossConfig(depth_huber_m=0.02))
    assert found is not None
    np.testing.assert_allclose(found, [[1, 1, 1, 0.5, 0.1]], rtol=1e-6)


def test_depth_of_which_nothing_is_stated_is_less_certain_far_away() -> None:
    loss = LossConfig(depth_huber_m=0.02, depth_sigma_quadratic_per_m=0.002)
    depth_m = np.array([[0.0, 1.0, 3.0, 10.0, 20.0]], np.float32)
    found = depth_certainty(depth_m, None, loss)
    assert found is not None
    np.testing.assert_allclose(found, [[1, 1, 1, 0.1, 0.025]], rtol=1e-6)
    assert depth_certainty(depth_m[:, :3], None, loss) is None
    assert depth_certainty(depth_m, None, SurfaceLossConfig()) is None


def test_noise_of_far_depth_does_not_make_surfaces_transparent() -> None:
    """A surface in 10 m, seen 0.3 m off: without certainty less opacity would lower the loss."""
    z = np.full((4, 4), 10.0, np.float32)
    color = np.full((4, 4, 3), 0.5, np.float32)
    alpha = np.full((4, 4), 0.9, np.float32)
    drawn = Drawn(color, alpha * (z + np.float32(0.3)), alpha)
    config = LossConfig()
    for trust, sign in ((depth_certainty(z, None, config), -1.0), (None, 1.0)):
        loss = rgbd_loss(drawn, color, z, config, certainty=trust)
        by_opacity = loss.d_depth * (z + np.float32(0.3)) + loss.d_alpha  # of a Gaussian where the render is
        assert (np.sign(by_opacity) == sign).all()


def views(seed: int = 0, h: int = 5, w: int = 7) -> tuple[Drawn, np.ndarray, np.ndarray]:
    """A render and a measured color and depth; every third depth is missing."""
    r = np.random.default_rng(seed)
    alpha = r.uniform(0.3, 1.0, (h, w)).astype(np.float32)
    z = r.uniform(1.0, 3.0, (h, w)).astype(np.float32)
    measured = (z + r.normal(0, 0.05, (h, w))).astype(np.float32)
    measured.ravel()[::3] = 0
    color = r.uniform(0, 1, (h, w, 3)).astype(np.float32)
    drawn = Drawn((color + r.normal(0, 0.2, color.shape)).astype(np.float32), alpha * z, alpha)
    return drawn, color, measured


@pytest.mark.parametrize("exposure", [(0.0, 0.0), (0.2, -0.05)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("uncertain", [False, True])
def test_cotangents_are_derivatives(exposure: tuple[float, float], masked: bool, uncertain: bool) -> None:
    drawn, color, depth = views()
    sure = np.random.default_rng(2).uniform(0.05, 1.0, depth.shape) if uncertain else None
    mask = np.random.default_rng(1).random(depth.shape) > 0.3 if masked else None
    config = LossConfig(color_huber=0.3, depth_huber_m=0.08)

    def value(d: Drawn, e: tuple[float, float] = exposure) -> float:
        wide = Drawn(*(x.astype(np.float64) for x in (d.color, d.depth, d.alpha)))
        measured = color.astype(np.float64), depth.astype(np.float64)
        return rgbd_loss(wide, *measured, config, exposure=e, mask=mask, certainty=sure).value

    loss = rgbd_loss(drawn, color, depth, config, exposure=exposure, mask=mask, certainty=sure)
    assert loss.value == pytest.approx(value(drawn), rel=1e-5)
    step = 1e-5  # float64 inside `value`: truncation of the quadratic part is exact, of the kinks rare
    for name, cotangent in (("color", loss.d_color), ("depth", loss.d_depth), ("alpha", loss.d_alpha)):
        for index in [(1, 2), (3, 4), (4, 6), (0, 0)]:
            bump = np.zeros_like(getattr(drawn, name), dtype=np.float64)
            bump[index] = step
            up = value(replace(drawn, **{name: getattr(drawn, name) + bump}))
            down = value(replace(drawn, **{name: getattr(drawn, name) - bump}))
            assert (up - down) / (2 * step) == pytest.approx(float(cotangent[index].sum()), abs=2e-6)
    a, b = exposure
    step = 1e-4
    by_gain = (value(drawn, (a + step, b)) - value(drawn, (a - step, b))) / (2 * step)
    by_offset = (value(drawn, (a, b + step)) - value(drawn, (a, b - step))) / (2 * step)
    assert loss.d_exposure == pytest.approx((by_gain, by_offset), abs=2e-6)


def test_depth_residual_vanishes_at_the_measured_depth_whatever_the_opacity() -> None:
    drawn, color, depth = views()
    z = np.where(depth > 0, depth, np.float32(9.0))
    loss = rgbd_loss(replace(drawn, depth=drawn.alpha * z), color, depth, LossConfig(alpha_weight=0.0))
    assert loss.depth == 0.0
    assert not loss.d_depth.any()
    assert not loss.d_alpha.any()


def test_pixels_outside_the_mask_do_not_count() -> None:
    drawn, color, depth = views()
    mask = np.zeros(depth.shape, bool)
    mask[1:3, 2:5] = True
    other = color.copy()
    other[~mask] = 0.5
    first, second = (rgbd_loss(drawn, c, depth, LossConfig(), mask=mask) for c in (color, other))
    assert first.value == second.value
    assert not second.d_color[~mask].any()
    assert not second.d_alpha[~mask].any()


def test_huber_is_quadratic_then_linear_and_continuous() -> None:
    r = np.array([-3.0, -0.1, 0.0, 0.05, 0.1, 2.0])
    value, slope = huber(r, 0.1)
    np.testing.assert_allclose(value, [2.95, 0.05, 0.0, 0.0125, 0.05, 1.95], atol=1e-7)
    np.testing.assert_allclose(slope, [-1, -1, 0, 0.5, 1, 1], atol=1e-7)


def test_halve_keeps_means() -> None:
    image = np.arange(5 * 7, dtype=np.float64).reshape(5, 7)
    assert halve(image).shape == (2, 3)
    assert halve(image)[1, 2] == np.mean(image[2:4, 4:6])
