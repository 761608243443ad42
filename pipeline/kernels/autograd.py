"""The rasterizer as a differentiable function of torch tensors on the CPU. The only module here that needs torch."""

from __future__ import annotations

import threading
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch.autograd.function import once_differentiable

from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels.rasterizer import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians

_TAILS = {"means": (3,), "quats_wxyz": (4,), "log_scales": (3,), "colors": (3,), "opacity_logits": ()}

_of_thread = threading.local()  # a Rasterizer serves one thread at a time


def rasterize(
    *,
    means: torch.Tensor,
    quats_wxyz: torch.Tensor,
    log_scales: torch.Tensor,
    colors: torch.Tensor,
    opacity_logits: torch.Tensor,
    camera: PinholeCamera,
    T_camera_map: ArrayLike,
    background: ArrayLike = (0.0, 0.0, 0.0),
    depth_kind: DepthKind = "blended",
    xi: torch.Tensor | None = None,
    rasterizer: Rasterizer | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Color [H, W, 3], depth [H, W] and alpha [H, W] of n Gaussians, as `Rasterizer.forward` draws them.

    Contiguous tensors are read where they are; the images are not copied either. Several forwards may come before
    their backwards: one that is no longer the rasterizer's last is drawn once more in its backward, at the cost of
    a forward. The derivative of the derivative is refused.

    Args:
        means: float32 CPU tensor [n, 3], meters, in the frame `map`.
        quats_wxyz: float32 CPU tensor [n, 4], any non-zero length.
        log_scales: float32 CPU tensor [n, 3], log of meters.
        colors: float32 CPU tensor [n, 3], RGB 0..1.
        opacity_logits: float32 CPU tensor [n].
        camera: as in `Rasterizer.forward`.
        T_camera_map: as in `Rasterizer.forward`.
        background: as in `Rasterizer.forward`.
        depth_kind: as in `Rasterizer.forward`.
        xi: float32 or float64 [6], moves the camera to T_map_camera exp(xi) (translation m, rotation rad).
        rasterizer: what draws; by default one of one thread, kept for each thread that calls.
    Returns:
        Color [H, W, 3], depth [H, W] (m, not divided by alpha), alpha [H, W].
    Raises:
        ValueError: names the argument that has the wrong device, type, shape or values.
    """
    parameters = dict(zip(_TAILS, (means, quats_wxyz, log_scales, colors, opacity_logits), strict=True))
    n = len(means) if isinstance(means, torch.Tensor) and means.ndim else 0
    for name, tensor in parameters.items():
        _check(name, tensor, (n, *_TAILS[name]), (torch.float32,))
    if xi is not None:
        _check("xi", xi, (6,), (torch.float32, torch.float64))
        if not torch.isfinite(xi).all():
            raise ValueError("xi holds a NaN or an infinity")
    if isinstance(T_camera_map, torch.Tensor) and T_camera_map.requires_grad:
        raise ValueError("T_camera_map requires a gradient; that of the pose is taken by xi")
    if rasterizer is None:
        if not hasattr(_of_thread, "rasterizer"):
            _of_thread.rasterizer = Rasterizer()
        rasterizer = _of_thread.rasterizer
    contiguous = [tensor.contiguous() for tensor in parameters.values()]
    seen = _Seen(rasterizer, camera, T_camera_map, background, depth_kind)
    color, depth, alpha = _Rasterize.apply(seen, xi, *contiguous)
    return color, depth, alpha


class _Seen(NamedTuple):
    """What a view is drawn with, but for what can be differentiated."""

    rasterizer: Rasterizer
    camera: PinholeCamera
    T_camera_map: ArrayLike
    background: ArrayLike
    depth_kind: DepthKind


class _Rasterize(torch.autograd.Function):
    """One view; remembers how to draw it again."""

    @staticmethod
    def forward(
        ctx: Any,
        seen: _Seen,
        xi: torch.Tensor | None,
        *parameters: torch.Tensor,
    ) -> tuple[torch.Tensor, ...]:
        pose = np.asarray(seen.T_camera_map, dtype=np.float64)
        if xi is not None:
            pose = se3.exp(-_array(xi).astype(np.float64)) @ pose  # of T_map_camera exp(xi)
        arrays = dict(zip(_TAILS, map(_array, parameters), strict=True))
        n = len(parameters[0])
        ctx.gaussians = Gaussians(ids=np.arange(n), anchors=np.zeros(n, dtype=np.int32), **arrays)
        ctx.rasterizer = seen.rasterizer
        ctx.draw = partial(
            seen.rasterizer.forward,
            ctx.gaussians,
            seen.camera,
            pose,
            seen.background,
            depth_kind=seen.depth_kind,
        )
        ctx.save_for_backward(xi, *parameters)  # torch then refuses a backward after a change in place
        ctx.set_materialize_grads(False)
        render = ctx.draw()
        ctx.color_shape = render.color.shape
        return tuple(torch.from_numpy(image) for image in (render.color, render.depth, render.alpha))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        xi, *_ = ctx.saved_tensors
        d_color, d_depth, d_alpha = (None if c is None else _array(c.contiguous()) for c in cotangents)
        if d_color is None:
            d_color = np.zeros(ctx.color_shape, dtype=np.float32)
        by_pose, parameters = ctx.needs_input_grad[1], any(ctx.needs_input_grad[2:])
        if ctx.rasterizer._gaussians is not ctx.gaussians:  # every context has its own
            ctx.draw()
        gradients = ctx.rasterizer.backward(d_color, d_depth, d_alpha, pose=by_pose, parameters=parameters)
        by_xi = None
        if by_pose:
            by_xi = torch.from_numpy(_right_jacobian(_array(xi)).T @ gradients.pose).to(xi.dtype)
        of_parameters = [
            torch.from_numpy(getattr(gradients, name)) if parameters else None for name in _TAILS
        ]
        return None, by_xi, *of_parameters


def _array(tensor: torch.Tensor) -> NDArray[Any]:
    """The tensor's own memory."""
    return tensor.detach().numpy()


def _check(name: str, tensor: object, shape: tuple[int, ...], dtypes: tuple[torch.dtype, ...]) -> None:
    if not isinstance(tensor, torch.Tensor):
        raise ValueError(f"{name} is {type(tensor).__name__}, expected a torch.Tensor")
    if tensor.device.type != "cpu" or tensor.layout != torch.strided:
        raise ValueError(
            f"{name} is on {tensor.device} ({tensor.layout}), expected a dense tensor on the cpu"
        )
    if tensor.dtype not in dtypes:
        raise ValueError(f"{name} is {tensor.dtype}, expected {' or '.join(map(str, dtypes))}")
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {shape}")


def _right_jacobian(xi: NDArray[Any]) -> NDArray[np.float64]:
    """J [6, 6] with exp(xi + d) = exp(xi) exp(J d) to first order: the integral of exp(-s ad(xi)) over s in 0..1.

    It is a block of the exponential of [[-ad(xi), I], [0, 0]].
    """
    v, w = so3.hat(xi[:3].astype(np.float64)), so3.hat(xi[3:].astype(np.float64))
    block = np.zeros((12, 12))
    block[:3, :3] = block[3:6, 3:6] = -w
    block[:3, 3:6] = -v
    block[:6, 6:] = np.eye(6)
    J: NDArray[np.float64] = torch.linalg.matrix_exp(torch.from_numpy(block)).numpy()[:6, 6:]
    return J
