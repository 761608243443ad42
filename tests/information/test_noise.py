"""The noise of images and the deviation of a map from the measured surface."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from duagc.pipeline.base import row_blocks
from duagc.pipeline.config.information import InformationConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.geometry.surface_distance import DepthView
from duagc.pipeline.information.deviation import surface_deviation
from duagc.pipeline.information.noise import ImageNoise, estimate_noise, with_correlation
from duagc.pipeline.information.sums import sum_information
from duagc.pipeline.information.views import MapViews
from duagc.pipeline.splat.gaussians import Gaussians
from tests.fixtures.noisy_wall import CAMERA, NOISE, SENSOR, views_of, wall


def test_noise_of_the_log_replaces_the_model() -> None:
    """Twice the sigma, a quarter of the information of depth; times the factor of the residuals; color as before."""
    gaussians, config = wall(), InformationConfig()
    plain = views_of(gaussians)
    tight, loose = (
        [replace(v, depth_sigma_m=np.full(v.depth_m.shape, sigma, np.float32)) for v in plain]
        for sigma in (0.01, 0.02)
    )
    logged = ImageNoise(1e6, SENSOR, from_log=True)  # no information in the color
    sums = [sum_information(MapViews(gaussians, CAMERA, views), logged, config) for views in (tight, loose)]
    assert sums[0].geometry.any()
    np.testing.assert_allclose(sums[0].geometry, 4 * sums[1].geometry, rtol=1e-4, atol=1e-3)
    r = np.random.default_rng(2)
    noisy = [
        replace(
            v, depth_m=np.where(v.depth_m > 0, v.depth_m + r.normal(0, 0.03, v.depth_m.shape), 0).astype("f4")
        )
        for v in tight
    ]
    found = estimate_noise(MapViews(gaussians, CAMERA, noisy), config, every=1)
    assert found.depth.factor == pytest.approx(3.0, rel=0.05)
    assert found.depth_formula() == f"{found.depth.factor:.6g} * sigma of the log"


def test_noise_is_found_in_the_residuals() -> None:
    gaussians = wall()
    views = views_of(gaussians, 0.05, 2.0)
    noisy = estimate_noise(MapViews(gaussians, CAMERA, views), InformationConfig(), every=1)
    assert noisy.color_sigma == pytest.approx(0.05, rel=0.05)
    assert noisy.depth.factor == pytest.approx(2.0, rel=0.05)
    assert noisy.depth_formula() == f"{noisy.depth.factor:.6g} * (0.0012 + 0.0019 * (z - 0.4)^2)"
    sampled = estimate_noise(MapViews(gaussians, CAMERA, views), InformationConfig())
    assert sampled.color_sigma == pytest.approx(noisy.color_sigma, rel=0.15)  # 384 pixels
    assert sampled.depth.factor == pytest.approx(noisy.depth.factor, rel=0.15)
    clean = estimate_noise(MapViews(gaussians, CAMERA, views_of(gaussians)), InformationConfig())
    assert clean.color_sigma == InformationConfig().color_sigma_floor
    assert clean.depth.factor == InformationConfig().depth_factor_min
    fixed = InformationConfig(depth_factor_from_residuals=False)
    assert estimate_noise(MapViews(gaussians, CAMERA, views_of(gaussians, 0, 2.0)), fixed).depth.factor == 1.0


def test_a_few_wrong_pixels_do_not_change_the_noise() -> None:
    gaussians = wall()
    views = views_of(gaussians, 0.05, 1.0)
    spoiled = [PosedRgbd(v.color.copy(), v.depth_m.copy(), v.T_world_camera) for v in views]
    for view in spoiled:
        view.color[:6] = 255
        view.depth_m[:6] = 9.0
    config = InformationConfig()
    a, b = (estimate_noise(MapViews(gaussians, CAMERA, v), config, every=1) for v in (views, spoiled))
    assert b.color_sigma == pytest.approx(a.color_sigma, rel=0.35)
    assert b.depth.factor == pytest.approx(a.depth.factor, rel=0.35)


@pytest.mark.parametrize(("width", "pixels"), [(1, 1.0), (3, 9.0), (5, 25.0)])
def test_residuals_that_are_alike_count_once(width: int, pixels: float) -> None:
    """White noise averaged over width x width pixels: the sum of its autocorrelation is width^2."""
    gaussians = wall()
    r = np.random.default_rng(3)
    views = []
    for view in views_of(gaussians):
        noise = cv2.blur(
            r.normal(size=(*view.depth_m.shape, 2)), (width, width), borderType=cv2.BORDER_REFLECT
        )
        color = np.rint(255 * np.clip(view.color / 255.0 + 0.03 * noise[..., :1] * width, 0, 1)).astype(
            np.uint8
        )
        depth = np.where(view.depth_m > 0, view.depth_m + 0.01 * noise[..., 1], 0).astype(np.float32)
        views.append(PosedRgbd(color, depth, view.T_world_camera))
    noise, overlap = with_correlation(NOISE, MapViews(gaussians, CAMERA, views), InformationConfig())
    assert noise.color_pixels == pytest.approx(pixels, rel=0.35, abs=0.5)  # 4 images of 48 x 36 px
    assert noise.depth_pixels == pytest.approx(pixels, rel=0.35, abs=0.5)
    assert 2 < overlap < 100
    once, shared = (
        sum_information(MapViews(gaussians, CAMERA, views), n, InformationConfig())
        for n in (NOISE, replace(NOISE, color_pixels=pixels, depth_pixels=pixels))
    )
    np.testing.assert_allclose(pixels * shared.geometry, once.geometry, rtol=1e-4, atol=1e-3)
    independent = InformationConfig(correlation_px=0)
    assert with_correlation(NOISE, MapViews(gaussians, CAMERA, views), independent)[0].depth_pixels == 1.0


def test_the_deviation_is_the_distance_from_the_measured_surface() -> None:
    """Gaussians before and behind a wall that is seen at a slant; one far behind it, one that no camera sees."""
    tilt = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.6, 0.0]))
    normal, at = tilt[:3, 2], np.array([0.0, 0.0, 2.0])
    rays = CAMERA.rays()
    depth = (normal @ at / (rays @ normal)).astype(np.float32)  # the plane through `at`
    along = np.array([[0.1, 0.2, 0.0], [-0.2, 0.1, 0.0], [0.3, -0.2, 0.0], [0.0, 0.0, 0.0]]) @ tilt[:3, :3].T
    off_m = np.array([0.0, 0.02, -0.05, 0.5])
    means = np.concatenate([at + along + off_m[:, None] * normal, [[0.0, 0.0, -3.0]]])
    n = len(means)
    gaussians = Gaussians(
        np.arange(n), np.zeros(n), means, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), -4.0), np.zeros((n, 3)),
        np.zeros(n),
    )  # fmt: skip
    view = DepthView(depth, np.eye(4))

    def found(*views: DepthView) -> np.ndarray:
        return surface_deviation(gaussians, CAMERA, views, 0.1)

    alone = found(view)
    np.testing.assert_allclose(
        alone[:3], np.hypot(off_m[:3], 0.01), atol=1e-3
    )  # half of what is typical counts too
    np.testing.assert_array_equal(alone[3:], 0.1)  # not measured within the gate
    past = DepthView(depth + np.float32(0.04), np.eye(4))  # two of five look past it
    np.testing.assert_allclose(found(*[view] * 3, *[past] * 2)[:3], alone[:3], atol=1e-3)
    np.testing.assert_array_equal(found(DepthView(np.zeros_like(depth), np.eye(4))), 0.1)
    assert np.array_equal(found(), np.full(n, 0.1))


def test_the_noise_of_views_is_no_deviation() -> None:
    """A map whose Gaussians are 0 to 20 mm before and behind a wall, seen with noise of 60 mm that a view shares."""
    wall_z, off_m = 2.0, np.linspace(-0.02, 0.02, 41)
    x = np.linspace(-0.8, 0.8, 41)
    n = len(x)
    gaussians = Gaussians(
        np.arange(n), np.zeros(n), np.column_stack([x, 0 * x, wall_z + off_m]), np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 3), -4.0), np.zeros((n, 3)), np.zeros(n),
    )  # fmt: skip
    flat = np.full((CAMERA.height, CAMERA.width), wall_z, np.float32)
    noise_m = np.roll(np.linspace(-0.06, 0.06, 41), 10)  # 31 mm too far at first
    views = [DepthView(flat + np.float32(x), np.eye(4)) for x in noise_m]
    right_m = np.hypot(off_m, 0.005)
    errors_m = [
        np.abs(surface_deviation(gaussians, CAMERA, views[:count], 0.2) - right_m).max() for count in (1, 41)
    ]
    assert errors_m[0] > 0.02
    assert errors_m[1] < 0.002


def test_the_deviation_is_found_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    gaussians = wall()
    views = [DepthView(v.depth_m, v.T_world_camera) for v in views_of(gaussians, depth_factor=1.0)]
    whole = surface_deviation(gaussians, CAMERA, views, 0.1)
    assert len(np.unique(whole)) > 200
    monkeypatch.setattr(row_blocks, "ROWS", 100)
    assert np.array_equal(surface_deviation(gaussians, CAMERA, views, 0.1), whole)
