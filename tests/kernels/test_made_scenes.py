"""The compiled kernels keep their bars in scenes that hypothesis makes up; see `agreement` for what a bar is.

Every Gaussian of a scene has one of several shapes, places and opacities; hypothesis looks for the combination that
fails and shrinks it to the fewest Gaussians. The draws are the same in every run.
"""

import hashlib
import itertools

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import Rasterizer, available_isas
from duagc.pipeline.splat.gaussians import DEPTH_KINDS
from tests.kernels.agreement import compare, outputs
from tests.kernels.drawn_scenes import (
    OPACITIES,
    PLACES,
    SHAPES,
    cameras,
    crowded_scene,
    crowded_scenes,
    made_scene,
    mixed_scenes,
)
from tests.kernels.scenes import KINDS, Scene, make_scene


def examples(count: int) -> settings:
    return settings(
        max_examples=count, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
    )


def assert_agreement(scene: Scene, depth: DepthKind = "blended") -> None:
    failed = [
        f"{error.name}: {error.relative:.1e}"
        for error in compare(scene, depth_kind=depth)
        if not error.passes
    ]
    assert not failed, failed


depths = st.sampled_from(DEPTH_KINDS)


@examples(15)
@given(scene=mixed_scenes(), depth=depths)
def test_mixed_scenes(scene, depth):
    assert_agreement(scene, depth)


@examples(4)
@given(scene=crowded_scenes(most=1500), depth=depths)
def test_thousands_on_one_pixel(scene, depth):
    assert_agreement(scene, depth)


@pytest.mark.slow
@examples(3000)
@given(scene=mixed_scenes(), depth=depths)
def test_many_mixed_scenes(scene, depth):
    assert_agreement(scene, depth)


@pytest.mark.slow
@examples(100)
@given(scene=crowded_scenes(most=5000), depth=depths)
def test_many_thousands_on_one_pixel(scene, depth):
    assert_agreement(scene, depth)


@pytest.mark.parametrize("isa", available_isas())
def test_a_closed_pixel_stays_closed_next_to_one_that_is_hardly_covered(isa: str) -> None:
    """Every Gaussian is blended in the pixels in which it is blended when each of them is drawn alone."""
    camera, rasterizer = PinholeCamera(4, 1, 8.0, 8.0, 0.5, 0.5), Rasterizer(isa)
    for seed in range(24):
        scene = crowded_scene(seed, 600, camera)
        view = scene.gaussians, scene.camera, scene.T_camera_map
        rasterizer.forward(*view)
        pixels, alone = rasterizer.contributions()[1].copy(), np.zeros(600, np.int64)
        for mask in np.eye(4, dtype=bool)[:, None]:
            rasterizer.forward(*view, mask=mask)
            alone += rasterizer.contributions()[1]
        np.testing.assert_array_equal(pixels, alone)


def kinds() -> list:
    """All shapes, places, opacities and depths; `make test` takes so many that every two of them meet."""
    every = itertools.product(*map(enumerate, (SHAPES, PLACES, OPACITIES, DEPTH_KINDS)))
    return [
        pytest.param(
            shape,
            place,
            opacity,
            depth,
            marks=()
            if (i + j + k) % len(OPACITIES) == 0 and (i + j + m) % len(DEPTH_KINDS) == 0
            else pytest.mark.slow,
        )
        for (i, shape), (j, place), (k, opacity), (m, depth) in every
    ]


def test_every_two_kinds_meet():
    quick = [param.values for param in kinds() if not param.marks]
    for pair in itertools.combinations(range(4), 2):
        of_all, of_quick = (
            {tuple(values[c] for c in pair) for values in each}
            for each in ([param.values for param in kinds()], quick)
        )
        assert of_quick == of_all


@pytest.mark.parametrize(("shape", "place", "opacity", "depth"), kinds())
def test_every_kind_alone(shape, place, opacity, depth):
    """One Gaussian: nothing else can hide what is wrong with it."""
    seed = DEPTH_KINDS.index(depth)
    intrinsics = np.random.default_rng(5).uniform([20, 20, 0, 0], [60, 60, 30, 22], (len(DEPTH_KINDS), 4))
    camera = PinholeCamera(30, 22, *intrinsics[seed].astype(np.float32).tolist())
    assert_agreement(made_scene(seed, [(shape, place, opacity)], camera), depth)


def fixed() -> list:
    """All fixed scenes with both depths; `make test` takes each scene with one of them, in turn."""
    return [
        pytest.param(kind, depth, marks=() if (k + m) % len(DEPTH_KINDS) == 0 else pytest.mark.slow)
        for k, kind in enumerate(KINDS)
        for m, depth in enumerate(DEPTH_KINDS)
    ]


@pytest.mark.parametrize(("kind", "depth"), fixed())
def test_fixed_scenes(kind, depth):
    assert_agreement(make_scene(kind), depth)


def digest(isa: str, scene: Scene, depth: DepthKind) -> str:
    everywhere = np.ones((scene.camera.height, scene.camera.width), dtype=bool)
    arrays = [array for array, _, _ in outputs(Rasterizer(isa), scene, everywhere, depth).values()]
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


@examples(40)
@given(scene=st.one_of(mixed_scenes(), crowded_scenes(most=400)), depth=depths)
def test_every_build_gives_the_same_bits(scene, depth):
    assert len({digest(isa, scene, depth) for isa in available_isas()}) == 1


@examples(12)
@given(camera=cameras(), n=st.integers(0, 2))
def test_scenes_of_next_to_nothing(camera, n):
    assert_agreement(made_scene(n, [("plain", "plain", "plain")] * n, camera))


def test_a_crowd_is_a_crowd():
    """In the crowded scenes hundreds of Gaussians count in one pixel."""
    scene = crowded_scene(1, 3000, PinholeCamera(5, 5, 20.0, 20.0, 2.0, 2.0))
    rasterizer = Rasterizer()
    rasterizer.forward(scene.gaussians, scene.camera, scene.T_camera_map)
    _, pixels = rasterizer.contributions()
    assert (pixels > 0).sum() > 300
