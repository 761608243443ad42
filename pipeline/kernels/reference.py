"""What the compiled rasterizer computes, written down in float64 for small scenes; the tests compare the two.

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

Derivatives come from automatic differentiation. Information comes from the Jacobian of every pixel: each pixel is
drawn from its own copy of the screen numbers (center, C^-1, depth, ...), so that one differentiation per channel gives
the rows of all pixels, and each Gaussian's screen numbers depend on its own parameters only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry import spd
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels.types import FisherSums, Gradients, LossWeights, Render, ViewLoss
from duagc.pipeline.splat.gaussians import DEPTH_KINDS, Gaussians

NEAR_M = 0.01
BLUR_PX2 = 1 / 12
FIELD_MARGIN = 1.3
LARGEST_PX2 = 1e12
ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4

# Relative distance from a threshold within which float32 may decide otherwise; see `decided`.
UNSURE_ALPHA = 1e-4  # alpha and transmittance
UNSURE_PLACE = 1e-6  # depths and directions

_PARAMETERS = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")


class ReferenceRasterizer:
    """Same calls as `Rasterizer`, float64 results. Time and memory grow as pixels times Gaussians."""

    def forward(
        self,
        gaussians: Gaussians,
        camera: PinholeCamera,
        T_camera_map: ArrayLike,
        background: ArrayLike = (0.0, 0.0, 0.0),
        *,
        depth_kind: DepthKind = "blended",
        mask: NDArray[np.bool_] | None = None,
    ) -> Render:
        """Draw the Gaussians (frame map) into the camera at T_camera_map [4, 4]; see `Rasterizer.forward`."""
        import torch

        if depth_kind not in DEPTH_KINDS:
            raise ValueError(f"depth_kind is {depth_kind!r}, expected one of {', '.join(DEPTH_KINDS)}")
        n, shape = len(gaussians), (camera.height, camera.width)
        self._camera, self._n, self._depth_kind = camera, n, depth_kind
        self._drawn = np.ones(shape, dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
        self._pixels = _tensor(np.argwhere(self._drawn)[:, ::-1].copy())  # x, y
        self._T, self._background = _tensor(T_camera_map), _tensor(background)
        self._parameters = {name: _tensor(getattr(gaussians, name)).requires_grad_() for name in _PARAMETERS}
        self._log_covariances = spd.log_covariance(gaussians.quats_wxyz, gaussians.log_scales)
        self._xi = torch.zeros((n, 6), dtype=torch.float64, requires_grad=True)  # a copy for every Gaussian
        p = self._parameters
        self._screen = self._project(sigma_of(p["quats_wxyz"], p["log_scales"]))
        self._painting = paint(self._pixels, self._screen, self._background)
        return Render(*(self._image(values) for values in self._painting[:3]))

    def backward(
        self,
        d_color: ArrayLike,
        d_depth: ArrayLike | None = None,
        d_alpha: ArrayLike | None = None,
        *,
        pose: bool = False,
        fisher: bool = False,
        parameters: bool = True,
    ) -> Gradients:
        """Derivatives of <d_color, color> + <d_depth, depth> + <d_alpha, alpha>; see `Rasterizer.backward`."""
        per_pixel = self._dot(d_color, d_depth, d_alpha)
        gradients = self._gradients(per_pixel(self._painting).sum(), pose, parameters)
        if not fisher:
            return gradients
        jacobian = self._jacobian(per_pixel, self._screen, list(self._parameters.values()))
        return Gradients(**{**vars(gradients), "fisher_diagonal": (jacobian**2).sum((0, 1))})

    def fisher(
        self,
        inv_var_color: ArrayLike,
        inv_var_depth: ArrayLike,
        sums: FisherSums,
        residual: ArrayLike | None = None,
    ) -> None:
        """Add sum over pixels of J^T R^-1 J in (mean, vec log Sigma, color, logit); see `Rasterizer.fisher`."""
        p = self._parameters
        log_covariances = _tensor(self._log_covariances).requires_grad_()
        screen = self._project(_matrix_exp(log_covariances))
        inputs = [p["means"], log_covariances, p["colors"], p["opacity_logits"]]
        jacobian = self._jacobian(_color_and_depth, screen, inputs)
        precision = self._precision(inv_var_color, inv_var_depth)
        information = np.einsum("cm,cmni,cmnj->nij", precision, jacobian, jacobian)
        rows, columns = np.triu_indices(9)
        sums.geometry += information[:, rows, columns]
        sums.color += np.diagonal(information, axis1=1, axis2=2)[:, 9:12]
        sums.opacity += information[:, 12, 12]
        weights = self._weights()[(precision > 0).any(axis=0)]
        sums.observations += (weights > 0).any(axis=0).astype(np.uint32)
        sums.weight += weights.sum(axis=0)
        if residual is not None:
            of_pixel = np.asarray(residual, dtype=np.float64)[self._drawn][(precision > 0).any(axis=0)]
            sums.residual += of_pixel @ weights
        if sums.diagonal is not None:
            full = self.full_fisher(inv_var_color, inv_var_depth)
            sums.diagonal += np.diagonal(full, axis1=1, axis2=2)

    def full_fisher(self, inv_var_color: ArrayLike, inv_var_depth: ArrayLike) -> NDArray[np.float64]:
        """J^T R^-1 J [n, 14, 14] of the last view; see `Rasterizer.full_fisher`."""
        jacobian = self._jacobian(_color_and_depth, self._screen, list(self._parameters.values()))
        precision = self._precision(inv_var_color, inv_var_depth)
        return np.einsum("cm,cmni,cmnj->nij", precision, jacobian, jacobian)

    def view_gradients(
        self,
        gaussians: Gaussians,
        camera: PinholeCamera,
        T_camera_map: ArrayLike,
        color: ArrayLike,
        depth_m: ArrayLike,
        loss: LossWeights,
        *,
        exposure: tuple[float, float] = (0.0, 0.0),
        background: ArrayLike = (0.0, 0.0, 0.0),
        mask: NDArray[np.bool_] | None = None,
        depth_kind: DepthKind = "blended",
        pose: bool = False,
        parameters: bool = True,
        depth_certainty: ArrayLike | None = None,
    ) -> tuple[ViewLoss, Gradients]:
        """Draw, compare with a measured image, differentiate; see `Rasterizer.view_gradients`."""
        import torch

        self.forward(gaussians, camera, T_camera_map, background, depth_kind=depth_kind, mask=mask)
        certainty = np.ones(self._drawn.shape) if depth_certainty is None else depth_certainty
        rgb, z, sure = (_tensor(np.asarray(image)[self._drawn]) for image in (color, depth_m, certainty))
        gain_and_offset = _tensor(exposure).requires_grad_()
        found = view_loss(self._painting, rgb, z, sure, loss, gain_and_offset)
        (by_exposure,) = torch.autograd.grad(found[0], [gain_and_offset], retain_graph=True)
        a, b = by_exposure.tolist()
        value, of_color, of_depth, surface = (float(mean.detach()) for mean in found)
        summary = ViewLoss(value, of_color, of_depth, (a, b), surface)
        return summary, self._gradients(found[0], pose, parameters)

    def contributions(self) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
        """Sum of the blending weights [n] of each Gaussian and number of its pixels [n]."""
        weights = self._weights()
        return weights.sum(axis=0), (weights > 0).sum(axis=0).astype(np.uint32)

    def layer_depth(self, tolerance: float = 0.05) -> NDArray[np.float64]:
        """Depth [H, W] of the layer that the median Gaussian of a pixel lies on; see `Rasterizer.layer_depth`."""
        weights, depths = (part.detach().numpy() for part in (self._painting.weights, self._painting.depths))
        left = 1 - np.cumsum(weights, axis=1)
        before = np.concatenate([np.ones((len(left), 1)), left[:, :-1]], axis=1)
        median = np.where((before >= 0.5) & (left < 0.5), depths, 0.0).sum(axis=1)
        own = np.where(np.abs(depths - median[:, None]) <= tolerance * median[:, None], weights, 0.0)
        mean = (own * depths).sum(axis=1) / np.maximum(own.sum(axis=1), 1e-8)
        image = np.zeros(self._drawn.shape)
        image[self._drawn] = np.where(median > 0, mean, 0.0)
        return image

    def gate_margin(self) -> float:
        """Smallest relative distance of any pair of pixel and Gaussian from the thresholds of alpha and transmittance.

        Near zero, rounding decides whether the pair is drawn, and another precision may differ visibly.
        """
        return float(self._margins().min(initial=1.0))

    def decided(self) -> NDArray[np.bool_]:
        """Pixels [H, W] in which no threshold of the definition is so near that float32 may decide otherwise.

        The thresholds are those of `gate_margin`, the order of two depths, and the clamp of J. At each of them the
        image or its derivative jumps, so that no precision makes two implementations agree there.
        """
        seen, z = self._painting.weights.detach().numpy() > 0, self._screen.depths.detach().numpy()
        nearer = np.maximum.accumulate(np.where(seen, z, 0.0), axis=1)[:, :-1]  # the last one seen before
        gap = 1 - nearer / z[1:]
        mixed_up = (seen[:, 1:] & (gap > 0) & (gap < UNSURE_PLACE)).any(axis=1)
        at_clamp = (seen & (self._from_clamp.numpy() < UNSURE_PLACE)).any(axis=1)
        out = np.zeros(self._drawn.shape, dtype=bool)
        out[self._drawn] = (self._margins() > UNSURE_ALPHA) & ~mixed_up & ~at_clamp
        return out

    def gradient_terms(
        self, d_color: ArrayLike, d_depth: ArrayLike | None = None, d_alpha: ArrayLike | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What `backward` adds up to the gradients [n, 14] and the pose [6], with all signs taken away.

        They are sums over pixels of sums over screen numbers. Where these cancel, rounding leaves an error in
        proportion to this.
        """
        terms = self._terms(self._dot(d_color, d_depth, d_alpha)).sum((0, 1))
        return terms[:, :14], terms[:, 14:].sum(axis=0)

    def empirical_terms(
        self, d_color: ArrayLike, d_depth: ArrayLike | None = None, d_alpha: ArrayLike | None = None
    ) -> NDArray[np.float64]:
        """The same of `fisher_diagonal` [n, 14], whose squares are those of sums over screen numbers."""
        return (self._terms(self._dot(d_color, d_depth, d_alpha))[..., :14] ** 2).sum((0, 1))

    def information_terms(self, inv_var_color: ArrayLike, inv_var_depth: ArrayLike) -> NDArray[np.float64]:
        """The same of the diagonal that `fisher` adds up."""
        precision = self._precision(inv_var_color, inv_var_depth)
        return np.einsum("cm,cmni->ni", precision, self._terms(_color_and_depth)[..., :14] ** 2)

    # ------------------------------------------------------------ drawing

    def _project(self, sigma: Any) -> Screen:
        """What the Gaussians, of covariance sigma [n, 3, 3] here, are on the screen."""
        import torch

        camera, p, v, w = self._camera, self._parameters, self._xi[:, :3], self._xi[:, 3:]
        # T_map_camera exp(xi): the camera sees exp(-xi) p; first order is exact for derivatives at xi = 0
        turn = torch.eye(3, dtype=torch.float64) - _hat(w)
        W, t = turn @ self._T[:3, :3], turn @ self._T[:3, 3] - v
        order, z, centers, conics = project(p["means"], sigma, W, t, camera)
        self._order = order.numpy()
        places = (W @ p["means"][..., None])[order, :, 0] + t[order]
        JW, self._from_clamp = _linearized(places, W[order], camera)
        along_z = JW @ sigma[order] @ W[order, 2, :, None]  # k, covariance of screen position and depth
        slopes = (conics @ along_z)[..., 0]
        if self._depth_kind == "blended":
            slopes = torch.zeros_like(slopes)
        return Screen(
            centers, conics, z, slopes, torch.sigmoid(p["opacity_logits"])[order], p["colors"][order]
        )

    def _image(self, values: Any) -> NDArray[np.float64]:
        """Values [m, ...] of the drawn pixels as an image, zero elsewhere."""
        image = np.zeros((*self._drawn.shape, *values.shape[1:]))
        image[self._drawn] = values.detach().numpy()
        return image

    def _weights(self) -> NDArray[np.float64]:
        """Blending weights [m, n] of the drawn pixels."""
        weights = np.zeros((len(self._pixels), self._n))
        weights[:, self._order] = self._painting.weights.detach().numpy()
        return weights

    def _margins(self) -> NDArray[np.float64]:
        """The `gate_margin` of every drawn pixel [m], over the Gaussians up to the one that closes it."""
        raw, left = (gate.numpy() for gate in self._painting.gates)
        closed = np.logical_or.accumulate(left < TRANSMITTANCE_MIN, axis=1)
        mattering = np.ones_like(closed)
        mattering[:, 1:] = ~closed[:, :-1]
        margins = np.ones(len(raw))
        for distance in (raw / ALPHA_MIN - 1, raw / ALPHA_MAX - 1, left / TRANSMITTANCE_MIN - 1):
            margins = np.minimum(margins, np.where(mattering, np.abs(distance), 1.0).min(axis=1, initial=1.0))
        return margins

    # ------------------------------------------------------------ derivatives

    def _dot(self, d_color: ArrayLike, d_depth: ArrayLike | None, d_alpha: ArrayLike | None) -> _Channels:
        """The function that gives <d_color, color> + d_depth depth + d_alpha alpha of every drawn pixel, [1, m]."""

        def cotangent(image: ArrayLike | None) -> Any:
            return 0.0 if image is None else _tensor(np.asarray(image)[self._drawn])

        by_color, by_depth, by_alpha = cotangent(d_color), cotangent(d_depth), cotangent(d_alpha)

        def dot(drawn: Painting) -> Any:
            value = (by_color * drawn.color).sum(-1) + by_depth * drawn.depth + by_alpha * drawn.alpha
            return value[None]

        return dot

    def _gradients(self, scalar: Any, pose: bool, parameters: bool) -> Gradients:
        import torch

        if not parameters and not pose:
            raise ValueError("parameters is False, expected pose to be True then")
        inputs = [*self._parameters.values(), self._xi]
        *by_parameter, by_xi = torch.autograd.grad(scalar, inputs, retain_graph=True)
        arrays: dict[str, Any] = {
            name: by.numpy() if parameters else None
            for name, by in zip(_PARAMETERS, by_parameter, strict=True)
        }
        return Gradients(**arrays, pose=by_xi.sum(0).numpy() if pose else None)

    def _by_screen(self, channels: _Channels, screen: Screen) -> NDArray[np.float64]:
        """Derivatives [c, m, k, s] of the channels of every pixel by the screen numbers of the k Gaussians."""
        import torch

        m = len(self._pixels)
        copies = [numbers.detach().expand(m, *numbers.shape).clone().requires_grad_() for numbers in screen]
        values = channels(paint(self._pixels, Screen(*copies), self._background))
        rows = []
        for value in values:
            parts = torch.autograd.grad(value.sum(), copies, retain_graph=True, materialize_grads=True)
            rows.append(torch.cat([_columns(part, 2) for part in parts], dim=2))
        return torch.stack(rows).numpy()

    def _jacobian(self, channels: _Channels, screen: Screen, inputs: list[Any]) -> NDArray[np.float64]:
        """Derivatives [c, m, n, p] of the channels of every pixel by the inputs [n, ...] of every Gaussian."""
        by_screen, by_inputs = self._by_screen(channels, screen), _by_inputs(screen, inputs, self._order)
        return self._by_gaussian(np.einsum("cmks,ksp->cmkp", by_screen, by_inputs))

    def _terms(self, channels: _Channels) -> NDArray[np.float64]:
        """The Jacobian [c, m, n, 14 and pose 6] with every product of the chain rule taken as positive.

        Through screen numbers that know no long and short directions: M center, M^-T C^-1 M^-1 (which is 1) and
        M^-T slope, with C^-1 = M^T M.
        """
        M = np.swapaxes(np.linalg.cholesky(self._screen.conics.detach().numpy()), 1, 2)
        back = np.swapaxes(np.linalg.inv(M), 1, 2)
        change = np.tile(np.eye(_SCREEN_NUMBERS), (len(M), 1, 1))
        change[:, 0:2, 0:2], change[:, 7:9, 7:9] = M, back
        change[:, 2:6, 2:6] = np.einsum("kij,klm->kiljm", back, back).reshape(-1, 4, 4)
        by_screen = self._by_screen(channels, self._screen)
        by_inputs = _by_inputs(self._screen, [*self._parameters.values(), self._xi], self._order)
        by_screen = np.abs(np.einsum("cmks,kst->cmkt", by_screen, np.linalg.inv(change)))
        return self._by_gaussian(np.einsum("cmks,ksp->cmkp", by_screen, np.abs(change @ by_inputs)))

    def _by_gaussian(self, of_screen: NDArray[np.float64]) -> NDArray[np.float64]:
        """[..., k, p] in the order of the screen as [..., n, p]; what is not on the screen is zero."""
        out = np.zeros((*of_screen.shape[:-2], self._n, of_screen.shape[-1]))
        out[..., self._order, :] = of_screen
        return out

    def _precision(self, inv_var_color: ArrayLike, inv_var_depth: ArrayLike) -> NDArray[np.float64]:
        """R^-1 of red, green, blue and depth of every drawn pixel, [4, m]."""
        of_color, of_depth = (
            np.asarray(image, dtype=np.float64)[self._drawn] for image in (inv_var_color, inv_var_depth)
        )
        return np.stack([of_color, of_color, of_color, of_depth])


class Screen(NamedTuple):
    """k Gaussians as the camera sees them, nearest first; each array may have the pixels [m] in front.

    centers: [k, 2], px. conics: C^-1 [k, 2, 2], 1/px^2. depths: [k], m. slopes: [k, 2], m/px, of the depth over the
    screen; zero unless "ray_plane". opacities: [k]. colors: [k, 3].
    """

    centers: Any
    conics: Any
    depths: Any
    slopes: Any
    opacities: Any
    colors: Any


_SCREEN_NUMBERS = 2 + 4 + 1 + 2 + 1 + 3  # of one Gaussian


class Painting(NamedTuple):
    """m pixels. color: [m, 3]. depth: [m]. alpha: [m]. weights: [m, k]. gates: see `blend`. depths: [m, k], of every
    Gaussian at every pixel."""

    color: Any
    depth: Any
    alpha: Any
    weights: Any
    gates: tuple[Any, Any]
    depths: Any


_Channels = Callable[[Painting], Any]  # to values [c, m]


def project(means: Any, covariances: Any, W: Any, t: Any, camera: PinholeCamera) -> tuple[Any, Any, Any, Any]:
    """Gaussians in front of the camera (rotation W, translation t of T_camera_map), nearest first.

    Returns their indices [k], depths z [k], centers [k, 2] in pixels and inverse screen covariances [k, 2, 2].
    W and t may be one for each Gaussian, [n, 3, 3] and [n, 3].
    """
    import torch

    places = (means[:, None] @ W.mT)[:, 0] + t
    z = places.detach()[:, 2]
    order = torch.argsort(z, stable=True)
    order = order[z[order] >= NEAR_M]
    JW, _ = _linearized(places[order], W.expand(len(means), 3, 3)[order], camera)
    C = JW @ covariances[order] @ JW.mT + BLUR_PX2 * torch.eye(2, dtype=z.dtype)
    small = C.detach().diagonal(dim1=-2, dim2=-1).amax(-1) <= LARGEST_PX2
    order = order[small]
    x, y, z = places[order].unbind(-1)
    centers = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
    return order, z, centers, torch.linalg.inv(C[small])


def _linearized(places: Any, W: Any, camera: PinholeCamera) -> tuple[Any, Any]:
    """J W [k, 2, 3] of places [k, 3] in the camera, and how far [k], relatively, they are from where J is clamped."""
    import torch

    x, y, z = places.unbind(-1)
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
    from_clamp = torch.minimum(((x / z).abs() / limit_x - 1).abs(), ((y / z).abs() / limit_y - 1).abs())
    return J @ W, from_clamp.detach()


def paint(pixels: Any, screen: Screen, background: Any) -> Painting:
    """Color, depth and alpha of pixels [m, 2]."""
    weights, gates = blend(pixels, screen.centers, screen.conics, screen.opacities)
    total = weights.sum(-1)
    color = (weights[..., None] * screen.colors).sum(-2) + (1 - total)[:, None] * background
    along_ray = screen.depths + (screen.slopes * (pixels[:, None] - screen.centers)).sum(-1)
    return Painting(color, (weights * along_ray).sum(-1), total, weights, gates, along_ray)


def blend(pixels: Any, centers: Any, conics: Any, opacities: Any) -> tuple[Any, tuple[Any, Any]]:
    """Blending weights [m, k] of k Gaussians, nearest first, at pixels [m, 2].

    Also what the thresholds decide on: alpha before its clamp and the light left after each Gaussian, [m, k] both.
    """
    import torch

    x, y = (pixels[:, None] - centers).unbind(-1)
    power = conics[..., 0, 0] * x * x + 2 * conics[..., 0, 1] * x * y + conics[..., 1, 1] * y * y
    raw = opacities * torch.exp(-0.5 * power)
    alpha = torch.where(raw.detach() >= ALPHA_MIN, raw.clamp(max=ALPHA_MAX), torch.zeros_like(raw))
    left = torch.cumprod(1 - alpha.detach(), dim=1)
    drawn = torch.cumprod((left >= TRANSMITTANCE_MIN).long(), dim=1).bool()
    alpha = torch.where(drawn, alpha, torch.zeros_like(alpha))
    before = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], dim=1), dim=1)[:, :-1]
    return alpha * before, (raw.detach(), left)


def view_loss(
    drawn: Painting, color: Any, depth_m: Any, certainty: Any, loss: LossWeights, exposure: Any
) -> tuple[Any, Any, Any, Any]:
    """The loss of m pixels and its means of color, depth and surface, as `Rasterizer.view_gradients` defines them.

    color [m, 3], depth_m [m]: measured. certainty [m]: factor of the depth residuals. exposure: a, b [2].
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
    """Cross product matrices [n, 3, 3] of w [n, 3]."""
    import torch

    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(-1, 3, 3)


def _huber(residual: Any, delta: float) -> Any:
    import torch

    size = residual.abs()
    return torch.where(size < delta, residual**2 / (2 * delta), size - delta / 2)


def _color_and_depth(drawn: Painting) -> Any:
    """The measured channels [4, m]: red, green, blue, depth."""
    import torch

    return torch.cat([drawn.color.T, drawn.depth[None]])


def _by_inputs(screen: Screen, inputs: list[Any], order: NDArray[np.int64]) -> NDArray[np.float64]:
    """Derivatives [k, s, p] of the screen numbers of every Gaussian by its own inputs [n, ...]; order: which [k]."""
    import torch

    columns = torch.cat([_columns(numbers, 1) for numbers in screen], dim=1).unbind(1)
    out = []
    for column in columns:
        # every Gaussian depends on its own inputs only: the derivative of the sum is that of each
        parts = torch.autograd.grad(
            column.sum(), inputs, retain_graph=True, allow_unused=True, materialize_grads=True
        )
        out.append(torch.cat([_columns(part, 1) for part in parts], dim=1))
    return torch.stack(out, dim=1).numpy()[order]


def _columns(values: Any, axes: int) -> Any:
    """All axes but the first few as one."""
    return values.reshape(*values.shape[:axes], int(np.prod(values.shape[axes:])))


def _tensor(array: ArrayLike) -> Any:
    import torch

    return torch.tensor(np.asarray(array, dtype=np.float64))
