"""The compiled kernels compute what the float64 reference defines, on every instruction set."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from duagc.pipeline.kernels import FisherSums, Rasterizer, available_isas
from duagc.pipeline.splat.gaussians import DEPTH_KINDS
from duagc.pipeline.splat.information import unpack_geometry
from tests.kernels.rounding_reference import RoundingReference
from tests.kernels.scenes import KINDS, make_scene

ISAS = available_isas()
PARAMETERS = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")


def evaluate(rasterizer, kind):
    """Everything a rasterizer can say about one view of one scene."""
    scene = make_scene(kind)
    of_color, of_depth = scene.image(4, low=0.0), scene.image(5, low=0.0)
    of_color[:3], of_depth[2:5] = 0.0, 0.0  # pixels left out: of color, of both, of depth
    sums = FisherSums(len(scene.gaussians))
    render = rasterizer.forward(scene.gaussians, scene.camera, scene.T_camera_map, scene.background)
    gradients = rasterizer.backward(scene.image(1, 3), scene.image(2), scene.image(3), pose=True, fisher=True)
    by_color = rasterizer.backward(scene.image(1, 3), fisher=True)
    rasterizer.fisher(of_color, of_depth, sums)
    return SimpleNamespace(
        render=render,
        gradients=gradients,
        by_color=by_color,
        sums=sums,
        contributions=rasterizer.contributions(),
        layers=[layers_of(rasterizer, scene, depth) for depth in DEPTH_KINDS],
    )


def layers_of(rasterizer, scene, depth):
    view = scene.gaussians, scene.camera, scene.T_camera_map
    return rasterizer.forward_with_layer(*view, depth_kind=depth)[1]


@cache
def expected(kind):
    reference = RoundingReference()
    result = evaluate(reference, kind)
    # rounding must not decide whether a pixel sees a Gaussian; if this fails, take another seed
    assert reference.gate_margin() > 1e-4
    return result


@cache
def computed(kind, isa):
    return evaluate(Rasterizer(isa), kind)


def assert_close(found, wanted, tolerance, floor=0.0):
    """Relative L2; `floor`: what counts as zero, for derivatives that vanish identically."""
    error = np.linalg.norm(np.asarray(found, dtype=np.float64) - wanted)
    assert error <= tolerance * max(np.linalg.norm(wanted), floor)


both = pytest.mark.parametrize(("kind", "isa"), [(kind, isa) for kind in KINDS for isa in ISAS])


@both
def test_images(kind, isa):
    found, wanted = computed(kind, isa).render, expected(kind).render
    for name in ("color", "depth", "alpha"):
        assert_close(getattr(found, name), getattr(wanted, name), 2e-6)  # float32 sums of up to 24 terms


@both
def test_gradients(kind, isa):
    found, wanted = computed(kind, isa).gradients, expected(kind).gradients
    largest = max(np.linalg.norm(getattr(wanted, name)) for name in PARAMETERS)
    for name in PARAMETERS:
        assert_close(getattr(found, name), getattr(wanted, name), 1e-5, floor=1e-6 * largest)
    assert_close(found.pose, wanted.pose, 1e-5)


@both
@pytest.mark.parametrize("cotangents", ["gradients", "by_color"])
def test_empirical_diagonal(kind, isa, cotangents):
    found, wanted = getattr(computed(kind, isa), cotangents), getattr(expected(kind), cotangents)
    largest = np.linalg.norm(wanted.fisher_diagonal, axis=0).max()
    for column in range(14):
        assert_close(
            found.fisher_diagonal[:, column], wanted.fisher_diagonal[:, column], 1e-4, floor=1e-9 * largest
        )


@both
def test_gauss_newton_information(kind, isa):
    found, wanted = computed(kind, isa).sums, expected(kind).sums
    blocks, exact = unpack_geometry(found.geometry), unpack_geometry(wanted.geometry)
    for rows, columns in [(slice(0, 3), slice(0, 3)), (slice(0, 3), slice(3, 9)), (slice(3, 9), slice(3, 9))]:
        assert_close(blocks[:, rows, columns], exact[:, rows, columns], 1e-4)
    # one Gaussian at a time too: a weak one must not hide behind a strong one
    seen = wanted.observations > 0
    error = np.linalg.norm((blocks - exact)[seen], axis=(1, 2)) / np.linalg.norm(exact[seen], axis=(1, 2))
    assert error.max() < 1e-4
    assert_close(found.color, wanted.color, 1e-4)
    assert_close(found.opacity, wanted.opacity, 1e-4)
    np.testing.assert_array_equal(found.observations, wanted.observations)


@both
def test_contributions(kind, isa):
    weights, pixels = computed(kind, isa).contributions
    exact_weights, exact_pixels = expected(kind).contributions
    assert_close(weights, exact_weights, 2e-6)
    np.testing.assert_array_equal(pixels, exact_pixels)


@both
def test_depth_of_one_layer(kind, isa):
    for found, wanted in zip(computed(kind, isa).layers, expected(kind).layers, strict=True):
        solid = expected(kind).render.alpha >= 0.5
        assert np.count_nonzero((wanted > 0) != solid) <= 0.002 * wanted.size
        # where half of the light, or a depth within the tolerance, is a matter of rounding, they may choose differently
        differs = np.abs(found - wanted) > 1e-5 * wanted
        assert np.count_nonzero(differs) <= 0.002 * wanted.size
