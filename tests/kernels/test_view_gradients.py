"""The loss of a view with its gradients: forward, loss and backward in one."""

import dataclasses

import numpy as np
import pytest

from duagc.pipeline.kernels import Rasterizer, available_isas
from duagc.pipeline.kernels.reference import ReferenceRasterizer
from duagc.pipeline.kernels.types import Gradients
from duagc.pipeline.splat.gaussians import DEPTH_KINDS
from duagc.pipeline.splat.losses import rgbd_loss
from tests.kernels.agreement import LOSS
from tests.kernels.drawing import (
    assert_same_gradients,
    checkerboard,
    draw,
    flat,
    measured_images,
)


def backward_of(rasterizer, loss) -> Gradients:
    """The gradients that the cotangents of a loss give, in the type that the rasterizer takes."""
    cotangents = (loss.d_color, loss.d_depth, loss.d_alpha)
    if isinstance(rasterizer, Rasterizer):
        cotangents = tuple(d.astype(np.float32) for d in cotangents)
    return rasterizer.backward(*cotangents, pose=True)


@pytest.mark.parametrize("exposure", [(0.0, 0.0), (0.2, -0.05)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_view_gradients_are_forward_loss_and_backward(rasterizer, scene, exposure, masked, depth):
    color, depth_m = measured_images(scene)
    mask = checkerboard(scene) if masked else None
    loss, gradients = rasterizer.view_gradients(
        scene.gaussians,
        scene.camera,
        scene.T_camera_map,
        color=color,
        depth_m=depth_m,
        loss=LOSS,
        exposure=exposure,
        background=scene.background,
        mask=mask,
        depth_kind=depth,
        pose=True,
    )
    render = draw(rasterizer, scene, depth_kind=depth, mask=mask)
    wanted = rgbd_loss(render, color, depth_m, LOSS, exposure=exposure, mask=mask)
    rtol = 1e-12 if isinstance(rasterizer, ReferenceRasterizer) else 2e-6
    np.testing.assert_allclose(
        [loss.value, loss.color, loss.depth], [wanted.value, wanted.color, wanted.depth], rtol=rtol
    )
    np.testing.assert_allclose(loss.d_exposure, wanted.d_exposure, rtol=10 * rtol, atol=rtol)
    separate = backward_of(rasterizer, wanted)
    if isinstance(rasterizer, ReferenceRasterizer):
        assert_same_gradients(gradients, separate, 1e-6)
        return
    # Half a unit in the last place of a depth of 3 m is 1e-5 of the Huber width: what that changes counts twice,
    # once for each way of computing the same residual.
    rng, drift = np.random.default_rng(0), dict.fromkeys(vars(separate), 0.0)
    for _ in range(5):
        half_ulp = 2.0**-24 * rng.choice([-1.0, 1.0], render.depth.shape)
        moved = dataclasses.replace(render, depth=render.depth * (1 + half_ulp))
        other = backward_of(rasterizer, rgbd_loss(moved, color, depth_m, LOSS, exposure=exposure, mask=mask))
        for name in drift:
            if getattr(separate, name) is not None:
                change = np.linalg.norm(getattr(other, name) - getattr(separate, name))
                drift[name] = max(drift[name], 2 * change)
    assert_same_gradients(gradients, separate, 1e-5, drift)


@pytest.mark.parametrize("isa", available_isas())
@pytest.mark.parametrize("masked", [False, True])
def test_an_image_of_bytes_is_that_which_its_table_makes_of_it(plain, isa, masked):
    random = np.random.default_rng(3)
    _, depth_m = measured_images(plain)
    table = random.uniform(-0.1, 1.4, (256, 3)).astype(np.float32)
    seen = random.integers(0, 256, (*depth_m.shape, 3), np.uint8)
    view = plain.gaussians, plain.camera, plain.T_camera_map
    options = {
        "depth_m": depth_m,
        "loss": LOSS,
        "mask": checkerboard(plain) if masked else None,
        "pose": True,
    }
    for rasterizer in (Rasterizer(isa, 2), ReferenceRasterizer()):
        loss, gradients = rasterizer.view_gradients(*view, color=seen, color_table=table, **options)
        color = table[seen, np.arange(3)]
        wanted, of_color = rasterizer.view_gradients(*view, color=color, **options)
        assert loss == wanted
        assert all(
            np.array_equal(a, b)
            for a, b in zip(vars(gradients).values(), vars(of_color).values(), strict=True)
        )


def test_view_gradients_with_certain_depth_are_those_without(plain):
    color, depth_m = measured_images(plain)
    view = plain.gaussians, plain.camera, plain.T_camera_map
    measured = {"color": color, "depth_m": depth_m, "loss": LOSS}
    rasterizer, sure = Rasterizer(), np.ones_like(depth_m)
    loss, gradients = rasterizer.view_gradients(*view, **measured, exposure=(0.1, 0.02))
    same, of_same = rasterizer.view_gradients(*view, **measured, exposure=(0.1, 0.02), depth_certainty=sure)
    np.testing.assert_allclose([same.value, same.depth], [loss.value, loss.depth], rtol=1e-5)
    np.testing.assert_allclose(same.d_exposure, loss.d_exposure, rtol=1e-4)
    np.testing.assert_allclose(of_same.means, gradients.means, atol=1e-4 * np.abs(gradients.means).max())
    less, of_less = rasterizer.view_gradients(*view, **measured, depth_certainty=0.0 * sure)
    assert less.depth == 0
    without, of_color = rasterizer.view_gradients(
        *view, **measured | {"loss": dataclasses.replace(LOSS, depth_weight=0.0)}
    )
    assert less.value == pytest.approx(without.value, rel=1e-5)
    np.testing.assert_allclose(of_less.means, of_color.means, atol=1e-4 * np.abs(of_color.means).max())


@pytest.mark.parametrize("pose_only", [False, True])
@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_view_gradients_of_the_depth_of_single_gaussians_are_those_of_the_reference(plain, depth, pose_only):
    color, depth_m = measured_images(plain)
    certainty = np.random.default_rng(5).uniform(0, 1, depth_m.shape).astype(np.float32)
    view = plain.gaussians, plain.camera, plain.T_camera_map
    options = {"depth_kind": depth, "pose": True, "depth_certainty": certainty, "mask": checkerboard(plain)}
    options |= {"parameters": not pose_only, "color": color, "depth_m": depth_m}
    both = dataclasses.replace(LOSS, surface_weight=0.8)
    loss, gradients = Rasterizer().view_gradients(*view, loss=both, **options)
    wanted, of_reference = ReferenceRasterizer().view_gradients(*view, loss=both, **options)
    assert loss.surface == pytest.approx(wanted.surface, rel=1e-5)
    assert loss.value == pytest.approx(wanted.value, rel=1e-5)
    if pose_only:
        assert gradients.means is None
        np.testing.assert_allclose(gradients.pose, of_reference.pose, rtol=1e-4, atol=1e-6)
    else:
        assert_same_gradients(gradients, of_reference, 1e-4)
    without, of_less = Rasterizer().view_gradients(*view, loss=LOSS, **options)
    assert without.surface == 0
    assert loss.value == pytest.approx(without.value + 0.8 * loss.surface, rel=1e-5)
    assert np.abs(gradients.pose - of_less.pose).max() > 0.01 * np.abs(of_less.pose).max()


def test_view_gradients_draw_a_view_that_can_be_asked_further(rasterizer, plain):
    color, depth_m = measured_images(plain)
    view = (plain.gaussians, plain.camera, plain.T_camera_map)
    measured = {"color": color, "depth_m": depth_m, "loss": LOSS}
    _, pose_only = rasterizer.view_gradients(*view, **measured, pose=True, parameters=False)
    assert pose_only.means is None
    weights, _ = rasterizer.contributions()
    _, both = rasterizer.view_gradients(*view, **measured, pose=True)
    np.testing.assert_array_equal(pose_only.pose, both.pose)
    rasterizer.forward(*view)
    np.testing.assert_array_equal(weights, rasterizer.contributions()[0])


@pytest.mark.parametrize("depth", DEPTH_KINDS)
@pytest.mark.parametrize("surface_weight", [0.0, 0.8])
def test_the_loss_alone_is_that_with_derivatives(plain, depth, surface_weight):
    color, depth_m = measured_images(plain)
    view = plain.gaussians, plain.camera, plain.T_camera_map
    weights = dataclasses.replace(LOSS, surface_weight=surface_weight)
    options = {"color": color, "depth_m": depth_m, "loss": weights, "mask": checkerboard(plain)}
    wanted, _ = Rasterizer().view_gradients(*view, **options, depth_kind=depth)
    loss, nothing = Rasterizer().view_gradients(*view, **options, depth_kind=depth, parameters=False)
    assert loss == wanted
    assert set(vars(nothing).values()) == {None}


@pytest.mark.parametrize("depth", DEPTH_KINDS)
def test_a_pixel_that_closes_early_is_that_of_the_reference(plain, depth):
    color, depth_m = measured_images(plain)
    view = plain.gaussians, plain.camera, plain.T_camera_map
    options = {"color": color, "depth_m": depth_m, "loss": dataclasses.replace(LOSS, surface_weight=0.8)}
    options |= {"depth_kind": depth, "pose": True, "mask": checkerboard(plain)}
    rasterizer = Rasterizer()
    loss, gradients = rasterizer.view_gradients(*view, **options, closing=0.2)
    wanted, of_reference = ReferenceRasterizer().view_gradients(*view, **options, closing=0.2)
    assert loss.value == pytest.approx(wanted.value, rel=1e-5)
    assert_same_gradients(gradients, of_reference, 1e-4)
    whole, of_whole = rasterizer.view_gradients(*view, **options)
    assert abs(loss.value - whole.value) > 1e-4 * whole.value
    assert np.abs(gradients.means - of_whole.means).max() > 1e-3 * np.abs(of_whole.means).max()
    same, of_same = rasterizer.view_gradients(*view, **options, closing=1e-4)  # where pixels close anyway
    assert same == whole
    np.testing.assert_array_equal(of_same.means, of_whole.means)


def test_a_view_that_was_closed_early_cannot_be_asked_further(plain):
    color, depth_m = measured_images(plain)
    rasterizer = Rasterizer()
    view = plain.gaussians, plain.camera, plain.T_camera_map
    rasterizer.view_gradients(*view, color=color, depth_m=depth_m, loss=LOSS, closing=0.2)
    with pytest.raises(RuntimeError, match="closed early"):
        rasterizer.contributions()
    visible = rasterizer.visible
    rasterizer.forward(*view)
    assert rasterizer.visible == visible > 0
    rasterizer.contributions()


def test_derivatives_by_exposure_are_differences(rasterizer, plain):
    color, depth_m = measured_images(plain)
    step = 1e-3 if not isinstance(rasterizer, ReferenceRasterizer) else 1e-6

    def at(a, b):
        return rasterizer.view_gradients(
            plain.gaussians,
            plain.camera,
            plain.T_camera_map,
            color=color,
            depth_m=depth_m,
            loss=LOSS,
            exposure=(a, b),
        )[0]

    by_a = (at(0.1 + step, 0.02).value - at(0.1 - step, 0.02).value) / (2 * step)
    by_b = (at(0.1, 0.02 + step).value - at(0.1, 0.02 - step).value) / (2 * step)
    np.testing.assert_allclose(at(0.1, 0.02).d_exposure, [by_a, by_b], rtol=1e-2 if step > 1e-5 else 1e-6)


def test_views_without_measurements_have_no_loss(rasterizer, plain):
    nothing = np.zeros((plain.camera.height, plain.camera.width), dtype=bool)
    color, depth_m = measured_images(plain)
    view = (plain.gaussians, plain.camera, plain.T_camera_map)
    loss, gradients = rasterizer.view_gradients(*view, color=color, depth_m=depth_m, loss=LOSS, mask=nothing)
    assert loss.value == loss.color == loss.depth == 0.0
    assert loss.d_exposure == (0.0, 0.0)
    assert not flat(gradients).any()
    loss, _ = rasterizer.view_gradients(*view, color=color, depth_m=np.zeros_like(depth_m), loss=LOSS)
    assert loss.depth == 0.0
    assert loss.value == loss.color > 0
