"""The depth-noise model: its values, and the precision it keeps."""

import numpy as np

from duagc.pipeline.geometry.depth_noise import NEAREST_M, DepthNoise

NOISE = DepthNoise(base_m=0.0012, quadratic_per_m=0.0019)


def test_noise_is_least_at_the_nearest_depth_and_grows_with_the_squared_distance() -> None:
    z = np.array([NEAREST_M, NEAREST_M + 1.0, NEAREST_M + 2.0, NEAREST_M - 0.2])
    expected = 0.0012 + 0.0019 * np.array([0.0, 1.0, 4.0, 0.04])
    np.testing.assert_allclose(NOISE.sigma_m(z), expected, rtol=1e-12)


def test_the_factor_scales_all_of_it() -> None:
    z = np.linspace(0.3, 8.0, 50)
    twice = DepthNoise(NOISE.base_m, NOISE.quadratic_per_m, factor=2.0)
    np.testing.assert_array_equal(twice.sigma_m(z), 2.0 * NOISE.sigma_m(z))


def test_the_result_has_the_precision_of_the_depth() -> None:
    for dtype in (np.float32, np.float64):
        assert NOISE.sigma_m(np.ones(3, dtype)).dtype == dtype
