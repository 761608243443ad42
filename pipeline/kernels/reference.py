"""What the compiled rasterizer computes, in float64 for small scenes; the tests compare the two.

The formulas are in `definition`. Derivatives come from automatic differentiation. Information comes from the Jacobian
of every pixel: each pixel is drawn from its own copy of the screen numbers (center, C^-1, depth, ...), so that one
differentiation per channel gives the rows of all pixels, and each Gaussian's screen numbers depend on its own
parameters only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry import spd
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels.definition import (
    SAME_LAYER,
    TRANSMITTANCE_MIN,
    Channels,
    Painting,
    Screen,
    color_and_depth,
    columns_of,
    derivatives_by_inputs,
    hat,
    matrix_exp,
    paint,
    screen_of,
    sigma_of,
    tensor,
    view_loss,
)
from duagc.pipeline.kernels.types import FisherSums, Gradients, LossWeights, Render, ViewLoss
from duagc.pipeline.splat.gaussians import DEPTH_KINDS, Gaussians

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
        """Draw the Gaussians into the camera; see `Rasterizer.forward`.

        Args:
            gaussians: n Gaussians in the frame `map`.
            camera: that draws.
            T_camera_map: [4, 4].
            background: RGB 0..1.
            depth_kind: depth of a Gaussian at a pixel.
            mask: bool [H, W], pixels that are drawn; None: all.
        """
        import torch

        if depth_kind not in DEPTH_KINDS:
            raise ValueError(f"depth_kind is {depth_kind!r}, expected one of {', '.join(DEPTH_KINDS)}")
        n, shape = len(gaussians), (camera.height, camera.width)
        self._camera, self._n, self._depth_kind = camera, n, depth_kind
        self._drawn = np.ones(shape, dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
        self._pixels = tensor(np.argwhere(self._drawn)[:, ::-1].copy())  # x, y
        self._T, self._background = tensor(T_camera_map), tensor(background)
        self._parameters = {name: tensor(getattr(gaussians, name)).requires_grad_() for name in _PARAMETERS}
        self._log_covariances = spd.log_covariance(gaussians.quats_wxyz, gaussians.log_scales)
        self._xi = torch.zeros((n, 6), dtype=torch.float64, requires_grad=True)  # a copy for every Gaussian
        p = self._parameters
        self._screen = self._project(sigma_of(p["quats_wxyz"], p["log_scales"]))
        self._painting = paint(self._pixels, self._screen, self._background)
        return Render(*(self._image(values) for values in self._painting[:3]))

    def forward_with_layer(
        self,
        gaussians: Gaussians,
        camera: PinholeCamera,
        T_camera_map: ArrayLike,
        *,
        depth_kind: DepthKind = "blended",
        mask: NDArray[np.bool_] | None = None,
        tolerance: float = SAME_LAYER,
    ) -> tuple[Render, NDArray[np.float64]]:
        """Draw them and the depth of one layer; see `Rasterizer.forward_with_layer`.

        Args:
            gaussians: as in `forward`.
            camera: as in `forward`.
            T_camera_map: as in `forward`.
            depth_kind: as in `forward`.
            mask: as in `forward`.
            tolerance: relative difference of depth within a layer, 0..1.
        """
        render = self.forward(gaussians, camera, T_camera_map, depth_kind=depth_kind, mask=mask)
        return render, self._layer(tolerance)

    def _layer(self, tolerance: float) -> NDArray[np.float64]:
        """Depth [H, W] of the layer that the median Gaussian of a pixel lies on."""
        weights, depths = (part.detach().numpy() for part in (self._painting.weights, self._painting.depths))
        left = 1 - np.cumsum(weights, axis=1)
        before = np.concatenate([np.ones((len(left), 1)), left[:, :-1]], axis=1)
        median = np.where((before >= 0.5) & (left < 0.5), depths, 0.0).sum(axis=1)
        own = np.where(np.abs(depths - median[:, None]) <= tolerance * median[:, None], weights, 0.0)
        mean = (own * depths).sum(axis=1) / np.maximum(own.sum(axis=1), 1e-8)
        image = np.zeros(self._drawn.shape)
        image[self._drawn] = np.where(median > 0, mean, 0.0)
        return image

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
        """Derivatives of <d_color, color> + <d_depth, depth> + <d_alpha, alpha>; see `Rasterizer.backward`.

        Args:
            d_color: dL/dcolor [H, W, 3].
            d_depth: dL/ddepth [H, W]; None is zero.
            d_alpha: dL/dalpha [H, W]; None is zero.
            pose: also differentiate by the right tangent of T_map_camera.
            fisher: also give the `empirical` diagonal.
            parameters: False takes the derivative of the pose alone.
        """
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
        """Add sum over pixels of J^T R^-1 J in (mean, vec log Sigma, color, logit); see `Rasterizer.fisher`.

        Args:
            inv_var_color: [H, W], 1/sigma^2 of every color channel; 0 leaves the pixel out.
            inv_var_depth: [H, W], 1/m^2; 0 leaves it out.
            sums: of as many Gaussians; changed in place.
            residual: [H, W], summed by weight into sums.residual.
        """
        p = self._parameters
        log_covariances = tensor(self._log_covariances).requires_grad_()
        screen = self._project(matrix_exp(log_covariances))
        inputs = [p["means"], log_covariances, p["colors"], p["opacity_logits"]]
        jacobian = self._jacobian(color_and_depth, screen, inputs)
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
        """J^T R^-1 J [n, 14, 14] of the last view; see `Rasterizer.full_fisher`.

        Args:
            inv_var_color: [H, W], 1/sigma^2 of every color channel.
            inv_var_depth: [H, W], 1/m^2.
        """
        jacobian = self._jacobian(color_and_depth, self._screen, list(self._parameters.values()))
        precision = self._precision(inv_var_color, inv_var_depth)
        return np.einsum("cm,cmni,cmnj->nij", precision, jacobian, jacobian)

    def view_gradients(
        self,
        gaussians: Gaussians,
        camera: PinholeCamera,
        T_camera_map: ArrayLike,
        *,
        color: ArrayLike,
        depth_m: ArrayLike,
        loss: LossWeights,
        exposure: tuple[float, float] = (0.0, 0.0),
        background: ArrayLike = (0.0, 0.0, 0.0),
        mask: NDArray[np.bool_] | None = None,
        depth_kind: DepthKind = "blended",
        pose: bool = False,
        parameters: bool = True,
        depth_certainty: ArrayLike | None = None,
        closing: float = 0.0,
        color_table: ArrayLike | None = None,
    ) -> tuple[ViewLoss, Gradients]:
        """Draw, compare with a measured image, differentiate; see `Rasterizer.view_gradients`.

        Args:
            gaussians: as in `forward`.
            camera: as in `forward`.
            T_camera_map: as in `forward`.
            color: measured, [H, W, 3], RGB 0..1; or bytes with `color_table`.
            depth_m: measured, [H, W], 0 where there is none.
            loss: weights of the terms.
            exposure: (a, b), log gain and offset of this image.
            background: as in `forward`.
            mask: as in `forward`.
            depth_kind: as in `forward`.
            pose: also differentiate by the right tangent of T_map_camera.
            parameters: False takes the derivative of the pose alone.
            depth_certainty: factor [H, W] of the depth residuals, 0..1; None: all 1.
            closing: the Gaussian that takes the light of a pixel below this stops all that is left.
            color_table: [256, 3], the measured color by value of a channel in `color`; None: `color` is it.
        """
        import torch

        self.forward(gaussians, camera, T_camera_map, background, depth_kind=depth_kind, mask=mask)
        if closing > TRANSMITTANCE_MIN:
            self._painting = paint(self._pixels, self._screen, self._background, closing)
        if color_table is not None:
            color = np.asarray(color_table)[np.asarray(color), np.arange(3)]
        certainty = np.ones(self._drawn.shape) if depth_certainty is None else depth_certainty
        rgb, z, sure = (tensor(np.asarray(image)[self._drawn]) for image in (color, depth_m, certainty))
        gain_and_offset = tensor(exposure).requires_grad_()
        found = view_loss(self._painting, rgb, z, sure, loss=loss, exposure=gain_and_offset)
        (by_exposure,) = torch.autograd.grad(found[0], [gain_and_offset], retain_graph=True)
        a, b = by_exposure.tolist()
        value, of_color, of_depth, surface = (float(mean.detach()) for mean in found)
        summary = ViewLoss(value, of_color, of_depth, (a, b), surface)
        return summary, self._gradients(found[0], pose, parameters)

    def contributions(self) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
        """Sum of the blending weights [n] of each Gaussian and number of its pixels [n]."""
        weights = self._weights()
        return weights.sum(axis=0), (weights > 0).sum(axis=0).astype(np.uint32)

    # ------------------------------------------------------------ drawing

    def _project(self, sigma: Any) -> Screen:
        """What the Gaussians, of covariance sigma [n, 3, 3] here, are on the screen."""
        import torch

        camera, p, v, w = self._camera, self._parameters, self._xi[:, :3], self._xi[:, 3:]
        # T_map_camera exp(xi): the camera sees exp(-xi) p; first order is exact for derivatives at xi = 0
        turn = torch.eye(3, dtype=torch.float64) - hat(w)
        W, t = turn @ self._T[:3, :3], turn @ self._T[:3, 3] - v
        order, screen, self._from_clamp = screen_of(
            p["means"],
            sigma,
            p["opacity_logits"],
            p["colors"],
            W=W,
            t=t,
            camera=camera,
            depth_kind=self._depth_kind,
        )
        self._order = order.numpy()
        return screen

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

    # ------------------------------------------------------------ derivatives

    def _dot(self, d_color: ArrayLike, d_depth: ArrayLike | None, d_alpha: ArrayLike | None) -> Channels:
        """The function that gives <d_color, color> + d_depth depth + d_alpha alpha of every drawn pixel, [1, m]."""

        def cotangent(image: ArrayLike | None) -> Any:
            return 0.0 if image is None else tensor(np.asarray(image)[self._drawn])

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

    def _by_screen(self, channels: Channels, screen: Screen) -> NDArray[np.float64]:
        """Derivatives [c, m, k, s] of the channels of every pixel by the screen numbers of the k Gaussians."""
        import torch

        m = len(self._pixels)
        copies = [numbers.detach().expand(m, *numbers.shape).clone().requires_grad_() for numbers in screen]
        values = channels(paint(self._pixels, Screen(*copies), self._background))
        rows = []
        for value in values:
            parts = torch.autograd.grad(value.sum(), copies, retain_graph=True, materialize_grads=True)
            rows.append(torch.cat([columns_of(part, 2) for part in parts], dim=2))
        return torch.stack(rows).numpy()

    def _jacobian(self, channels: Channels, screen: Screen, inputs: list[Any]) -> NDArray[np.float64]:
        """Derivatives [c, m, n, p] of the channels of every pixel by the inputs [n, ...] of every Gaussian."""
        by_screen, by_inputs = (
            self._by_screen(channels, screen),
            derivatives_by_inputs(screen, inputs, self._order),
        )
        return self._by_gaussian(np.einsum("cmks,ksp->cmkp", by_screen, by_inputs))

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
