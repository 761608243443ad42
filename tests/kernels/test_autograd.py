"""The differentiable function gives what the rasterizer gives, to torch."""

import multiprocessing

import numpy as np
import pytest
import torch

from duagc.pipeline.geometry import se3
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.kernels.autograd import rasterize
from tests.kernels.rounding_reference import RoundingReference
from tests.kernels.scenes import make_scene

PARAMETERS = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")
TWIST = np.array([0.03, -0.05, 0.02, 0.04, -0.1, 0.07])


def tensors_of(scene, requires_grad=True):
    return [torch.tensor(getattr(scene.gaussians, name), requires_grad=requires_grad) for name in PARAMETERS]


def draw(scene, parameters, **options):
    view = {"camera": scene.camera, "T_camera_map": scene.T_camera_map, "background": scene.background}
    return rasterize(**dict(zip(PARAMETERS, parameters, strict=True)), **view | options)


def weighted(scene, images):
    """A scalar of all three images, and its cotangents."""
    cotangents = [scene.image(1, 3), scene.image(2), scene.image(3)]
    return sum((torch.from_numpy(c) * i).sum() for c, i in zip(cotangents, images, strict=True)), cotangents


def assert_close(found, wanted, tolerance):
    assert np.linalg.norm(np.asarray(found) - wanted) <= tolerance * np.linalg.norm(wanted)


@pytest.mark.parametrize("kind", ["plain", "opaque", "wide"])
@pytest.mark.parametrize(("xi_type", "depth"), [(torch.float32, "blended"), (torch.float64, "ray_plane")])
def test_gradients_are_those_of_the_reference(kind, xi_type, depth):
    scene = make_scene(kind)
    parameters, xi = tensors_of(scene), torch.tensor(TWIST, dtype=xi_type, requires_grad=True)
    images = draw(scene, parameters, depth_kind=depth, xi=xi)
    value, cotangents = weighted(scene, images)
    value.backward()

    def reference_at(twist):
        reference = RoundingReference()
        pose = se3.exp(-twist) @ scene.T_camera_map
        render = reference.forward(scene.gaussians, scene.camera, pose, scene.background, depth_kind=depth)
        assert reference.gate_margin() > 1e-5  # rounding does not decide what is drawn
        return reference, render

    reference, render = reference_at(TWIST)
    for image, wanted in zip(images, (render.color, render.depth, render.alpha), strict=True):
        assert_close(image.detach(), wanted, 2e-6)
    gradients = reference.backward(*cotangents)
    for name, tensor in zip(PARAMETERS, parameters, strict=True):
        assert_close(tensor.grad, getattr(gradients, name), 1e-5)

    def value_at(twist):
        render = reference_at(twist)[1]
        images = (render.color, render.depth, render.alpha)
        return sum((c * i).sum() for c, i in zip(cotangents, images, strict=True))

    step = 1e-6  # central differences in float64: error about step^2 and 1e-16 / step
    by_twist = [(value_at(TWIST + step * e) - value_at(TWIST - step * e)) / (2 * step) for e in np.eye(6)]
    assert xi.grad.dtype == xi_type
    assert_close(xi.grad, by_twist, 1e-5)


def test_several_views_may_wait_for_their_backward(plain):
    """Forwards 1 2 3, backwards 2 3 1, and one loss of all: the same bits as one after the other."""
    views = [make_scene("plain", seed=seed) for seed in (3, 4, 5)]
    rasterizer = Rasterizer()

    def gradients_of(order):
        parameters = [tensors_of(view) for view in views]
        values = {}
        for i in order["forward"]:
            values[i] = weighted(views[i], draw(views[i], parameters[i], rasterizer=rasterizer))[0]
            if i in order["at once"]:
                values[i].backward()
        for i in order["later"]:
            values[i].backward()
        return [tensor.grad.numpy() for per_view in parameters for tensor in per_view]

    wanted = gradients_of({"forward": (0, 1, 2), "at once": (0, 1, 2), "later": ()})
    found = gradients_of({"forward": (0, 1, 2), "at once": (), "later": (1, 2, 0)})
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(a, b)

    shared = tensors_of(plain)
    first, second = (weighted(plain, draw(plain, shared, rasterizer=rasterizer))[0] for _ in range(2))
    rasterizer.forward(views[1].gaussians, views[1].camera, np.eye(4))  # used directly as well
    (first + second).backward()
    alone = Rasterizer()
    alone.forward(plain.gaussians, plain.camera, plain.T_camera_map, plain.background)
    gradients = alone.backward(plain.image(1, 3), plain.image(2), plain.image(3))
    for name, tensor in zip(PARAMETERS, shared, strict=True):
        np.testing.assert_array_equal(tensor.grad.numpy(), 2 * getattr(gradients, name))


def test_adam_lowers_the_loss(plain):
    with torch.no_grad():
        color, depth, _ = draw(plain, tensors_of(plain, requires_grad=False))
    generator = torch.Generator().manual_seed(0)
    parameters = [
        (t + 0.03 * torch.randn(t.shape, generator=generator)).requires_grad_()
        for t in tensors_of(plain, requires_grad=False)
    ]
    xi = torch.tensor([0.02, 0.0, -0.02, 0.0, 0.01, 0.0], requires_grad=True)
    optimizer = torch.optim.Adam([*parameters, xi], lr=3e-3)
    losses = []
    for _ in range(25):
        optimizer.zero_grad()
        drawn, at, _ = draw(plain, parameters, xi=xi)
        loss = (drawn - color).square().mean() + (at - depth).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.3 * losses[0]


class Watched(Rasterizer):
    """Notes where the Gaussians that it draws lie in memory."""

    def forward(self, gaussians, *arguments, **options):
        self.addresses = [getattr(gaussians, name).ctypes.data for name in PARAMETERS]
        render = super().forward(gaussians, *arguments, **options)
        self.images = [render.color.ctypes.data, render.depth.ctypes.data, render.alpha.ctypes.data]
        return render


def test_nothing_is_copied(plain):
    parameters, rasterizer = tensors_of(plain), Watched()
    images = draw(plain, parameters, rasterizer=rasterizer)
    assert rasterizer.addresses == [tensor.data_ptr() for tensor in parameters]
    assert rasterizer.images == [image.data_ptr() for image in images]


def test_tensors_that_are_not_contiguous(plain):
    straight, turned = tensors_of(plain), tensors_of(plain)
    views = [t.detach().T.contiguous().T.requires_grad_() if t.ndim == 2 else t for t in turned]
    for parameters in (straight, views):
        color, _, _ = draw(plain, parameters)
        color.mean(dim=0).sum().backward()  # an expanded cotangent
    for a, b in zip(straight, views, strict=True):
        np.testing.assert_array_equal(a.grad.numpy(), b.grad.numpy())


def test_only_what_is_asked_for(plain):
    parameters = tensors_of(plain, requires_grad=False)
    assert not draw(plain, parameters)[0].requires_grad
    xi = torch.zeros(6, requires_grad=True)
    draw(plain, parameters, xi=xi)[2].sum().backward()  # alpha alone
    assert xi.grad.abs().max() > 0
    assert all(tensor.grad is None for tensor in parameters)


def test_no_gaussians(plain):
    empty = [torch.zeros(0, *tail) for tail in ((3,), (4,), (3,), (3,), ())]
    color, _, alpha = draw(plain, empty)
    np.testing.assert_array_equal(color.numpy(), np.broadcast_to(np.float32(plain.background), color.shape))
    assert alpha.abs().max() == 0


@pytest.mark.parametrize("position", range(5))
@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda t: t.double(), "float64, expected torch.float32"),
        (lambda t: t.to("meta"), "is on meta"),
        (lambda t: t.numpy(), "is ndarray"),
        (lambda t: t[..., None], "has shape"),
        (lambda t: t.to_sparse(), "sparse"),
    ],
)
def test_wrong_tensors_are_refused_by_name(plain, position, spoil, complaint):
    parameters = tensors_of(plain, requires_grad=False)
    parameters[position] = spoil(parameters[position])
    with pytest.raises(ValueError, match=f"^{PARAMETERS[position]} .*{complaint}"):
        draw(plain, parameters)


def test_wrong_poses_are_refused_by_name(plain):
    parameters = tensors_of(plain)
    for xi, complaint in (
        (torch.zeros(7), r"xi has shape \(7,\)"),
        (torch.zeros(6, dtype=torch.int64), "xi is torch.int64"),
        (torch.full((6,), torch.nan), "xi holds a NaN"),
    ):
        with pytest.raises(ValueError, match=complaint):
            draw(plain, parameters, xi=xi)
    with pytest.raises(ValueError, match="T_camera_map requires a gradient"):
        draw(plain, parameters, T_camera_map=torch.eye(4, requires_grad=True))
    parameters[0].data[2] = torch.nan
    with pytest.raises(ValueError, match=r"means holds a NaN .* row 2"):
        draw(plain, parameters)


def test_second_derivatives_are_refused(plain):
    parameters = tensors_of(plain)
    value = draw(plain, parameters)[0].square().sum()
    (gradient,) = torch.autograd.grad(value, parameters[0], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_a_change_in_place_before_the_backward_is_refused(plain):
    parameters = tensors_of(plain)
    value = draw(plain, parameters)[0].sum()
    with torch.no_grad():
        parameters[0] += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        value.backward()


def gradient_sum():
    scene = make_scene("plain")
    parameters = tensors_of(scene)
    weighted(scene, draw(scene, parameters, rasterizer=Rasterizer(threads=2)))[0].backward()
    return np.concatenate([tensor.grad.numpy().ravel() for tensor in parameters])


def test_a_spawned_process_computes_the_same():
    here = gradient_sum()
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        np.testing.assert_array_equal(pool.apply(gradient_sum), here)
