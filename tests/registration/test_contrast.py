"""Gray values count for what they determine, whatever contrast a view has."""

import numpy as np
import pytest

from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import (
    Reference,
    RegistrationConfig,
    RgbdPyramid,
    compiled,
    register,
    residuals,
)
from tests.fixtures.room import CAMERA, pose, render

START, END = pose(yaw=0.3), pose(x=0.06, y=-0.03, z=-0.75, yaw=0.34, pitch=-0.02)
T_START_END = se3.inverse(START) @ END
STRIDES = (2, 1, 1)
POOR_M, BEYOND_ITS_GATE_M = 0.015, 0.06
"""Noise of depth: of the second, four standard deviations of a difference are 14 % of the depth."""


def view(
    T_world_camera: np.ndarray, contrast: float, noise: np.random.Generator, depth_sigma_m: float = POOR_M
) -> RgbdPyramid:
    """With depth of poor quality, and gray values that are hardly noisy."""
    gray, depth = render(T_world_camera, noise=noise, depth_sigma_m=depth_sigma_m, gray_sigma=0.0)
    gray = 0.5 + contrast * (gray - 0.5) + 0.001 * noise.standard_normal(gray.shape)
    return RgbdPyramid.build(gray.astype(np.float32), depth, CAMERA)


def mean_error_m(contrast: float, gray_sigma_of_depth: float, depth_sigma_m: float = POOR_M) -> float:
    config, errors = RegistrationConfig(gray_sigma_of_depth=gray_sigma_of_depth), []
    for seed in range(6):
        noise = np.random.default_rng(seed)
        first = Reference.from_pyramid(view(START, contrast, noise, depth_sigma_m), STRIDES)
        result = register(first, view(END, contrast, noise, depth_sigma_m), T_START_END, config)
        errors.append(se3.distance(result.T_reference_target, T_START_END)[0])
    return float(np.mean(errors))


def test_contrast_is_that_of_the_view_up_to_the_usual() -> None:
    found = [
        Reference.from_pyramid(view(START, contrast, np.random.default_rng(1)), STRIDES).contrast
        for contrast in (1.0, 0.1, 0.05)
    ]
    assert found[0] == 1.0
    assert 0 < found[1] < 0.5
    assert found[2] == pytest.approx(0.5 * found[1], rel=0.01)


def test_low_contrast_does_not_leave_the_pose_to_the_depth() -> None:
    usual = RegistrationConfig().gray_sigma_of_depth
    error_m = mean_error_m(1.0, usual)
    assert mean_error_m(0.1, usual) < 1.1 * error_m
    one_floor_for_all = usual / Reference.from_pyramid(view(START, 0.1, np.random.default_rng(1))).contrast
    assert mean_error_m(0.1, one_floor_for_all) > 1.25 * error_m


@pytest.mark.parametrize(("contrast", "error_m"), [(1.0, 0.002), (0.1, 0.008)])
def test_noise_of_single_pixels_does_not_count_as_noise_of_gray_values(
    contrast: float, error_m: float
) -> None:
    """The coarsest image, 16 pixels to one, hardly shows it: by that alone errors were 17 and 18 mm."""
    usual = RegistrationConfig().gray_sigma_of_depth
    assert mean_error_m(contrast, usual, BEYOND_ITS_GATE_M) < error_m


@pytest.mark.parametrize("contrast", [0.1, 1.0])
def test_the_compiled_pass_has_the_same_floor(contrast: float) -> None:
    noise, config = np.random.default_rng(2), RegistrationConfig()
    reference = Reference.from_pyramid(view(START, contrast, noise), STRIDES)
    at = (reference, view(END, contrast, noise), 0, T_START_END)
    found, wanted = (
        module.linearize_at(*at, exposure=np.array([1.0, 0.0]), config=config)
        for module in (compiled, residuals)
    )
    assert wanted.gray.scale > config.gray_sigma_floor
    assert found.gray.scale == wanted.gray.scale
