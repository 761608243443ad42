"""What must hold for any scene, whatever the implementation."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from duagc.pipeline.geometry import se3, spd
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import FisherSums, Rasterizer
from duagc.pipeline.kernels.reference import ReferenceRasterizer
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import unpack_geometry
from tests.kernels.rounding_reference import RoundingReference
from tests.kernels.scenes import BACKGROUND, make_scene, random_gaussians


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 40),
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    spread=st.floats(0.0, 1.5),
)
def test_any_small_scene_matches_the_reference(seed, n, size, spread):
    rng = np.random.default_rng(seed)
    gaussians = random_gaussians(n, seed)
    gaussians = gaussians.replace(log_scales=gaussians.log_scales + spread * rng.normal(size=(n, 3)))
    camera = PinholeCamera(*size, rng.uniform(5, 40), rng.uniform(5, 40), size[0] / 2, size[1] / 2)
    T, background = se3.exp(rng.normal(scale=0.2, size=6)), rng.random(3)
    d_color = rng.normal(size=(size[1], size[0], 3)).astype(np.float32)
    reference, rasterizer = RoundingReference(), Rasterizer()
    wanted = reference.forward(gaussians, camera, T, background)
    assume(reference.gate_margin() > 1e-4)
    found = rasterizer.forward(gaussians, camera, T, background)
    np.testing.assert_allclose(found.color, wanted.color, atol=2e-5)  # float32, sharp edges of thin splats
    np.testing.assert_allclose(found.depth, wanted.depth, atol=8e-5)  # depths up to 4 m
    exact, gradients = reference.backward(d_color, pose=True), rasterizer.backward(d_color, pose=True)
    scale = max(np.linalg.norm(exact.means), 1e-3)
    assert np.linalg.norm(gradients.means - exact.means) < 1e-4 * scale
    assert np.linalg.norm(gradients.pose - exact.pose) < 1e-4 * max(np.linalg.norm(exact.pose), 1e-3)


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("size", [(16, 17), (17, 16), (49, 33), (33, 49), (113, 20), (20, 81)])
def test_the_last_row_and_column_of_an_image_of_any_size(size, threads):
    """A tile that has one row or one column of pixels is drawn as the others."""
    width, height = size
    camera = PinholeCamera(width, height, 60.0, 60.0, width / 2 - 0.5, height / 2 - 0.5)
    gaussians = random_gaussians(60, seed=3)
    gaussians = gaussians.replace(log_scales=gaussians.log_scales + 0.7)
    rasterizer = Rasterizer(threads=threads)
    wanted = ReferenceRasterizer().forward(gaussians, camera, np.eye(4))
    found = rasterizer.forward(gaussians, camera, np.eye(4))
    assert wanted.alpha[-1].min() > 0.05
    assert wanted.alpha[:, -1].min() > 0.05
    np.testing.assert_allclose(found.alpha, wanted.alpha, atol=1e-4)


def test_a_splat_inside_the_image_is_as_wide_wherever_the_principal_point_is():
    """A cut-out of an image, or a rectified one: what lies inside is linearized where it lies."""
    whole = PinholeCamera(600, 60, 160.0, 160.0, 299.5, 29.5)
    x, z, sigma = 5.25, 3.0, 0.06
    rng = np.random.default_rng(0)
    true = whole.project(rng.normal([x, 0, z], sigma, (200_000, 3)))[:, 0].std()
    splat = Gaussians([0], [0], [[x, 0, z]], [[1, 0, 0, 0]], np.log([[sigma] * 3]), [[1, 1, 1]], [-2.0])
    widths = []
    for left in (0, 280):  # columns that are cut off
        camera = PinholeCamera(600 - left, 60, 160.0, 160.0, 299.5 - left, 29.5)
        light = Rasterizer().forward(splat, camera, np.eye(4)).alpha.sum(axis=0).astype(float)
        column = np.arange(len(light))
        mean = (light * column).sum() / light.sum()
        widths.append(np.sqrt((light * (column - mean) ** 2).sum() / light.sum()))
    np.testing.assert_allclose(widths, true, rtol=0.1)
    assert abs(widths[0] - widths[1]) < 0.01


def test_counts_do_not_depend_on_threads():
    camera = PinholeCamera(64, 64, 60.0, 60.0, 31.5, 31.5)
    gaussians = random_gaussians(20_000, seed=0)
    counts = []
    for threads in (1, 2, 3, 4):
        rasterizer = Rasterizer(threads=threads)
        rasterizer.forward(gaussians, camera, np.eye(4))
        counts.append(replace(rasterizer.statistics(), scratch_bytes=0))
    assert len(set(counts)) == 1


def test_pose_gradient_is_by_the_right_tangent_of_the_camera_in_the_map(plain):
    reference = ReferenceRasterizer()
    d_color, d_depth = plain.image(1, 3), plain.image(2)
    T_map_camera = se3.inverse(plain.T_camera_map)

    def loss(xi):
        T = se3.inverse(T_map_camera @ se3.exp(xi))
        render = reference.forward(plain.gaussians, plain.camera, T, BACKGROUND)
        return (d_color * render.color).sum() + (d_depth * render.depth).sum()

    step = 1e-6
    differences = [(loss(step * e) - loss(-step * e)) / (2 * step) for e in np.eye(6)]
    rasterizer = Rasterizer()
    rasterizer.forward(plain.gaussians, plain.camera, plain.T_camera_map, BACKGROUND)
    pose = rasterizer.backward(d_color, d_depth, pose=True).pose
    np.testing.assert_allclose(pose, differences, rtol=1e-4, atol=1e-4 * np.abs(differences).max())


def test_center_of_a_pixel_is_an_integer():
    gaussians = random_gaussians(1, 0).replace(
        means=[[0.0, 0.0, 2.0]], log_scales=[[-5.0] * 3], opacity_logits=[3.0]
    )
    camera = PinholeCamera(9, 7, 10.0, 10.0, 3.0, 2.0)
    alpha = Rasterizer().forward(gaussians, camera, np.eye(4)).alpha
    assert np.unravel_index(alpha.argmax(), alpha.shape) == (2, 3)
    np.testing.assert_allclose(alpha[2, 3], 1 / (1 + np.exp(-3.0)), rtol=1e-6)
    np.testing.assert_array_equal(alpha[2, 2], alpha[2, 4])


def test_background_fills_what_alpha_leaves(scene):
    rasterizer = Rasterizer()
    black = rasterizer.forward(scene.gaussians, scene.camera, scene.T_camera_map)
    render = rasterizer.forward(scene.gaussians, scene.camera, scene.T_camera_map, BACKGROUND)
    filled = black.color + (1 - black.alpha)[..., None] * np.float32(BACKGROUND)
    np.testing.assert_allclose(render.color, filled, atol=1e-6)
    np.testing.assert_array_equal(render.depth, black.depth)
    assert render.alpha.min() >= 0
    assert render.alpha.max() < 1


def sums_of(scene, *views):
    sums, rasterizer = FisherSums(len(scene.gaussians)), Rasterizer()
    for of_color, of_depth in views:
        rasterizer.forward(scene.gaussians, scene.camera, scene.T_camera_map, scene.background)
        rasterizer.fisher(of_color, of_depth, sums)
    return sums


def test_information_adds_over_views_and_scales_with_precision(plain):
    of_color, of_depth = plain.image(1, low=1.0), plain.image(2, low=1.0)
    once, twice = sums_of(plain, (of_color, of_depth)), sums_of(plain, *[(of_color, of_depth)] * 2)
    scaled = sums_of(plain, (4 * of_color, 4 * of_depth))  # by a power of two: exactly
    np.testing.assert_array_equal(twice.geometry, 2 * once.geometry)
    np.testing.assert_array_equal(scaled.geometry, 4 * once.geometry)
    np.testing.assert_array_equal(scaled.color, 4 * once.color)
    np.testing.assert_array_equal(scaled.opacity, 4 * once.opacity)
    np.testing.assert_array_equal(twice.observations, 2 * once.observations)


def test_information_is_positive_semidefinite(scene):
    sums = sums_of(scene, (scene.image(1, low=1.0), scene.image(2, low=1.0)))
    values = np.linalg.eigvalsh(unpack_geometry(sums.geometry))
    assert (values[:, 0] >= -3e-6 * values[:, -1]).all()  # float32 sums of a view
    assert (unpack_geometry(sums.geometry)[sums.observations == 0] == 0).all()


def test_pixels_without_precision_say_nothing(plain):
    nothing = np.zeros((plain.camera.height, plain.camera.width), dtype=np.float32)
    sums = sums_of(plain, (nothing, nothing))
    assert not any(np.any(array) for array in sums.arrays().values())


@pytest.mark.parametrize("kind", ["plain", "discs", "spheres"])
def test_information_turns_with_the_map(kind):
    scene = make_scene(kind)
    T_other_map = se3.exp([0.3, -0.2, 0.5, 0.4, -0.7, 0.9])
    R = T_other_map[:3, :3]
    views = scene.image(1, low=1.0), scene.image(2, low=1.0)
    before = unpack_geometry(sums_of(scene, views).geometry)
    sums, rasterizer = FisherSums(len(scene.gaussians)), Rasterizer()
    rasterizer.forward(
        scene.gaussians.transformed(T_other_map),
        scene.camera,
        scene.T_camera_map @ se3.inverse(T_other_map),
        scene.background,
    )
    rasterizer.fisher(*views, sums)
    turn = np.zeros((9, 9))
    turn[:3, :3], turn[3:, 3:] = R, spd.sym_rotation(R)
    wanted = turn @ before @ turn.T
    error = np.linalg.norm(unpack_geometry(sums.geometry) - wanted) / np.linalg.norm(wanted)
    assert error < 1e-4  # the parameters themselves are rounded to float32 in the other frame
