"""Information of Gaussians, weights and residuals, as sums over pixels."""

import numpy as np
import pytest

from duagc.pipeline.geometry import spd
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.kernels.reference import ReferenceRasterizer
from duagc.pipeline.kernels.types import FisherSums
from duagc.pipeline.splat.gaussians import DEPTH_KINDS
from duagc.pipeline.splat.information import unpack_geometry
from tests.kernels.drawing import checkerboard, draw, flat, tiny, tolerance
from tests.kernels.scenes import Scene, make_scene


def test_masked_pixels_bring_no_information(rasterizer, plain):
    mask, of_color, of_depth = checkerboard(plain), plain.image(4, low=1.0), plain.image(5, low=1.0)
    residual = plain.image(6, low=0.0)
    silenced, masked = FisherSums(24, diagonal=True), FisherSums(24, diagonal=True)
    draw(rasterizer, plain)
    rasterizer.fisher(of_color * mask, of_depth * mask, silenced, residual=residual)
    draw(rasterizer, plain, mask=mask)
    rasterizer.fisher(of_color, of_depth, masked, residual=residual)
    for name, wanted in silenced.arrays().items():
        np.testing.assert_allclose(
            masked.arrays()[name], wanted, rtol=1e-5, atol=1e-6 * np.abs(wanted).max(), err_msg=name
        )
    weights, pixels = rasterizer.contributions()
    np.testing.assert_allclose(masked.weight, weights, rtol=1e-6)
    assert pixels.max() <= mask.sum()


def rows_of(reference, scene: Scene) -> np.ndarray:
    """Derivatives [4, pixels, n, 14] of red, green, blue and depth, by one `backward` for each number."""
    height, width = scene.camera.height, scene.camera.width
    rows = []
    for channel in range(4):
        for pixel in np.ndindex(height, width):
            d_color, d_depth = np.zeros((height, width, 3)), np.zeros((height, width))
            if channel < 3:
                d_color[(*pixel, channel)] = 1
            else:
                d_depth[pixel] = 1
            rows.append(flat(reference.backward(d_color, d_depth)))
    return np.stack(rows).reshape(4, height * width, *rows[0].shape)


@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_information_is_the_sum_over_pixels_of_squared_derivatives(rasterizer, depth):
    scene, reference = tiny(), ReferenceRasterizer()
    of_color, of_depth = scene.image(4, low=0.0), scene.image(5, low=0.0)
    draw(reference, scene, depth_kind=depth)
    rows = rows_of(reference, scene)
    precision = np.stack([of_color.ravel()] * 3 + [of_depth.ravel()]).astype(np.float64)
    wanted = np.einsum("cp,cpni,cpnj->nij", precision, rows, rows)
    draw(rasterizer, scene, depth_kind=depth)
    found = rasterizer.full_fisher(of_color, of_depth)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, wanted, atol=tolerance(rasterizer) * np.abs(wanted).max())
    sums = FisherSums(len(scene.gaussians), diagonal=True)
    rasterizer.fisher(of_color, of_depth, sums)
    diagonal = np.diagonal(wanted, axis1=1, axis2=2)
    for column in range(14):
        error = np.linalg.norm(sums.diagonal[:, column] - diagonal[:, column])
        assert error <= tolerance(rasterizer) * np.linalg.norm(diagonal[:, column])
    gradients = rasterizer.backward(scene.image(1, 3), scene.image(2), fisher=True)
    d_color, d_depth = scene.image(1, 3).reshape(-1, 3), scene.image(2).ravel()
    per_pixel = np.einsum("pc,cpni->pni", d_color, rows[:3]) + d_depth[:, None, None] * rows[3]
    empirical = (per_pixel**2).sum(axis=0)
    error = np.linalg.norm(gradients.fisher_diagonal - empirical, axis=0)
    assert (error <= tolerance(rasterizer) * np.linalg.norm(empirical, axis=0)).all()


@pytest.mark.parametrize("kind", ["plain", "discs", "needles"])
@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_both_charts_of_the_geometry_say_the_same(rasterizer, kind, depth):
    """F in (mean, quaternion, log-scale) is T^T F T of F in (mean, vec log Sigma), T the derivative of the one by the
    other: by central differences of float64 arrays."""
    scene = make_scene(kind)
    n, step = len(scene.gaussians), 1e-5
    views, sums = (scene.image(4, low=0.0), scene.image(5, low=0.0)), FisherSums(n)
    draw(rasterizer, scene, depth_kind=depth)
    rasterizer.fisher(*views, sums)
    quats, scales = (a.astype(np.float64) for a in (scene.gaussians.quats_wxyz, scene.gaussians.log_scales))
    T = np.zeros((n, 9, 10))
    T[:, :3, :3] = np.eye(3)
    for k in range(7):
        change = np.zeros(7)
        change[k] = step
        ahead = spd.log_covariance(quats + change[:4], scales + change[4:])
        behind = spd.log_covariance(quats - change[:4], scales - change[4:])
        T[:, 3:, 3 + k] = (ahead - behind) / (2 * step)
    wanted = np.swapaxes(T, 1, 2) @ unpack_geometry(sums.geometry) @ T
    found = rasterizer.full_fisher(*views)[:, :10, :10]
    seen = sums.observations > 0
    error = np.linalg.norm((found - wanted)[seen], axis=(1, 2)) / np.linalg.norm(wanted[seen], axis=(1, 2))
    assert error.max() < max(tolerance(rasterizer), 1e-8)  # of the differences


def test_full_information_and_its_parts(rasterizer, scene):
    views, sums = (
        (scene.image(4, low=0.0), scene.image(5, low=0.0)),
        FisherSums(len(scene.gaussians), diagonal=True),
    )
    draw(rasterizer, scene)
    rasterizer.fisher(*views, sums)
    full = rasterizer.full_fisher(*views)
    np.testing.assert_allclose(full, np.swapaxes(full, 1, 2), rtol=1e-6, atol=1e-6 * np.abs(full).max())
    diagonal = np.diagonal(full, axis1=1, axis2=2)
    for column in range(14):
        error = np.linalg.norm(sums.diagonal[:, column] - diagonal[:, column])
        assert error <= tolerance(rasterizer) * max(
            np.linalg.norm(diagonal[:, column]), 1e-9 * np.linalg.norm(diagonal)
        )
    np.testing.assert_allclose(sums.color, diagonal[:, 10:13], rtol=1e-5)
    np.testing.assert_allclose(sums.opacity, diagonal[:, 13], rtol=1e-4, atol=1e-9 * diagonal.max())


@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_information_of_the_opacities_alone_is_that_of_all(scene, depth):
    rasterizer = Rasterizer()
    of_color, of_depth = scene.image(4, low=0.0), scene.image(5, low=0.0)
    of_color[::3], of_depth[::2] = 0.0, 0.0
    sums = FisherSums(len(scene.gaussians))
    information, observations = np.zeros(len(sums)), np.zeros(len(sums), np.uint32)
    for mask in (None, checkerboard(scene)):
        draw(rasterizer, scene, depth_kind=depth, mask=mask)
        rasterizer.fisher(of_color, of_depth, sums)
        rasterizer.opacity_information(of_color, of_depth, information, observations)
    np.testing.assert_array_equal(information, sums.opacity)
    np.testing.assert_array_equal(observations, sums.observations)


def test_weight_and_residual_are_sums_over_the_pixels_that_count(rasterizer, plain):
    """One pixel at a time: `alpha` is the sum of the weights, and a mask of one pixel gives its weights."""
    of_color, of_depth = plain.image(4, low=0.0), plain.image(5, low=0.0)
    of_color[:6], of_depth[3:9] = 0.0, 0.0
    counted = (of_color > 0) | (of_depth > 0)
    residual = plain.image(6, low=0.0)
    weight, by_residual = np.zeros(24), np.zeros(24)
    for pixel in np.argwhere(counted)[::7]:
        mask = np.zeros(counted.shape, dtype=bool)
        mask[tuple(pixel)] = True
        draw(rasterizer, plain, mask=mask)
        weights, _ = rasterizer.contributions()
        weight += weights
        by_residual += weights * residual[tuple(pixel)]
    mask = np.zeros(counted.shape, dtype=bool)
    mask[tuple(np.argwhere(counted)[::7].T)] = True
    sums = FisherSums(24)
    draw(rasterizer, plain)
    rasterizer.fisher(of_color * mask, of_depth * mask, sums, residual=residual)
    np.testing.assert_allclose(sums.weight, weight, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(sums.residual, by_residual, rtol=1e-5, atol=1e-3)
    without = FisherSums(24)
    rasterizer.fisher(of_color * mask, of_depth * mask, without)
    np.testing.assert_array_equal(without.weight, sums.weight)
    assert not without.residual.any()
