"""Numbers of Gaussians drawn as an image: means by blending weight, of those that have one."""

import numpy as np

from duagc.pipeline.geometry import se3
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.kernels.blended_values import blended_values
from tests.fixtures.speckled_wall import CAMERA, POSES, wall


def test_a_number_that_all_have_is_its_own_mean() -> None:
    found = blended_values(wall(), np.full(400, 2.5), CAMERA, se3.inverse(POSES[0]), rasterizer=Rasterizer())
    assert (found.weight > 0).any()
    np.testing.assert_allclose(found.mean[found.weight > 0], 2.5, rtol=1e-5)
    np.testing.assert_allclose(found.weight, found.render.alpha, atol=1e-5)
    assert np.isinf(found.mean[found.weight == 0]).all()


def test_who_has_none_is_left_out_of_the_mean_but_hides_others() -> None:
    gaussians, values = wall(), np.full(400, 2.5)
    T_camera_map = se3.inverse(POSES[0])
    values[::2] = np.inf
    some = blended_values(gaussians, values, CAMERA, T_camera_map, rasterizer=Rasterizer())
    covered = some.weight > 0
    np.testing.assert_allclose(some.mean[covered], 2.5, rtol=1e-5)
    assert some.weight.sum() < 0.9 * some.render.alpha.sum()
    alone = gaussians.select(np.arange(1, 400, 2))
    render = Rasterizer().forward(alone, CAMERA, T_camera_map)
    assert some.weight.sum() < render.alpha.sum()
