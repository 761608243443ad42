"""The predicted standard deviation of a rendered depth: of a wall of which everything is known, and at an edge."""

import numpy as np
import pytest

from duagc.pipeline.evaluation.pixel_deviation import LEAST_ACROSS, StatedMap, _along_rays, rendered_depth
from duagc.pipeline.evaluation.pixel_errors import true_depth
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.views import ScoredFrame
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.depth_noise import DepthNoise
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.recording import RgbdFrame
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import sigma_along

CAMERA = PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5)
MIDDLE = (24, 32)


def wall(z_m: float, x_from: float = -3.0, opacity_logit: float = 4.0) -> Gaussians:
    """Discs on a plane in front of the camera, normals along z."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(x_from, 3.0, 0.06), np.arange(-2.5, 2.5, 0.06)))
    n = len(x)
    return Gaussians(
        ids=np.arange(n),
        anchors=np.zeros(n),
        means=np.stack([x, y, np.full(n, z_m)], axis=1),
        quats_wxyz=np.tile([1.0, 0, 0, 0], (n, 1)),
        log_scales=np.log(np.tile([0.05, 0.05, 0.002], (n, 1))),
        colors=np.full((n, 3), 0.5),
        opacity_logits=np.full(n, opacity_logit),
    )


def test_the_deviation_of_a_wall_seen_from_the_front_is_that_of_its_gaussians():
    gaussians = wall(2.0)
    left = gaussians.means[:, 0] < 0
    stated = StatedMap(gaussians, np.where(left, 0.004, 0.02), "ray_plane")
    found = rendered_depth(Rasterizer(), stated, CAMERA, np.eye(4))
    assert found.depth_m == pytest.approx(2.0, abs=1e-3)
    assert found.sigma_m[:, 4:20] == pytest.approx(0.004, rel=1e-3)
    assert found.sigma_m[:, 44:60] == pytest.approx(0.02, rel=1e-3)


def test_seen_from_the_side_it_grows_by_the_slope_of_the_ray():
    """The wall moves along its normal; by how much the depth of a pixel changes is measured by moving it."""
    T = se3.exp(np.array([0.3, 0.0, 0.0, 0.0, 0.7, 0.0]))
    gaussians, step_m = wall(2.0), 0.01
    stated = StatedMap(gaussians, np.full(len(gaussians), step_m), "ray_plane")
    found = rendered_depth(Rasterizer(), stated, CAMERA, T)
    moved = gaussians.replace(means=gaussians.means + np.float32([0.0, 0.0, step_m]))
    there = rendered_depth(Rasterizer(), StatedMap(moved, stated.sigma_m, "ray_plane"), CAMERA, T)
    both = (found.depth_m > 0) & (there.depth_m > 0)
    change_m = (there.depth_m - found.depth_m)[both]
    assert both.mean() > 0.5
    assert change_m.max() > 1.5 * step_m  # steeper than from the front
    assert np.quantile(np.abs(found.sigma_m[both] / change_m - 1), 0.95) < 0.05  # the rest at the wall's end


def test_a_pixel_that_blends_two_surfaces_deviates_by_what_that_shifts_it():
    near, far = wall(1.0, opacity_logit=-1.2), wall(3.0)
    n = len(near) + len(far)
    both = Gaussians.concatenate([near, far]).replace(ids=np.arange(n))
    rasterizer = Rasterizer()
    found = rendered_depth(rasterizer, StatedMap(both, np.full(n, 1e-3), "ray_plane"), CAMERA, np.eye(4))
    layer_m = rasterizer.forward_with_layer(both, CAMERA, np.eye(4), depth_kind="ray_plane")[1]
    shift_m = abs(found.depth_m[MIDDLE] - layer_m[MIDDLE])
    assert shift_m > 0.2
    assert found.sigma_m[MIDDLE] == pytest.approx(shift_m, rel=1e-3)


def test_gaussians_of_which_nothing_is_stated_are_left_out():
    gaussians = wall(2.0)
    sigma_m = np.full(len(gaussians), 0.004)
    sigma_m[::3] = np.inf  # columns in turn: a third of what a pixel blends
    found = rendered_depth(Rasterizer(), StatedMap(gaussians, sigma_m, "ray_plane"), CAMERA, np.eye(4))
    assert found.sigma_m[MIDDLE] == pytest.approx(0.004, rel=1e-3)
    sigma_m[gaussians.means[:, 0] < 0] = np.inf
    found = rendered_depth(Rasterizer(), StatedMap(gaussians, sigma_m, "ray_plane"), CAMERA, np.eye(4))
    assert (found.sigma_m[:, :26] == 0).all()
    assert (found.depth_m > 0).all()


def test_what_is_not_drawn_has_neither_depth_nor_deviation():
    gaussians = wall(2.0, x_from=0.5)
    found = rendered_depth(
        Rasterizer(), StatedMap(gaussians, np.ones(len(gaussians)), "blended"), CAMERA, np.eye(4)
    )
    assert found.depth_m[24, 60] > 0
    assert found.depth_m[24, 10] == found.sigma_m[24, 10] == 0


def test_a_position_without_information_in_a_direction_has_no_deviation():
    information = np.stack([np.diag([1.0, 1.0, 1e4]), np.diag([1.0, 0.0, 1.0])])
    sigma, determined = sigma_along(information, np.tile([0.0, 0.0, 1.0], (2, 1)))
    assert determined.tolist() == [True, False]
    assert sigma.tolist() == [0.01, np.inf]


def test_recorded_depth_brings_its_own_noise_and_exact_depth_none():
    depth_m = np.full((4, 4), 2.0, np.float32)
    color = np.zeros((4, 4, 3), np.uint8)
    none, model = Absent("there is no exact depth"), DepthNoise(0.001, 0.002)
    assert true_depth(ScoredFrame(RgbdFrame(0, 0, color, depth_m), depth_m), model)[1].max() == 0
    by_model = true_depth(ScoredFrame(RgbdFrame(0, 0, color, depth_m), none), model)[1]
    assert by_model == pytest.approx(0.001 + 0.002 * 1.6**2)
    logged = RgbdFrame(0, 0, color, depth_m, depth_sigma=np.full((4, 4), 0.03, np.float32))
    assert true_depth(ScoredFrame(logged, none), model)[1] == pytest.approx(0.03)
    mask = np.zeros((4, 4), bool)
    assert not true_depth(ScoredFrame(RgbdFrame(0, 0, color, depth_m, mask), depth_m), model)[0].any()


def test_a_disc_seen_from_its_side_deviates_by_no_more_than_ten_times_its_own_deviation():
    """Its normal, along z of the map, and the ray to it make 90, 89, 80 and 0 degrees."""
    angles = np.radians([90.0, 89.0, 80.0, 0.0])
    some = wall(2.0).select(slice(0, 4))
    some = some.replace(means=np.stack([np.sin(angles), np.zeros(4), np.cos(angles)], axis=1))
    T_camera_map = se3.inverse(se3.exp(np.array([0, 0, 0, 0, np.pi / 3, 0])))  # all are in front of it
    sigma_m = np.array([0.001, 0.002, 0.003, 0.004])
    found = _along_rays(StatedMap(some, sigma_m, "center"), T_camera_map)
    depth = np.cos(angles - np.pi / 3)
    np.testing.assert_allclose(found, sigma_m / np.maximum(np.cos(angles) / depth, LEAST_ACROSS), rtol=1e-6)
    assert found[0] == pytest.approx(10 * sigma_m[0])
