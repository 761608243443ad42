"""The compiled passes compute what numpy defines, and the same bits on every instruction set."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.geometry import se3
from duagc.pipeline.kernels import alignment, available_isas
from duagc.pipeline.kernels import pyramid as compiled_pyramid
from duagc.pipeline.registration import (
    Level,
    Reference,
    ReferenceLevel,
    RegistrationConfig,
    RgbdPyramid,
    compiled,
    definition,
    residuals,
    search,
)
from duagc.pipeline.registration.normal_equations import NormalEquations, System
from tests.fixtures.room import CAMERA, pose, render

STRIDES = (2, 1, 1)
START, END = pose(yaw=0.3), pose(x=0.06, y=-0.03, z=-0.75, yaw=0.34, pitch=-0.02)
T_START_END = se3.inverse(START) @ END
OFF = T_START_END @ se3.exp(np.array([0.01, -0.004, 0.006, 0.003, -0.002, 0.004]))
EXPOSURE = np.array([1.05, -0.02])
ISAS = available_isas()


def view(T_world_camera, seed: int, **options) -> RgbdPyramid:
    """A noisy view with holes."""
    rng = np.random.default_rng(seed)
    gray, depth = render(T_world_camera, noise=rng)
    depth[rng.random(depth.shape) < 0.02] = 0
    return RgbdPyramid.build(gray, depth, CAMERA, **options)


def off_by_a_tenth(T_world_camera, seed: int) -> RgbdPyramid:
    """A view whose depth is as wrong as that of what a stereo camera sees far away."""
    gray, depth = render(T_world_camera)
    noise = 0.04 * np.random.default_rng(seed).standard_normal(depth.shape)
    return RgbdPyramid.build(gray, (1 / (1 / depth + noise)).astype(np.float32), CAMERA)


SIGMA = np.random.default_rng(3).uniform(0.002, 0.08, (CAMERA.height, CAMERA.width)).astype(np.float32)
MASK = np.random.default_rng(4).random((CAMERA.height, CAMERA.width)) > 0.01
TARGETS = {
    "plain": view(END, 2),
    "sigma": view(END, 2, depth_sigma_m=SIGMA),
    "masked": view(END, 2, mask=MASK),
    "far": off_by_a_tenth(END, 2),
    "without depth": view(END, 2, mask=MASK).without_depth(),
    "nothing": RgbdPyramid.build(*np.zeros((2, CAMERA.height, CAMERA.width), np.float32), CAMERA),
}
SETTINGS = {
    "usual": RegistrationConfig(),
    "depth": RegistrationConfig(residuals="depth"),
    "gray": RegistrationConfig(residuals="gray", min_gradient=0.02),
    "all gates": RegistrationConfig(normal_gate_rad=0.3, min_gradient=0.01, gray_noise_of_depth=True),
}


@pytest.fixture(scope="module")
def reference() -> Reference:
    return Reference.from_pyramid(view(START, 1, depth_sigma_m=SIGMA), STRIDES)


def assert_same_equations(found: NormalEquations, wanted: NormalEquations) -> None:
    """Scales and the forces of single residuals have the same bits; sums of float over a batch are off by rounding."""
    assert (found.count, found.scale) == (wanted.count, wanted.scale)
    assert found.rms == pytest.approx(wanted.rms, rel=1e-12)
    np.testing.assert_array_equal(found.tile_gradients, wanted.tile_gradients)
    size = np.sqrt(np.diag(wanted.H)) + 1e-30
    np.testing.assert_allclose(found.H / np.outer(size, size), wanted.H / np.outer(size, size), atol=1e-6)
    # of the sum of magnitudes, sqrt(H_kk) times the root of all weighted squares
    largest = size * np.sqrt(wanted.count) * wanted.rms / wanted.scale + 1e-30
    np.testing.assert_allclose(found.gradient / largest, wanted.gradient / largest, atol=1e-6)


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("target", TARGETS)
def test_normal_equations_are_those_of_the_residuals(reference, target, settings):
    pyramid, config = TARGETS[target], SETTINGS[settings]
    for index in (0, 2):
        for samples in (reference, without_sigmas(reference), scattered(reference)):
            at = (samples, pyramid, index, OFF)
            wanted = residuals.linearize_at(*at, exposure=EXPOSURE, config=config).system()
            found = compiled.linearize_at(*at, exposure=EXPOSURE, config=config)
            assert_same_equations(found.depth, wanted.depth)
            assert_same_equations(found.gray, wanted.gray)
            assert found.seen.sigma_mean_m == pytest.approx(wanted.seen.sigma_mean_m, rel=1e-12)
            for name in ("overlap", "view", "conflict", "agreeing", "median_depth_m"):
                assert getattr(found.seen, name) == getattr(wanted.seen, name), name
    no_normals = target == "without depth" and settings == "all gates"
    assert (found.seen.agreeing == 0) == (target == "nothing" or no_normals)


def test_what_noise_may_explain_is_no_conflict(reference):
    at = TARGETS["far"], 0, T_START_END
    for samples in (
        reference,
        replace(reference, inverse_depth_sigma=None),
    ):  # of unknown noise: that of the other view
        seen = compiled.linearize_at(samples, *at, exposure=EXPOSURE, config=RegistrationConfig()).seen
        assert seen.conflict < 0.05
        assert seen.overlap > 0.9 * seen.view
        assert seen.agreeing < 0.8 * seen.view * len(samples.levels[0])  # the others are not judged


def test_images_of_a_few_pixels_show_nothing(reference):
    rng = np.random.default_rng(0)
    for width, height in ((1, 1), (3, 5), (5, 3), (4, 4)):
        camera = replace(CAMERA, width=width, height=height, fx=2.0, fy=2.0, cx=1.5, cy=1.5)
        images = rng.uniform(0.5, 2.5, (2, height, width)).astype(np.float32)
        at = (reference, RgbdPyramid.build(*images, camera, 1), 0, OFF)
        for config in (SETTINGS["usual"], SETTINGS["all gates"]):
            wanted = residuals.linearize_at(*at, exposure=EXPOSURE, config=config).system()
            found = compiled.linearize_at(*at, exposure=EXPOSURE, config=config)
            assert (found.seen.view, found.seen.agreeing) == (wanted.seen.view, wanted.seen.agreeing)
            assert_same_equations(found.gray, wanted.gray)
    nothing = Reference(
        tuple(ReferenceLevel(*np.zeros((2, 0, 3), np.float32), np.zeros(0, np.float32)) for _ in STRIDES)
    )
    empty = compiled.linearize_at(
        nothing, TARGETS["plain"], 0, OFF, exposure=EXPOSURE, config=RegistrationConfig()
    )
    assert (empty.seen.agreeing, empty.seen.view, empty.gray.count) == (0, 0.0, 0)


def scattered(reference: Reference) -> Reference:
    """With normals in all directions: the target sees half of the samples from behind."""
    rng = np.random.default_rng(5)

    def turned(level: ReferenceLevel) -> ReferenceLevel:
        normals = rng.standard_normal((len(level), 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return replace(level, normals=normals.astype(np.float32))

    return Reference(tuple(turned(level) for level in reference.levels))


def without_sigmas(reference: Reference) -> Reference:
    return Reference(tuple(replace(level, depth_sigmas=None) for level in reference.levels))


def flat(system: System) -> np.ndarray:
    parts = [system.depth.H, system.depth.gradient, system.gray.H, system.gray.gradient]
    numbers = [system.depth.scale, system.gray.scale, system.depth.rms, system.gray.rms, system.seen.overlap]
    return np.concatenate([*(part.ravel() for part in parts), numbers])


@pytest.mark.parametrize("target", ["plain", "sigma", "masked"])
def test_one_digest_for_instruction_sets(reference, target):
    config = RegistrationConfig(gray_noise_of_depth=True, min_gradient=0.001)
    all_directions = {"prior_information": None, "projection": search.ALL_DIRECTIONS}
    found = set()
    for isa in ISAS:
        T, exposure, system = compiled.minimize(
            reference, TARGETS[target], OFF, config, **all_directions, isa=isa
        )
        at = compiled.linearize_at(
            reference, TARGETS[target], 1, OFF, exposure=EXPOSURE, config=config, isa=isa
        )
        found.add(b"".join(a.tobytes() for a in (T, exposure, flat(system), flat(at))))
    assert len(found) == 1


def test_the_gradient_is_the_derivative_of_the_cost(reference):
    """Of the weighted squares with the weights held: by central differences in all eight parameters."""
    config = RegistrationConfig(huber_sigmas=1e6, gray_sigma_floor=0.5, depth_sigma_floor=50.0)
    smooth = RgbdPyramid.build(*render(END), CAMERA)

    def cost(x: np.ndarray) -> float:
        system = compiled.linearize_at(
            reference, smooth, 0, T_START_END @ se3.exp(x[:6]), exposure=EXPOSURE + x[6:], config=config
        )
        parts = system.depth, system.gray
        # the number of residuals changes a little with the pose
        return 0.5 * sum(part.rms**2 / part.scale**2 for part in parts)

    at = compiled.linearize_at(reference, smooth, 0, T_START_END, exposure=EXPOSURE, config=config)
    gradient = at.depth.gradient / at.depth.count + at.gray.gradient / at.gray.count
    for k in range(8):
        step = np.zeros(8)
        step[k] = 2e-3
        difference = (cost(step) - cost(-step)) / (2 * step[k])
        curvature = at.depth.H[k, k] / at.depth.count + at.gray.H[k, k] / at.gray.count
        size = np.sqrt(curvature * 2 * cost(np.zeros(8)))
        assert abs(difference - gradient[k]) < 0.08 * size  # of images that are interpolated linearly


@pytest.mark.parametrize("how", ["free", "prior", "projected", "both"])
def test_the_minimum_is_that_of_the_definition(reference, how):
    projection = (
        np.diag([1.0, 1.0, 0.0, 1.0, 1.0, 1.0]) if how in ("projected", "both") else search.ALL_DIRECTIONS
    )
    prior = np.diag([1e6, 1e7, 1e5, 1e6, 1e6, 1e7]) if how in ("prior", "both") else None
    options = {"prior_information": prior, "projection": projection}
    config = RegistrationConfig()
    T, exposure, system = search.minimize(reference, TARGETS["sigma"], OFF, config, **options)
    found, its_exposure, its_system = compiled.minimize(reference, TARGETS["sigma"], OFF, config, **options)
    np.testing.assert_allclose(found, T, atol=1e-7)  # m; steps end at 4e-6
    np.testing.assert_allclose(its_exposure, exposure, atol=1e-6)
    np.testing.assert_allclose(found[:3, :3].T @ found[:3, :3], np.eye(3), atol=1e-15)
    assert abs(its_system.seen.agreeing - system.seen.agreeing) <= 2


def test_without_a_step_the_guess_is_judged(reference):
    config = RegistrationConfig(iterations=())
    options = {"prior_information": None, "projection": search.ALL_DIRECTIONS}
    for minimize in (search.minimize, compiled.minimize):
        T, exposure, system = minimize(reference, TARGETS["sigma"], OFF, config, **options)
        np.testing.assert_array_equal(T, OFF)
        np.testing.assert_array_equal(exposure, [1, 0])
        assert system.seen.agreeing > 1000


def test_a_prior_far_from_the_pose_pulls_as_the_logarithm_says():
    """Nothing is seen; the prior is all there is, and what it does to the first step is known."""
    T = se3.exp(np.array([0.2, -0.1, 0.05, 0.9, -1.2, 0.4]))
    reference = Reference.from_pyramid(view(START, 1), STRIDES)
    config = RegistrationConfig(min_samples=0, iterations=(1, 0, 0))
    options = {"prior_information": 1e3 * np.eye(6), "projection": search.ALL_DIRECTIONS}
    found, _, _ = compiled.minimize(reference, TARGETS["nothing"], T, config, **options)
    np.testing.assert_allclose(found, T, atol=1e-12)


@pytest.mark.parametrize("isa", ISAS)
def test_pyramids_have_the_bits_of_the_definition(isa):
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (61, 83, 3), dtype=np.uint8)
    depth = rng.uniform(0.5, 0.53, (61, 83)).astype(np.float32) * rng.choice(
        [1.0, 1.0, 4.0], (61, 83)
    ).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = rng.choice([0.0, -1.0, np.nan, np.inf])
    depth[:3, :3] = [[0.0, -1.0, np.nan], [np.inf, 1e-39, 1e38], [1.0, 2.0, 3.0]]
    sigma, mask = (0.01 * depth).astype(np.float32), rng.random(depth.shape) > 0.1
    for image in (color, color.astype(np.float32) / 255):
        gray = compiled_pyramid.gray_of_color(image, isa=isa)
        np.testing.assert_array_equal(gray, definition.gray_of_color(image))
    with np.errstate(over="ignore"):
        for options in ((), (mask,), (mask, sigma)):
            for found, wanted in zip(
                compiled_pyramid.inverse_depth_of(depth, *options, isa=isa),
                definition.inverse_depth_of(depth, *options),
                strict=True,
            ):
                np.testing.assert_array_equal(found, wanted)
    inverse, known_sigma = compiled_pyramid.inverse_depth_of(np.where(depth > 1e-3, depth, 0), mask, sigma)
    half_mask = rng.random((30, 41)) > 0.1
    for options in ((), (known_sigma,), (known_sigma, half_mask), (None, half_mask)):
        for chance in (0.0, 0.05, 10.0):
            for found, wanted in zip(
                compiled_pyramid.halved(gray, inverse, *options, chance=chance, isa=isa),
                definition.halved(gray, inverse, *options, chance=chance),
                strict=True,
            ):
                np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("isa", ISAS)
def test_normals_are_those_of_the_definition(isa):
    for level in view(START, 1).levels[:2]:
        wanted = definition.surface_normals(level.inverse_depth, level.camera)
        everywhere = np.arange(level.camera.height), np.arange(level.camera.width)
        found = compiled_pyramid.surface_normals(level.inverse_depth, level.camera, *everywhere, isa=isa)
        np.testing.assert_array_equal(found, level.normals)
        np.testing.assert_array_equal(found[..., 2] == 0, wanted[..., 2] == 0)
        np.testing.assert_allclose(found, wanted, atol=2e-4)  # differences of inverse depths of 24 bits
        np.testing.assert_array_equal(
            level.normals_at(everywhere[0][3::4], everywhere[1][2::3]), found[3::4, 2::3]
        )


def test_arrays_of_other_shapes_are_refused():
    level: Level = TARGETS["plain"].levels[0]
    samples = np.zeros((5, 3), np.float32), np.zeros((5, 3), np.float32), np.zeros(5, np.float32), None
    images = {"camera": CAMERA, "gray": level.gray, "inverse_depth": level.inverse_depth, "has_depth": True}
    alignment.level_arrays(*samples, **images)
    with pytest.raises(ValueError, match=r"normals has shape \(4, 3\), expected \(5, 3\)"):
        alignment.level_arrays(samples[0], samples[1][:4], *samples[2:], **images)
    with pytest.raises(ValueError, match=r"gray has shape"):
        alignment.level_arrays(*samples, **images | {"gray": level.gray[:-1]})
    with pytest.raises(ValueError, match="rows are 0 to 120, expected 0 to 119"):
        level.normals_at(np.arange(121), np.arange(4))
    with pytest.raises(ValueError, match="mask is bool"):
        compiled_pyramid.inverse_depth_of(level.gray, np.ones((3, 3), dtype=bool))
