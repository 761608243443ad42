"""Derivatives of single pixels of a map are those of the reference, of differences, and of the compiled kernels."""

import numpy as np
import pytest

from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.kernels.definition import SCREEN_NUMBERS
from duagc.pipeline.kernels.pixel_jacobians import PixelJacobians
from duagc.pipeline.kernels.reference import ReferenceRasterizer
from duagc.pipeline.kernels.types import FisherSums
from duagc.pipeline.splat.gaussians import DEPTH_KINDS
from duagc.pipeline.splat.information import unpack_geometry
from tests.kernels.drawing import checkerboard
from tests.kernels.scenes import make_scene

ROWS = np.array([3, 0, 17, 8, 21])


def summed(scene, depth, mask, precision):
    """Sums [r, 14, 14] and [r, 13, 13] over the pixels of J^T R^-1 J."""
    full, chart = np.zeros((len(ROWS), 14, 14)), np.zeros((len(ROWS), 13, 13))
    footprints = PixelJacobians(scene.gaussians, ROWS, scene.camera, depth)
    for found in footprints.view(scene.T_camera_map, mask):
        x, y = found.pixels.T
        for sums, by_inputs in ((full, found.by_parameters), (chart, found.by_chart)):
            J = found.by_screen @ by_inputs
            sums[found.row] += np.einsum("cm,cmi,cmj->ij", precision[:, y, x], J, J)
    return full, chart


@pytest.mark.parametrize("kind", ["plain", "discs", "opaque", "behind"])
@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_sums_over_footprints_are_those_of_both_rasterizers(kind, depth):
    scene, mask = make_scene(kind), None
    if kind == "discs":
        mask = checkerboard(scene)
    views = scene.image(4, low=0.0), scene.image(5, low=0.0)
    full, chart = summed(scene, depth, mask, np.stack([views[0]] * 3 + [views[1]]).astype(np.float64))
    reference, kernels = ReferenceRasterizer(), Rasterizer()
    for rasterizer, tolerance in ((reference, 1e-10), (kernels, 2e-3)):
        rasterizer.forward(scene.gaussians, scene.camera, scene.T_camera_map, depth_kind=depth, mask=mask)
        sums = FisherSums(len(scene.gaussians))
        rasterizer.fisher(*views, sums)
        geometry = unpack_geometry(sums.geometry)[ROWS]
        for mine, wanted in (
            (full, rasterizer.full_fisher(*views)[ROWS]),
            (chart[:, :9, :9], geometry),
            (chart[:, range(9, 12), range(9, 12)], sums.color[ROWS]),
            (chart[:, 12, 12], sums.opacity[ROWS]),
        ):
            np.testing.assert_allclose(mine, wanted, atol=tolerance * np.abs(wanted).max())
    assert (full != 0).any(axis=(1, 2)).sum() >= 2


def test_derivatives_are_those_of_differences():
    """Of the drawn images of a pixel by each of the 14 numbers of a Gaussian with others in front and behind."""
    scene, step = make_scene("plain"), 2e-3
    names = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")
    rows = np.array([17])
    (found,) = PixelJacobians(scene.gaussians, rows, scene.camera, "ray_plane").view(scene.T_camera_map)
    J = found.by_screen @ found.by_parameters
    assert found.by_screen.shape[2] == SCREEN_NUMBERS
    x, y = found.pixels.T
    inner = found.weights > 0.02  # nothing at the edge of a threshold
    assert inner.sum() > 5
    column = 0
    for name in names:
        array = getattr(scene.gaussians, name).astype(np.float64).reshape(len(scene.gaussians), -1)
        for k in range(array.shape[1]):
            sides = []
            for sign in (1, -1):
                moved = array.copy()
                moved[17, k] += sign * step
                shape = getattr(scene.gaussians, name).shape
                changed = scene.gaussians.replace(**{name: moved.reshape(shape)})
                render = ReferenceRasterizer().forward(
                    changed, scene.camera, scene.T_camera_map, depth_kind="ray_plane"
                )
                exact = np.float64(getattr(changed, name).reshape(array.shape)[17, k])
                sides.append((exact, np.concatenate([render.color, render.depth[..., None]], axis=2)[y, x]))
            slope = (sides[0][1] - sides[1][1]) / (sides[0][0] - sides[1][0])
            np.testing.assert_allclose(
                J[:, inner, column].T, slope[inner], rtol=2e-3, atol=2e-4, err_msg=name
            )
            column += 1
    assert column == 14
