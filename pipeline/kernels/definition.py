"""The definition of rendering: what `Rasterizer` computes, as formulas in float64 (torch).

One Gaussian: Sigma = R(q) diag(exp 2s) R(q)^T (paper eq. (1)), opacity o = sigmoid(logit). In a camera with rotation W
and center p of the Gaussian in the camera frame, J the derivative of the projection at p:

    screen covariance   C = J W Sigma W^T J^T + BLUR I
    alpha at a pixel    a = min(o exp(-d^T C^-1 d / 2), ALPHA_MAX), d = pixel - center; nothing if o exp(..) < 1/255
    weight              w_i = a_i prod_{j nearer} (1 - a_j); a Gaussian that would take the product below
                        TRANSMITTANCE_MIN closes the pixel and is not drawn
    color = sum w c + (1 - sum w) background,  depth = sum w z,  alpha = sum w

z is the depth of the center ("blended"), or z + k^T C^-1 d with k = J W Sigma W^T e_z, the covariance of screen
position and depth ("ray_plane"): in the affine approximation the mean depth of the Gaussian along the ray of the
pixel, which for a flat disc is where the ray meets its plane.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry import spd
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels.types import LossWeights

NEAR_M = 0.01
BLUR_PX2 = 1 / 12
FIELD_MARGIN = 1.3
LARGEST_PX2 = 1e12
ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4
SAME_LAYER = 0.05  # relative difference of depth


class Screen(NamedTuple):
    """k Gaussians as the camera sees them, nearest first; each array may have the pixels [m] in front.

    Attributes:
        centers: [k, 2], px.
        conics: C^-1 [k, 2, 2], 1/px^2.
        depths: [k], m.
        slopes: [k, 2], m/px, of the depth over the screen; zero unless "ray_plane".
        opacities: [k].
        colors: [k, 3].
    """

    centers: Any
    conics: Any
    depths: Any
    slopes: Any
    opacities: Any
    colors: Any


SCREEN_NUMBERS = 2 + 4 + 1 + 2 + 1 + 3  # of one Gaussian


class Painting(NamedTuple):
    """m pixels.

    Attributes:
        color: [m, 3].
        depth: [m].
        alpha: [m].
        weights: [m, k].
        gates: see `blend`.
        depths: [m, k], of every Gaussian at every pixel.
    """

    color: Any
    depth: Any
    alpha: Any
    weights: Any
    gates: tuple[Any, Any]
    depths: Any


Channels = Callable[[Painting], Any]  # to values [c, m]


def project(
    means: Any, covariances: Any, W: Any, t: Any, *, camera: PinholeCamera
) -> tuple[Any, Any, Any, Any]:
    """Gaussians in front of the camera (rotation W, translation t of T_camera_map), nearest first.

    Args:
        means: [n, 3], in the frame `map`.
        covariances: [n, 3, 3].
        W: rotation [3, 3], or one for each Gaussian.
        t: translation [3], or one for each Gaussian.
        camera: that sees them.
    Returns:
        Their indices [k], depths z [k], centers [k, 2] in pixels and inverse screen covariances [k, 2, 2].
    """
    import torch

    places = (means[:, None] @ W.mT)[:, 0] + t
    z = places.detach()[:, 2]
    order = torch.argsort(z, stable=True)
    order = order[z[order] >= NEAR_M]
    JW, _ = linearized(places[order], W.expand(len(means), 3, 3)[order], camera)
    C = JW @ covariances[order] @ JW.mT + BLUR_PX2 * torch.eye(2, dtype=z.dtype)
    small = C.detach().diagonal(dim1=-2, dim2=-1).amax(-1) <= LARGEST_PX2
    order = order[small]
    x, y, z = places[order].unbind(-1)
    centers = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
    return order, z, centers, torch.linalg.inv(C[small])


def screen_of(
    means: Any,
    covariances: Any,
    opacity_logits: Any,
    colors: Any,
    *,
    W: Any,
    t: Any,
    camera: PinholeCamera,
    depth_kind: DepthKind,
) -> tuple[Any, Screen, Any]:
    """What Gaussians are on the screen of a camera.

    Args:
        means: [n, 3], in the frame `map`.
        covariances: [n, 3, 3].
        opacity_logits: [n].
        colors: [n, 3].
        W: rotation [3, 3] of T_camera_map, or one for each Gaussian.
        t: translation [3], or one for each Gaussian.
        camera: that sees them.
        depth_kind: depth of a Gaussian at a pixel, see above.
    Returns:
        Indices [k] of those in front of the camera, nearest first, their `Screen`, and how far [k] they are from where
        J is clamped (`linearized`).
    """
    import torch

    n = len(means)
    W, t = W.expand(n, 3, 3), t.expand(n, 3)
    order, z, centers, conics = project(means, covariances, W, t, camera=camera)
    places = (W @ means[..., None])[order, :, 0] + t[order]
    JW, from_clamp = linearized(places, W[order], camera)
    along_z = JW @ covariances[order] @ W[order, 2, :, None]  # k, covariance of screen position and depth
    slopes = (conics @ along_z)[..., 0]
    if depth_kind == "blended":
        slopes = torch.zeros_like(slopes)
    opacities = torch.sigmoid(opacity_logits)[order]
    return order, Screen(centers, conics, z, slopes, opacities, colors[order]), from_clamp


def slope_limit(pixels: int, focal_px: float, center_px: float) -> float:
    """Slope beyond which J is clamped: 1.3 times the half field, and never inside the image.

    Args:
        pixels: of a row or column.
        focal_px: focal length along it.
        center_px: place of the principal point on it.
    """
    return max(FIELD_MARGIN * pixels / 2, center_px + 0.5, pixels - 0.5 - center_px) / focal_px


def linearized(places: Any, W: Any, camera: PinholeCamera) -> tuple[Any, Any]:
    """J W [k, 2, 3] of places in the camera, px/m, and how far [k], relatively, they are from where J is
    clamped.

    Args:
        places: [k, 3] with z > 0, meters, camera frame.
        W: rotation [3, 3] of T_camera_map, or [k, 3, 3].
        camera: that sees them.
    """
    import torch

    x, y, z = places.unbind(-1)
    limit_x = slope_limit(camera.width, camera.fx, camera.cx)
    limit_y = slope_limit(camera.height, camera.fy, camera.cy)
    zero = torch.zeros_like(z)
    J = torch.stack(
        [
            torch.stack([camera.fx / z, zero, -camera.fx * (x / z).clamp(-limit_x, limit_x) / z], -1),
            torch.stack([zero, camera.fy / z, -camera.fy * (y / z).clamp(-limit_y, limit_y) / z], -1),
        ],
        dim=-2,
    )
    from_clamp = torch.minimum(((x / z).abs() / limit_x - 1).abs(), ((y / z).abs() / limit_y - 1).abs())
    return J @ W, from_clamp.detach()


def paint(pixels: Any, screen: Screen, background: Any, closing: float = 0.0) -> Painting:
    """Color, depth and alpha of pixels.

    Args:
        pixels: [m, 2], column and row.
        screen: k Gaussians, nearest first.
        background: RGB [3].
        closing: as in `blend`.
    """
    weights, gates = blend(pixels, screen.centers, screen.conics, screen.opacities, closing=closing)
    total = weights.sum(-1)
    color = (weights[..., None] * screen.colors).sum(-2) + (1 - total)[:, None] * background
    along_ray = screen.depths + (screen.slopes * (pixels[:, None] - screen.centers)).sum(-1)
    return Painting(color, (weights * along_ray).sum(-1), total, weights, gates, along_ray)


def blend(
    pixels: Any, centers: Any, conics: Any, opacities: Any, *, closing: float = 0.0
) -> tuple[Any, tuple[Any, Any]]:
    """Blending weights [m, k] of k Gaussians, nearest first, at pixels [m, 2].

    Args:
        pixels: [m, 2].
        centers: [k, 2], px.
        conics: [k, 2, 2], 1/px^2.
        opacities: [k].
        closing: where it is above TRANSMITTANCE_MIN, the Gaussian that takes the product below it stops all that is
            left, as if its alpha were 1.
    Returns:
        The weights, and the quantities that the thresholds apply to: alpha before its clamp and the light left after
        each Gaussian, [m, k] both.
    """
    import torch

    x, y = (pixels[:, None] - centers).unbind(-1)
    power = conics[..., 0, 0] * x * x + 2 * conics[..., 0, 1] * x * y + conics[..., 1, 1] * y * y
    raw = opacities * torch.exp(-0.5 * power)
    alpha = torch.where(raw.detach() >= ALPHA_MIN, raw.clamp(max=ALPHA_MAX), torch.zeros_like(raw))
    left = torch.cumprod(1 - alpha.detach(), dim=1)
    if closing > TRANSMITTANCE_MIN:
        before = torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], dim=1)
        alpha = torch.where((before >= closing) & (left < closing), torch.ones_like(alpha), alpha)
        left = torch.where(before >= closing, torch.ones_like(left), torch.zeros_like(left))  # all before it
    drawn = torch.cumprod((left >= TRANSMITTANCE_MIN).long(), dim=1).bool()
    alpha = torch.where(drawn, alpha, torch.zeros_like(alpha))
    before = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], dim=1), dim=1)[:, :-1]
    return alpha * before, (raw.detach(), left)


def view_loss(
    drawn: Painting, color: Any, depth_m: Any, certainty: Any, *, loss: LossWeights, exposure: Any
) -> tuple[Any, Any, Any, Any]:
    """The loss of m pixels and its means of color, depth and surface, as `Rasterizer.view_gradients` defines them.

    Args:
        drawn: the pixels.
        color: [m, 3], measured.
        depth_m: [m], measured.
        certainty: [m], factor of the depth residuals.
        loss: weights of the terms.
        exposure: (a, b) [2].
    """
    measured = depth_m > 0
    shown = exposure[0].exp() * drawn.color + exposure[1]
    per_depth = 1.0 / max(int(measured.sum()), 1)
    color_mean = _huber(shown - color, loss.color_huber).sum() / max(color.numel(), 1)
    blended = ((drawn.depth - drawn.alpha * depth_m) * certainty)[measured]
    depth_mean = _huber(blended, loss.depth_huber_m).sum() * per_depth
    missing = (1 - drawn.alpha)[measured].sum() * per_depth
    of_each = _huber((drawn.depths - depth_m[:, None]) * certainty[:, None], loss.depth_huber_m)
    surface = (drawn.weights * of_each)[measured].sum() * per_depth
    value = (
        color_mean
        + loss.depth_weight * depth_mean
        + loss.alpha_weight * missing
        + loss.surface_weight * surface
    )
    return value, color_mean, depth_mean, surface


def sigma_of(quats_wxyz: Any, log_scales: Any) -> Any:
    """Sigma [n, 3, 3] of quaternions of any length and log-scales.

    Args:
        quats_wxyz: [n, 4].
        log_scales: [n, 3], logarithms of meters.
    """
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


def matrix_exp(vec_log: Any) -> Any:
    """Sigma [n, 3, 3] of vec log Sigma [n, 6].

    Args:
        vec_log: [n, 6], order of `geometry.spd`.
    """
    import torch

    basis = torch.tensor(spd.vec_to_sym(np.eye(6)))
    return torch.linalg.matrix_exp(torch.einsum("nk,kij->nij", vec_log, basis))


def hat(w: Any) -> Any:
    """Cross product matrices [n, 3, 3] of w [n, 3].

    Args:
        w: [n, 3].
    """
    import torch

    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(-1, 3, 3)


def _huber(residual: Any, delta: float) -> Any:
    import torch

    size = residual.abs()
    return torch.where(size < delta, residual**2 / (2 * delta), size - delta / 2)


def color_and_depth(drawn: Painting) -> Any:
    """The measured channels [4, m]: red, green, blue, depth.

    Args:
        drawn: m pixels.
    """
    import torch

    return torch.cat([drawn.color.T, drawn.depth[None]])


def derivatives_by_inputs(screen: Screen, inputs: list[Any], order: NDArray[np.int64]) -> NDArray[np.float64]:
    """Derivatives [k, s, p] of the screen numbers of every Gaussian by its own inputs.

    Args:
        screen: one Gaussian after the other, [n, ...].
        inputs: [n, ...].
        order: rows that are wanted [k].
    """
    import torch

    columns = torch.cat([columns_of(numbers, 1) for numbers in screen], dim=1).unbind(1)
    out = []
    for column in columns:
        # every Gaussian depends on its own inputs only: the derivative of the sum is that of each
        parts = torch.autograd.grad(
            column.sum(), inputs, retain_graph=True, allow_unused=True, materialize_grads=True
        )
        out.append(torch.cat([columns_of(part, 1) for part in parts], dim=1))
    return torch.stack(out, dim=1).numpy()[order]


def columns_of(values: Any, axes: int) -> Any:
    """All axes but the first few as one.

    Args:
        values: [...], of more axes than `axes`, or as many.
        axes: number of axes that stay.
    """
    return values.reshape(*values.shape[:axes], int(np.prod(values.shape[axes:])))


def tensor(array: ArrayLike) -> Any:
    """An array in float64, without a gradient.

    Args:
        array: of numbers.
    """
    import torch

    return torch.tensor(np.asarray(array, dtype=np.float64))
