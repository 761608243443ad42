"""Registration finds known motions, states its uncertainty, and does not call a failure a success."""

import cv2
import numpy as np
import pytest

from duagc.pipeline.frontend.keyframe_graph import overlap
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import (
    Outcome,
    Reference,
    ReferenceLevel,
    Registration,
    RegistrationConfig,
    RgbdPyramid,
    linearize,
    register,
)
from duagc.pipeline.registration.align import reach_factor
from tests.fixtures.room import CAMERA, pose, render

START, END = pose(yaw=0.3), pose(x=0.06, y=-0.03, z=-0.75, yaw=0.34, pitch=-0.02)
T_START_END = se3.inverse(START) @ END
STRIDES = (2, 1, 1)


def pyramid(T_world_camera, **noise) -> RgbdPyramid:
    return RgbdPyramid.build(*render(T_world_camera, **noise), CAMERA)


@pytest.fixture(scope="module")
def start() -> RgbdPyramid:
    return pyramid(START)


@pytest.fixture(scope="module")
def end() -> RgbdPyramid:
    return pyramid(END)


@pytest.fixture(scope="module")
def reference(start) -> Reference:
    return Reference.from_pyramid(start, STRIDES)


def test_inverse_depth_and_normals_are_exact_on_planes_at_every_level():
    # straight at the far wall, 2.5 m away, whose normal is (0, 0, -1); the box begins below the center
    for level in pyramid(pose(z=-0.5)).levels:
        h, w = level.camera.height, level.camera.width
        wall = slice(4, h // 2), slice(w // 3, -w // 3)
        np.testing.assert_allclose(level.inverse_depth[wall], 1 / 2.5, rtol=1e-6)
        np.testing.assert_allclose(level.normals[wall] @ [0, 0, -1], 1, atol=1e-6)


def test_recovers_a_known_motion_from_a_poor_guess(reference, end):
    result = register(reference, end, np.eye(4))  # 8 cm and 2.6 degrees away
    assert result.ok
    moved_m, turned_rad = se3.distance(T_START_END, result.T_reference_target)
    assert moved_m < 3e-4  # measured 1e-4: images interpolated linearly, 1 pixel = 15 mm on the far wall
    assert turned_rad < 2e-4
    assert result.overlap > 0.85
    assert result.conflict < 0.02


def test_forward_and_backward_are_inverse(reference, end, start):
    forward = register(reference, end, np.eye(4)).T_reference_target
    backward = register(Reference.from_pyramid(end, STRIDES), start, np.eye(4)).T_reference_target
    moved_m, turned_rad = se3.distance(forward, se3.inverse(backward))
    assert moved_m < 5e-4
    assert turned_rad < 3e-4


def test_brightness_is_estimated_and_does_not_move_the_pose(reference):
    gray, depth = render(END)
    darker = RgbdPyramid.build(0.7 * gray + 0.05, depth, CAMERA)
    result = register(reference, darker, np.eye(4))
    assert result.ok
    np.testing.assert_allclose(result.exposure, (0.7, 0.05), atol=0.02)
    assert se3.distance(T_START_END, result.T_reference_target)[0] < 1e-3


def test_sparse_reference_works_across_a_wide_baseline(start):
    T = pose(x=0.4, z=-0.6, yaw=-0.1)
    sparse = Reference.sample(start, 1000)
    assert 700 <= len(sparse.levels[0]) <= 1200
    for level in sparse.levels[1:]:
        np.testing.assert_array_equal(level.points, sparse.levels[0].points)
    truth = se3.inverse(START) @ T
    guess = truth @ se3.exp(np.array([0.012, -0.012, 0.01, 0.01, -0.01, 0.01]))  # 2 cm, 1 degree
    result = register(sparse, pyramid(T), guess)
    moved_m, turned_rad = se3.distance(truth, result.T_reference_target)
    assert result.ok
    assert moved_m < 1e-3
    assert turned_rad < 1e-3
    assert 0.3 < result.overlap < 0.75


@pytest.mark.parametrize("sparse", [False, True])
def test_the_other_side_of_a_thin_wall_is_another_surface(sparse):
    """Two cameras 2 m from a wall of 8 cm, one on each side: nearer than the gate, and both images are of a plane."""
    rng = np.random.default_rng(0)
    gray = cv2.GaussianBlur(rng.random((CAMERA.height, CAMERA.width)).astype(np.float32), None, 3)
    wall = RgbdPyramid.build(gray, np.full(gray.shape, 2.0, np.float32), CAMERA)
    mirrored = RgbdPyramid.build(gray[:, ::-1].copy(), np.full(gray.shape, 2.0, np.float32), CAMERA)
    samples = Reference.sample(wall, 1000) if sparse else Reference.from_pyramid(wall, STRIDES)
    T_front_back = np.diag([-1.0, 1.0, -1.0, 1.0])
    T_front_back[2, 3] = 4.08
    across = register(samples, mirrored, T_front_back)
    assert across.view > 0.9  # the samples are in the image, as far away as what it shows
    assert (across.outcome, across.overlap, across.samples) == (Outcome.LOW_OVERLAP, 0.0, 0)
    aside = np.eye(4)
    aside[0, 3] = 0.3
    assert overlap(samples.levels[-1], mirrored.levels[-1], T_front_back) == 0.0
    assert overlap(samples.levels[-1], wall.levels[-1], aside) > 0.8


def test_reference_is_plain_arrays(reference, end):
    rebuilt = Reference(
        tuple(ReferenceLevel(level.points, level.normals, level.intensities) for level in reference.levels)
    )
    np.testing.assert_array_equal(
        register(rebuilt, end, np.eye(4)).T_reference_target,
        register(reference, end, np.eye(4)).T_reference_target,
    )


def test_information_matches_the_scatter_over_noise_draws():
    # the gray floor models calibration errors that this scene does not have
    config = RegistrationConfig(gray_sigma_floor=0.002)
    chi2 = []
    for seed in range(12):
        noise = np.random.default_rng(seed)
        first = Reference.from_pyramid(pyramid(START, noise=noise), STRIDES)
        result = register(first, pyramid(END, noise=noise), T_START_END, config)
        assert result.ok
        error = se3.log(se3.inverse(result.T_reference_target) @ T_START_END)
        chi2.append(error @ result.information @ error)
    # expected 6; the mean of 12 draws has a standard deviation of 1, the model errs by a factor of up to 3
    assert 2 < np.mean(chi2) < 18


def mean_chi2_across_a_wide_baseline(**settings: bool) -> float:
    """Squared errors in the stated covariance, over draws of a noise of depth that shifts samples by a pixel."""
    first, second = pose(x=-0.8, z=-1.2, yaw=0.24), pose(x=0.8, z=-1.2, yaw=-0.24)
    truth, chi2 = se3.inverse(first) @ second, []
    for seed in range(10):
        noise = np.random.default_rng(seed)
        views = []
        for T in (first, second):
            gray, depth = render(T)
            edges = np.clip(0.5 + 6 * (gray - 0.5), 0, 1) + 0.005 * noise.standard_normal(gray.shape)
            depth = depth + 0.01 * (depth / 2) ** 2 * noise.standard_normal(depth.shape)
            views.append(RgbdPyramid.build(edges.astype(np.float32), depth.astype(np.float32), CAMERA))
        result = register(Reference.sample(views[0], 1000), views[1], truth, RegistrationConfig(**settings))
        assert result.ok
        error = se3.log(se3.inverse(result.T_reference_target) @ truth)
        chi2.append(error @ result.information @ error)
    return float(np.mean(chi2))


def test_errors_of_depth_count_as_noise_of_gray_values_across_a_wide_baseline():
    """A sample whose depth is wrong meets another gray value; strong edges say less than their contrast."""
    careful = mean_chi2_across_a_wide_baseline(gray_noise_of_depth=True)
    assert 2 < careful < 8  # 6 degrees of freedom, ten draws
    assert careful < 0.8 * mean_chi2_across_a_wide_baseline()


def test_depth_that_is_wrong_over_whole_patches_counts_less():
    """Depth that is off by as much over a part of the image, and gray values that are not: each as it deserves."""
    errors = {
        weighted: [error_with_patches_of_depth(seed, weights_by_correlation=weighted) for seed in range(8)]
        for weighted in (False, True)
    }
    assert np.median(errors[True]) < 0.4 * np.median(errors[False])


def error_with_patches_of_depth(seed: int, **settings: bool) -> float:
    """Error of a translation, meters, where depth is off by 1 % of it over each of 20 parts of the image."""
    views, noise = [], np.random.default_rng(seed)
    for T in (START, END):
        gray, depth = render(T)
        edges = np.clip(0.5 + 6 * (gray - 0.5), 0, 1) + 0.005 * noise.standard_normal(gray.shape)
        patches = np.kron(noise.standard_normal((4, 5)), np.ones((CAMERA.height // 4, CAMERA.width // 5)))
        depth = depth * (1 + 0.01 * patches + 0.001 * noise.standard_normal(depth.shape))
        views.append(RgbdPyramid.build(edges.astype(np.float32), depth.astype(np.float32), CAMERA))
    result = register(
        Reference.from_pyramid(views[0], STRIDES), views[1], np.eye(4), RegistrationConfig(**settings)
    )
    assert result.ok
    return float(se3.distance(result.T_reference_target, T_START_END)[0])


def test_between_views_from_one_place_depth_adds_no_noise_to_gray_values(reference):
    """The error moves a sample along its ray, which both cameras share."""
    turned = START @ se3.exp(np.array([0, 0, 0, 0.02, -0.03, 0.01]))
    views = [
        register(reference, pyramid(turned), np.eye(4), RegistrationConfig(gray_noise_of_depth=on))
        for on in (False, True)
    ]
    np.testing.assert_allclose(views[1].information, views[0].information, rtol=0.02)


def test_information_is_in_the_right_tangent(reference, end):
    information = register(reference, end, T_START_END).information
    np.testing.assert_allclose(information, information.T)
    values = np.linalg.eigvalsh(information)
    assert values[0] > 0
    # the cost rises by the information: moving along depth (z of the target) is better known than along x, y
    assert information[2, 2] > 0.2 * information[0, 0]


def test_prior_pulls_towards_the_guess(reference, end):
    guess = T_START_END @ se3.exp(np.array([0.01, 0, 0, 0, 0, 0]))
    free = register(reference, end, guess)
    held = register(reference, end, guess, prior_information=1e12 * np.eye(6))
    assert se3.distance(guess, held.T_reference_target)[0] < 1e-4
    assert se3.distance(guess, free.T_reference_target)[0] > 5e-3


def test_untextured_wall_is_ill_conditioned():
    depth = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    gray = np.full_like(depth, 0.5)
    wall = RgbdPyramid.build(gray, depth, CAMERA)
    result = register(Reference.from_pyramid(wall, STRIDES), wall, np.eye(4))
    assert result.outcome is Outcome.ILL_CONDITIONED


def weak_names(result: Registration) -> list[str]:
    """The largest part of every weak direction."""
    names = [f"{kind} {axis}" for kind in ("translation", "rotation") for axis in "xyz"]
    return [names[int(np.argmax(np.abs(direction)))] for direction in result.weak]


def wall(shift_px: float, textured: bool = True) -> RgbdPyramid:
    """A plain wall 2 m away with vertical stripes 20 px wide, seen from `shift_px` further to the right."""
    depth = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    u = np.arange(CAMERA.width) + shift_px
    stripes = 0.5 + (0.3 if textured else 0.0) * np.sin(2 * np.pi * u / 20)
    return RgbdPyramid.build(np.tile(stripes.astype(np.float32), (CAMERA.height, 1)), depth, CAMERA)


def test_weak_directions_stay_at_the_guess_and_carry_no_information():
    """On stripes the height is unknown; everything else is known and found, nothing is made up."""
    moved_m = 2.0 * 2.0 / CAMERA.fx  # 2 px
    guess = se3.exp(np.array([0, 0.05, 0.01, 0, 0, 0]))
    result = register(Reference.from_pyramid(wall(0), STRIDES), wall(2.0), guess)
    assert result.outcome is Outcome.ILL_CONDITIONED
    assert weak_names(result) == ["translation y"]
    assert np.abs(result.information @ result.weak[0]).max() < 1e-6 * np.abs(result.information).max()
    assert np.linalg.matrix_rank(result.information, tol=1.0) == 5
    found = se3.log(result.T_reference_target)
    np.testing.assert_allclose(found, [moved_m, 0.05, 0, 0, 0, 0], atol=2e-3)


def test_a_prior_that_knows_the_weak_directions_makes_a_measurement():
    reference, target = Reference.from_pyramid(wall(0), STRIDES), wall(2.0)
    guess = se3.exp(np.array([0, 0.05, 0.01, 0, 0, 0]))
    prior = np.diag([1.0, 1e4, 1.0, 1.0, 1.0, 1.0])  # the height to 1 cm, the rest to 1 m
    result = register(reference, target, guess, prior_information=prior)
    assert result.ok
    assert weak_names(result) == ["translation y"]
    assert np.abs(result.information @ result.weak[0]).max() < 1e-6 * np.abs(result.information).max()
    assert abs(se3.log(result.T_reference_target)[1] - 0.05) < 1e-3


def test_bare_wall_names_three_weak_directions():
    bare = wall(0, textured=False)
    result = register(Reference.from_pyramid(bare, STRIDES), bare, np.eye(4))
    assert result.outcome is Outcome.ILL_CONDITIONED
    assert set(weak_names(result)) == {"translation x", "translation y", "rotation z"}
    assert np.linalg.matrix_rank(result.information, tol=1e-3 * result.information.max()) == 3


@pytest.mark.parametrize(("residuals", "limit_m"), [("depth", 0.05), ("gray", 3e-3)])
def test_each_kind_of_residual_can_be_used_alone(reference, end, residuals, limit_m):
    config = RegistrationConfig(residuals=residuals, max_sigma_m=1.0)
    result = register(reference, end, np.eye(4), config)
    joint = register(reference, end, np.eye(4))
    error_m = se3.distance(T_START_END, result.T_reference_target)[0]
    assert error_m < limit_m
    unused = {"depth": result.rms_gray, "gray": result.rms_depth_m}[residuals]
    assert unused == 0 < min(joint.rms_gray, joint.rms_depth_m)
    ratio = joint.overconfidence / result.overconfidence
    assert np.trace(result.information) < np.trace(joint.information) * ratio


def test_no_depth_is_low_overlap_and_carries_no_information(reference):
    gray, depth = render(END)
    result = register(reference, RgbdPyramid.build(gray, np.zeros_like(depth), CAMERA), np.eye(4))
    assert result.outcome is Outcome.LOW_OVERLAP
    np.testing.assert_array_equal(result.information, 0)


def test_black_image_over_good_depth_is_a_failure(reference):
    gray, depth = render(END)
    result = register(reference, RgbdPyramid.build(np.zeros_like(gray), depth, CAMERA), np.eye(4))
    assert result.outcome is Outcome.RESIDUAL


def test_a_foreign_view_is_a_failure(reference):
    foreign = RgbdPyramid.build(*render(pose(z=0.5, yaw=np.pi), texture_seed=5), CAMERA)
    assert not register(reference, foreign, np.eye(4)).ok


def test_a_large_correction_is_a_jump(reference, end):
    config = RegistrationConfig(max_translation_m=0.01)
    assert register(reference, end, np.eye(4), config).outcome is Outcome.JUMP


def test_equal_input_gives_equal_bits(start, end):
    a = register(Reference.from_pyramid(start, STRIDES), end, np.eye(4))
    b = register(Reference.from_pyramid(pyramid(START), STRIDES), pyramid(END), np.eye(4))
    np.testing.assert_array_equal(a.T_reference_target, b.T_reference_target)
    np.testing.assert_array_equal(a.information, b.information)


def view_of(T_world_camera, seed: int, with_sigma: bool) -> RgbdPyramid:
    """A view whose left half has depth of 2 mm, the right half of 8 cm, with or without its sigma."""
    gray, depth = render(T_world_camera)
    sigma = np.where(np.arange(CAMERA.width) < CAMERA.width // 2, 0.002, 0.08) * np.ones_like(depth)
    noisy = depth + sigma * np.random.default_rng(seed).standard_normal(depth.shape)
    return RgbdPyramid.build(
        gray, noisy.astype(np.float32), CAMERA, depth_sigma_m=sigma if with_sigma else None
    )


def test_noise_that_is_known_pixel_by_pixel_weights_the_residuals(reference):
    errors = {}
    for with_sigma in (True, False):
        errors[with_sigma] = []
        for seed in range(4):
            target = view_of(END, seed + 10, with_sigma)
            found = register(reference, target, T_START_END).T_reference_target
            errors[with_sigma].append(np.hypot(*se3.distance(T_START_END, found)))
    assert np.mean(errors[True]) < 0.3 * np.mean(errors[False])


def test_known_noise_follows_the_pixels_down_the_pyramid():
    view = view_of(START, 0, True)
    for level in view.levels:
        known = level.inverse_depth > 0
        assert np.array_equal(level.depth_sigma_m > 0, known)
        middle = level.camera.width // 2
        np.testing.assert_allclose(
            level.depth_sigma_m[:, : middle - 1][known[:, : middle - 1]], 0.002, rtol=1e-5
        )
        np.testing.assert_allclose(
            level.depth_sigma_m[:, middle + 1 :][known[:, middle + 1 :]], 0.08, rtol=1e-5
        )
    samples = Reference.from_pyramid(view, STRIDES).levels[0]
    assert set(np.round(samples.depth_sigmas, 4)) <= {np.float32(0.002), np.float32(0.08)}


def test_outdoors_the_limit_of_a_motion_grows_with_the_distance(reference, end):
    """The same view eight times as large: what is 8 cm in a room is 0.6 m there."""
    narrow = RegistrationConfig(max_translation_m=0.05)
    assert register(reference, end, np.eye(4), narrow).outcome is Outcome.JUMP
    factor = 8.0
    far = [RgbdPyramid.build(gray, factor * depth, CAMERA) for gray, depth in (render(START), render(END))]
    result = register(Reference.from_pyramid(far[0], STRIDES), far[1], np.eye(4))
    assert result.ok
    assert np.linalg.norm(result.T_reference_target[:3, 3]) > 0.5
    assert reach_factor(2.0) == reach_factor(6.0) == reach_factor(np.inf) == 1.0
    assert reach_factor(18.0) == 3.0


def test_outdoors_what_is_weak_grows_with_the_distance():
    """As far away as three times 6 m a direction may be known three times as badly."""
    far = [RgbdPyramid.build(gray, 8 * depth, CAMERA) for gray, depth in (render(START), render(END))]
    samples = Reference.from_pyramid(far[0], STRIDES)
    found = register(samples, far[1], np.eye(4))
    depth_m = float(np.median(far[1].levels[0].points[..., 2]))
    lever = np.array([1, 1, 1, *[1 / depth_m] * 3])
    sigma_m = np.linalg.eigvalsh(found.information * np.outer(lever, lever))[0] ** -0.5
    factor = reach_factor(depth_m)
    assert factor > 2
    for limit_m, expected in ((0.8 * sigma_m, Outcome.OK), (0.5 / factor * sigma_m, Outcome.ILL_CONDITIONED)):
        config = RegistrationConfig(max_sigma_m=limit_m)
        assert register(samples, far[1], np.eye(4), config).outcome is expected


def test_what_is_known_of_a_pair_does_not_depend_on_where_it_is_expanded(reference, end):
    """Color and depth may disagree on the pose; how far the pose is from both says nothing of that."""
    for off in (0.0, 0.01, 0.02, 0.04, 0.08):
        found = linearize(reference, end, T_START_END @ se3.exp([off, 0, 0, 0, 0, 0]))
        assert len(found.weak) == 0
        assert found.overconfidence < 1.3  # 33 by the gradients at that place
