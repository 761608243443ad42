"""What the compiled rasterizer computes, written down in float64 for small scenes; the tests compare the two.

One Gaussian: Sigma = R(q) diag(exp 2s) R(q)^T (paper eq. (1)), opacity o = sigmoid(logit). In a camera with rotation W
and centre p of the Gaussian in the camera frame, J the derivative of the projection at p:

    screen covariance   C = J W Sigma W^T J^T + BLUR I
    alpha at a pixel    a = min(o exp(-d^T C^-1 d / 2), ALPHA_MAX), d = pixel - centre; nothing if o exp(..) < 1/255
    weight              w_i = a_i prod_{j nearer} (1 - a_j); a Gaussian that would take the product below
                        TRANSMITTANCE_MIN closes the pixel and is not drawn
    colour = sum w c + (1 - sum w) background,  depth = sum w z,  alpha = sum w

Derivatives come from automatic differentiation, information from the Jacobian of every pixel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.geometry import spd
from pipeline.geometry.camera import PinholeCamera
from pipeline.kernels.types import FisherSums, Gradients, Render
from pipeline.splat.gaussians import Gaussians

NEAR_M = 0.01
BLUR_PX2 = 0.3
FIELD_MARGIN = 1.3
ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4
JACOBIAN_ROWS = 16  # pixels differentiated at once

_PARAMETERS = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")


class ReferenceRasterizer:
    """Same calls as `Rasterizer`, float64 results. Time and memory grow as pixels times Gaussians."""

    def forward(
        self,
        gaussians: Gaussians,
        camera: PinholeCamera,
        T_camera_map: ArrayLike,
        background: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Render:
        """Draw the Gaussians (frame map) into the camera at T_camera_map [4, 4]."""
        import torch

        def tensor(array: ArrayLike) -> Any:
            return torch.tensor(np.asarray(array, dtype=np.float64))

        self._camera, self._n = camera, len(gaussians)
        self._T, self._background = tensor(T_camera_map), tensor(background)
        self._parameters = {name: tensor(getattr(gaussians, name)).requires_grad_() for name in _PARAMETERS}
        self._log_covariances = spd.log_covariance(gaussians.quats_wxyz, gaussians.log_scales)
        self._xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        p = self._parameters
        sigma = sigma_of(p["quats_wxyz"], p["log_scales"])
        self._images = self._draw(p["means"], sigma, p["colors"], p["opacity_logits"])
        return Render(*(image.detach().numpy() for image in self._images))

    def backward(
        self,
        d_color: ArrayLike,
        d_depth: ArrayLike | None = None,
        d_alpha: ArrayLike | None = None,
        pose: bool = False,
        fisher: bool = False,
    ) -> Gradients:
        """Derivatives of <d_color, color> + <d_depth, depth> + <d_alpha, alpha>; see `Rasterizer.backward`."""
        import torch

        color, depth, alpha = self._images

        def cotangent(image: ArrayLike | None, like: Any) -> Any:
            return (
                torch.zeros_like(like) if image is None else torch.tensor(np.asarray(image, dtype=np.float64))
            )

        per_pixel = (
            (cotangent(d_color, color) * color).sum(-1)
            + cotangent(d_depth, depth) * depth
            + cotangent(d_alpha, alpha) * alpha
        ).ravel()
        inputs = [*self._parameters.values(), self._xi]
        *gradients, by_pose = torch.autograd.grad(per_pixel.sum(), inputs, retain_graph=True)
        diagonal = None
        if fisher:
            squares = [(J**2).sum(0) for J in _jacobian(per_pixel, inputs[:-1])]
            diagonal = np.concatenate([s[:, None] if s.ndim == 1 else s for s in squares], axis=1)
        means, quats, log_scales, colors, logits = (gradient.numpy() for gradient in gradients)
        return Gradients(
            means, quats, log_scales, colors, logits, by_pose.numpy() if pose else None, diagonal
        )

    def fisher(self, inv_var_color: ArrayLike, inv_var_depth: ArrayLike, sums: FisherSums) -> None:
        """Add sum over pixels of J^T R^-1 J in (mean, vec log Sigma, colour, logit); see `Rasterizer.fisher`."""
        import torch

        p = self._parameters
        log_covariances = torch.tensor(self._log_covariances, requires_grad=True)
        covariances = _matrix_exp(log_covariances)
        sigma = covariances.detach().requires_grad_()
        color, depth, _ = self._draw(p["means"], sigma, p["colors"], p["opacity_logits"])
        measured = torch.cat([color, depth[..., None]], dim=-1).reshape(-1)
        of_color = np.asarray(inv_var_color, dtype=np.float64)[..., None].repeat(3, axis=-1)
        of_depth = np.asarray(inv_var_depth, dtype=np.float64)[..., None]
        weight = np.concatenate([of_color, of_depth], axis=-1).reshape(-1)
        inputs = [p["means"], sigma, p["colors"], p["opacity_logits"]]
        by_mean, by_sigma, by_color, by_logit = _jacobian(measured, inputs)
        (sigma_by_log,) = _jacobian(
            covariances.sum(0).reshape(9), [log_covariances]
        )  # each Sigma has its own log
        by_log = np.einsum("mnij,ijnk->mnk", by_sigma, sigma_by_log.reshape(3, 3, self._n, 6))
        geometry = np.concatenate([by_mean, by_log], axis=-1)
        blocks = np.einsum("m,mni,mnj->nij", weight, geometry, geometry)
        rows, columns = np.triu_indices(9)
        sums.geometry += blocks[:, rows, columns]
        sums.color += np.einsum("m,mni->ni", weight, by_color**2)
        sums.opacity += np.einsum("m,mn->n", weight, by_logit**2)
        used = ((of_color[..., 0] > 0) | (of_depth[..., 0] > 0)).reshape(-1)
        sums.observations += (self._weights[used].detach().numpy() > 0).any(axis=0).astype(np.uint32)

    def contributions(self) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
        """Sum of the blending weights [n] of each Gaussian and number of its pixels [n]."""
        weights = self._weights.detach().numpy()
        return weights.sum(axis=0), (weights > 0).sum(axis=0).astype(np.uint32)

    def gate_margin(self) -> float:
        """Smallest relative distance of any pair of pixel and Gaussian from the thresholds of the definition.

        Near zero, rounding decides whether the pair is drawn, and another precision may differ visibly.
        """
        return self._margin

    def _draw(self, means: Any, covariances: Any, colors: Any, opacity_logits: Any) -> tuple[Any, Any, Any]:
        """Colour, depth and alpha of covariances [n, 3, 3]; leaves the weights [H W, n] behind."""
        import torch

        camera, v, w = self._camera, self._xi[:3], self._xi[3:]
        # T_map_camera exp(xi): the camera sees exp(-xi) p; first order is exact for derivatives at xi = 0
        turn = torch.eye(3, dtype=torch.float64) - _hat(w)
        W, t = turn @ self._T[:3, :3], turn @ self._T[:3, 3] - v
        order, z, centres, conics = project(means, covariances, W, t, camera)
        rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
        pixels = torch.stack([columns, rows], -1).reshape(-1, 2).to(torch.float64)
        weights, self._margin = blend(pixels, centres, conics, torch.sigmoid(opacity_logits[order]))
        total = weights.sum(1)
        self._weights = torch.zeros(len(total), self._n, dtype=torch.float64).index_copy(1, order, weights)
        shape = (camera.height, camera.width)
        color = weights @ colors[order] + (1 - total)[:, None] * self._background
        return color.reshape(*shape, 3), (weights @ z).reshape(shape), total.reshape(shape)


def project(means: Any, covariances: Any, W: Any, t: Any, camera: PinholeCamera) -> tuple[Any, Any, Any, Any]:
    """Gaussians in front of the camera (rotation W, translation t of T_camera_map), nearest first.

    Returns their indices [k], depths z [k], centres [k, 2] in pixels and inverse screen covariances [k, 2, 2].
    """
    import torch

    x, y, z = (means @ W.T + t).unbind(-1)
    order = torch.argsort(z.detach(), stable=True)
    order = order[z.detach()[order] >= NEAR_M]
    x, y, z = x[order], y[order], z[order]
    limit_x = FIELD_MARGIN * camera.width / 2 / camera.fx
    limit_y = FIELD_MARGIN * camera.height / 2 / camera.fy
    zero = torch.zeros_like(z)
    J = torch.stack(
        [
            torch.stack([camera.fx / z, zero, -camera.fx * (x / z).clamp(-limit_x, limit_x) / z], -1),
            torch.stack([zero, camera.fy / z, -camera.fy * (y / z).clamp(-limit_y, limit_y) / z], -1),
        ],
        dim=-2,
    )
    JW = J @ W
    screen = JW @ covariances[order] @ JW.mT + BLUR_PX2 * torch.eye(2, dtype=z.dtype)
    centres = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
    return order, z, centres, torch.linalg.inv(screen)


def blend(pixels: Any, centres: Any, conics: Any, opacities: Any) -> tuple[Any, float]:
    """Blending weights [m, k] of k Gaussians, nearest first, at m pixels, and their `gate_margin`."""
    import torch

    x, y = (pixels[:, None] - centres).unbind(-1)
    power = conics[:, 0, 0] * x * x + 2 * conics[:, 0, 1] * x * y + conics[:, 1, 1] * y * y  # d^T C^-1 d
    raw = opacities * torch.exp(-0.5 * power)
    alpha = torch.where(raw.detach() >= ALPHA_MIN, raw.clamp(max=ALPHA_MAX), torch.zeros_like(raw))
    left = torch.cumprod(1 - alpha.detach(), dim=1)
    drawn = torch.cumprod((left >= TRANSMITTANCE_MIN).long(), dim=1).bool()
    margin = _margin(raw.detach().numpy(), left.numpy())
    alpha = torch.where(drawn, alpha, torch.zeros_like(alpha))
    before = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], dim=1), dim=1)[:, :-1]
    return alpha * before, margin


def sigma_of(quats_wxyz: Any, log_scales: Any) -> Any:
    """Sigma [n, 3, 3] of quaternions of any length and log-scales."""
    import torch

    w, x, y, z = (quats_wxyz / quats_wxyz.norm(dim=-1, keepdim=True)).unbind(-1)
    R = torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        dim=-2,
    )
    return (R * torch.exp(2 * log_scales)[:, None, :]) @ R.mT


def _matrix_exp(vec_log: Any) -> Any:
    """Sigma [n, 3, 3] of vec log Sigma [n, 6]."""
    import torch

    basis = torch.tensor(spd.vec_to_sym(np.eye(6)))
    return torch.linalg.matrix_exp(torch.einsum("nk,kij->nij", vec_log, basis))


def _hat(w: Any) -> Any:
    import torch

    zero = torch.zeros((), dtype=w.dtype)
    x, y, z = w
    return torch.stack([torch.stack([zero, -z, y]), torch.stack([z, zero, -x]), torch.stack([-y, x, zero])])


def _jacobian(outputs: Any, inputs: list[Any]) -> list[NDArray[np.float64]]:
    """Derivatives [m, ...] of every one of the outputs [m] by each input [...]."""
    import torch

    rows = [
        torch.autograd.grad(outputs, inputs, grad_outputs=seeds, is_grads_batched=True, retain_graph=True)
        for seeds in torch.eye(len(outputs), dtype=torch.float64).split(JACOBIAN_ROWS)
    ]
    return [torch.cat(columns).numpy() for columns in zip(*rows, strict=True)]


def _margin(raw: NDArray[np.float64], left: NDArray[np.float64]) -> float:
    distances = [
        np.abs(raw / ALPHA_MIN - 1),
        np.abs(raw / ALPHA_MAX - 1),
        np.abs(left / TRANSMITTANCE_MIN - 1),
    ]
    return float(min((d.min() for d in distances if d.size), default=1.0))
