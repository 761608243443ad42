"""Inverse depth keeps what is known, and what is not."""

import numpy as np
import pytest

from duagc.pipeline.geometry.inverse_depth import chance_difference, inverse_depth_sigma, inverse_or_zero


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_unknown_depth_has_no_inverse(kind: type[np.floating]) -> None:
    depth_m = np.array([[0.0, 0.5], [-1.0, 4.0]], kind)
    with np.errstate(all="raise"):
        inverse = inverse_or_zero(depth_m)
    assert inverse.dtype == kind
    np.testing.assert_array_equal(inverse, [[0.0, 2.0], [0.0, 0.25]])
    np.testing.assert_array_equal(inverse_or_zero(inverse), [[0.0, 0.5], [0.0, 4.0]])
    assert inverse_or_zero(np.zeros((0, 3), kind)).shape == (0, 3)


def ground(noise: float) -> np.ndarray:
    """Inverse depth of a ground from 4 to 30 m with a box on it, 1/m."""
    image = np.repeat(np.linspace(1 / 30, 1 / 4, 60)[:, None], 80, axis=1)
    image[20:45, 30:40] = 1 / 5
    return (image + noise * np.random.default_rng(5).standard_normal(image.shape)).astype(np.float32)


def test_noise_is_that_of_surfaces_whatever_stands_on_them() -> None:
    assert inverse_depth_sigma(ground(0.0)) < 1e-6
    for noise in (1e-3, 5e-3):
        found = ground(noise)
        found[::7, ::3] = 0
        assert inverse_depth_sigma(found) == pytest.approx(noise, rel=0.1)


def test_some_rows_and_columns_show_the_noise_from_pixel_to_pixel() -> None:
    for noise in (1e-3, 5e-3):
        assert inverse_depth_sigma(ground(noise), stride=4) == pytest.approx(noise, rel=0.1)
    smooth = np.repeat(np.repeat(ground(5e-3)[::4, ::4], 4, axis=0), 4, axis=1)
    assert inverse_depth_sigma(smooth, stride=4) < 1e-6


def test_noise_is_that_of_what_is_far() -> None:
    near, far = ground(0.02), ground(1e-3)
    whole = np.where(np.arange(60)[:, None] < 32, far, near)
    assert inverse_depth_sigma(whole) == pytest.approx(1e-3, rel=0.2)


def test_noise_is_no_less_than_stated() -> None:
    image = ground(1e-3)
    sigma_m = 0.01 / np.square(image)
    assert inverse_depth_sigma(image, sigma_m) == pytest.approx(0.01, rel=1e-4)
    assert inverse_depth_sigma(image, 1e-3 * sigma_m) == inverse_depth_sigma(image)


def test_without_depth_no_noise_is_known() -> None:
    assert inverse_depth_sigma(np.zeros((6, 8), np.float32)) == 0.0
    alone = np.zeros((6, 8), np.float32)
    alone[3, 4] = 0.5
    assert inverse_depth_sigma(alone) == 0.0


def test_depths_that_differ_by_chance_differ_by_their_noise() -> None:
    assert chance_difference(3e-3, 4e-3) == pytest.approx(4 * 5e-3)
