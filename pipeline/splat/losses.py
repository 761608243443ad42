"""Losses between a render and an RGB-D image, with their cotangents.

Colors are float32 RGB in 0..1 [H, W, 3], depths float32 meters [H, W] with 0 = not measured. The rasterizer's
depth is blended, D = sum(w z), and its alpha is A = sum(w); the depth residual used here is D - A z_measured: the
blended depth against the measured one weighted by the opacity. It is zero exactly when D / A is the measured depth,
has no division by a small A, and its gradient neither rewards nor punishes opacity as such.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.training import LossConfig

Image = NDArray[np.float32]


class Rendered(Protocol):
    """What the rasterizer returns.

    Attributes:
        color: [H, W, 3].
        depth: [H, W] = sum(w z), meters.
        alpha: [H, W] = sum(w).
    """

    @property
    def color(self) -> Image: ...
    @property
    def depth(self) -> Image: ...
    @property
    def alpha(self) -> Image: ...


@dataclass(frozen=True)
class Loss:
    """A loss and its derivatives.

    Attributes:
        value: weighted sum of the terms.
        color: mean of the color term before its weight, 0..1.
        depth: mean of the depth term before its weight, meters.
        d_color: derivative by the rendered color, [H, W, 3].
        d_depth: derivative by the rendered depth, [H, W].
        d_alpha: derivative by the rendered alpha, [H, W].
        d_exposure: derivatives by the exposure (a, b).
    """

    value: float
    color: float
    depth: float
    d_color: Image
    d_depth: Image
    d_alpha: Image
    d_exposure: tuple[float, float]


def huber(residual: Image, delta: float) -> tuple[Image, Image]:
    """Huber loss with unit slope in the tail, and its derivative.

    value = r^2 / (2 delta) for |r| < delta, else |r| - delta / 2; derivative = clip(r / delta, -1, 1).
    delta -> 0 is the L1 loss of the paper's front end.

    Args:
        residual: of any shape.
        delta: where the loss turns linear, in the unit of the residual.
    """
    slope = np.clip(residual * (1.0 / delta), -1.0, 1.0)
    return slope * (residual - (0.5 * delta) * slope), slope


def rgbd_loss(
    render: Rendered,
    color: Image,
    depth_m: Image,
    config: LossConfig,
    *,
    exposure: tuple[float, float] = (0.0, 0.0),
    mask: NDArray[np.bool_] | None = None,
    certainty: Image | None = None,
) -> Loss:
    """Robust color and depth loss of one view.

    Args:
        render: what the rasterizer drew.
        color: measured color, compared with exp(a) * rendered + b.
        depth_m: measured depth in meters, 0 where there is none.
        config: weights and Huber widths.
        exposure: (a, b) of this image: log gain and offset.
        mask: pixels that count, all if absent.
        certainty: factor [H, W] of the depth residuals, 0..1; all 1 if absent. See `depth_certainty`.
    Returns:
        Means over the counted pixels and the cotangents of exactly that mean.
    """
    gain, offset = math.exp(exposure[0]), exposure[1]
    shown = render.color if exposure == (0.0, 0.0) else gain * render.color + offset
    color_value, slope = huber(shown - color, config.color_huber)
    measured = depth_m > 0
    if mask is not None:
        color_value = color_value * mask[..., None]
        slope = slope * mask[..., None]
        measured = measured & mask
    pixels = color.shape[0] * color.shape[1] if mask is None else int(np.count_nonzero(mask))
    per_color = 1.0 / max(3 * pixels, 1)
    per_depth = 1.0 / max(int(np.count_nonzero(measured)), 1)

    residual = np.where(measured, render.depth - render.alpha * depth_m, depth_m.dtype.type(0))
    if certainty is not None:
        residual = residual * certainty
    depth_value, depth_slope = huber(residual, config.depth_huber_m)
    depth_slope = depth_slope * (config.depth_weight * per_depth)
    if certainty is not None:
        depth_slope = depth_slope * certainty
    missing_slope = measured.astype(depth_m.dtype) * (config.alpha_weight * per_depth)
    d_alpha = -depth_slope * depth_m - missing_slope

    color_mean = float(np.sum(color_value, dtype=np.float64)) * per_color
    depth_mean = float(np.sum(depth_value, dtype=np.float64)) * per_depth
    missing = float(np.sum(measured * (1 - render.alpha), dtype=np.float64)) * per_depth
    by_gain = float(np.sum(slope * render.color, dtype=np.float64)) * gain * per_color
    by_offset = float(np.sum(slope, dtype=np.float64)) * per_color
    return Loss(
        value=color_mean + config.depth_weight * depth_mean + config.alpha_weight * missing,
        color=color_mean,
        depth=depth_mean,
        d_color=slope * (gain * per_color),
        d_depth=depth_slope,
        d_alpha=d_alpha,
        d_exposure=(by_gain, by_offset),
    )


class DepthTrust(Protocol):
    """What a loss has to say of uncertain depth; as of `LossConfig`."""

    @property
    def depth_huber_m(self) -> float: ...
    @property
    def depth_sigma_quadratic_per_m(self) -> float: ...


def depth_certainty(depth_m: Image, depth_sigma_m: Image | None, loss: DepthTrust) -> Image | None:
    """Factor [H, W] of the depth residuals: min(1, Huber width / standard deviation); None: 1 everywhere.

    Up to the Huber width a residual counts in meters, as without a sigma; a less certain one in units of its sigma,
    so that it turns linear where that many sigmas are. Otherwise the depth of far surfaces, whose noise grows with the
    square of the distance, would outweigh colors, and Gaussians that agree with none of it would become transparent.

    Args:
        depth_m: [H, W], meters, 0 = unknown.
        depth_sigma_m: [H, W], standard deviation of the depth, meters; None: not stated, by the distance.
        loss: Huber width, and growth of a deviation that is not stated.
    """
    huber_m = np.float32(loss.depth_huber_m)
    if depth_sigma_m is None:
        quadratic = np.float32(loss.depth_sigma_quadratic_per_m)
        if quadratic * depth_m.max(initial=0) ** 2 <= huber_m:
            return None
        depth_sigma_m = quadratic * (depth_m * depth_m)
    return np.asarray(huber_m / np.maximum(depth_sigma_m, huber_m), dtype=np.float32)


def halve(image: NDArray) -> NDArray:
    """Means of the 2x2 blocks of an image [H, W, ...]; a last odd row or column is cut.

    Args:
        image: [H, W, ...], floating point.
    """
    h, w = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    out = np.empty((h // 2, w // 2, *image.shape[2:]), image.dtype)
    for channel in np.ndindex(
        image.shape[2:]
    ):  # one by one: numpy is slow where the innermost axis has three
        top, bottom = image[0:h:2, :w, *channel], image[1:h:2, :w, *channel]
        mean = top[:, 0::2] + top[:, 1::2]
        mean += bottom[:, 0::2]
        mean += bottom[:, 1::2]
        mean *= image.dtype.type(0.25)
        out[:, :, *channel] = mean
    return out
