"""Losses between a render and an RGB-D image, with their cotangents, and the image metrics of the evaluation.

Colors are float32 RGB in 0..1 [H, W, 3], depths float32 meters [H, W] with 0 = not measured. The rasterizer's
depth is blended, D = sum(w z), and its alpha is A = sum(w); the depth residual used here is D - A z_measured: the
blended depth against the measured one weighted by the opacity. It is zero exactly when D / A is the measured depth,
has no division by a small A, and its gradient neither rewards nor punishes opacity as such.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.training import LossConfig

Image = NDArray[np.float32]


class Rendered(Protocol):
    """What the rasterizer returns: color [H, W, 3], depth [H, W] = sum(w z), alpha [H, W] = sum(w)."""

    @property
    def color(self) -> Image: ...
    @property
    def depth(self) -> Image: ...
    @property
    def alpha(self) -> Image: ...


@dataclass(frozen=True)
class Loss:
    """A loss value and its derivatives with respect to the rendered images and to the exposure (a, b)."""

    value: float
    color: float
    depth: float
    d_color: Image
    d_depth: Image
    d_alpha: Image
    d_exposure: tuple[float, float]


def huber(residual: Image, delta: float) -> tuple[Image, Image]:
    """Huber loss with unit slope in the tail, and its derivative; delta in the unit of the residual.

    value = r^2 / (2 delta) for |r| < delta, else |r| - delta / 2; derivative = clip(r / delta, -1, 1).
    delta -> 0 is the L1 loss of the paper's front end.
    """
    slope = np.clip(residual * (1.0 / delta), -1.0, 1.0)
    return slope * (residual - (0.5 * delta) * slope), slope


def rgbd_loss(
    render: Rendered,
    color: Image,
    depth_m: Image,
    config: LossConfig,
    exposure: tuple[float, float] = (0.0, 0.0),
    mask: NDArray[np.bool_] | None = None,
    certainty: Image | None = None,
) -> Loss:
    """Robust color and depth loss of one view.

    Args:
        render: what the rasterizer drew.
        color: measured color, compared with exp(a) * rendered + b.
        depth_m: measured depth, 0 where there is none.
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


def depth_certainty(depth_sigma_m: Image, huber_m: float) -> Image:
    """Factor [H, W] of depth residuals with a standard deviation [H, W] each: min(1, huber_m / sigma), 1 where unknown.

    Up to the Huber width a residual counts in meters, as without a sigma; a less certain one in units of its sigma,
    so that it turns linear where that many sigmas are.
    """
    least = np.maximum(depth_sigma_m, np.float32(huber_m))
    return np.asarray(np.float32(huber_m) / least, dtype=np.float32)


def psnr(rendered: NDArray, reference: NDArray, mask: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio in dB of colors in 0..1, the render clipped to that range first.

    mask [H, W] selects the pixels that count. Equal images give infinity.
    """
    error = np.clip(np.asarray(rendered, np.float64), 0.0, 1.0) - np.asarray(reference, np.float64)
    if mask is not None:
        error = error[mask]
    mse = float(np.mean(error * error))
    return float("inf") if mse == 0 else float(-10.0 * np.log10(mse))


_WINDOW_RADIUS = 5
_WINDOW_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2
MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


def _window_mean(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """11x11 Gaussian-weighted mean (sigma 1.5), only where the window lies inside the image."""
    import cv2

    weights = cv2.getGaussianKernel(2 * _WINDOW_RADIUS + 1, _WINDOW_SIGMA, cv2.CV_64F)
    smooth = cv2.sepFilter2D(image, cv2.CV_64F, weights, weights)
    inside = slice(_WINDOW_RADIUS, -_WINDOW_RADIUS)
    return np.asarray(smooth[inside, inside])


def _ssim_terms(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Mean SSIM and mean contrast-structure term of two images [H, W, C] in 0..1."""
    if min(x.shape[:2]) < 2 * _WINDOW_RADIUS + 1:
        raise ValueError(f"an image of {x.shape[1]}x{x.shape[0]} is smaller than the 11x11 window of SSIM")
    mx, my = _window_mean(x), _window_mean(y)
    vx, vy = _window_mean(x * x) - mx * mx, _window_mean(y * y) - my * my
    cov = _window_mean(x * y) - mx * my
    structure = (2 * cov + _C2) / (vx + vy + _C2)
    luminance = (2 * mx * my + _C1) / (mx * mx + my * my + _C1)
    return float(np.mean(luminance * structure)), float(np.mean(structure))


def _clipped(rendered: NDArray, reference: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = np.clip(np.asarray(rendered, np.float64), 0.0, 1.0), np.asarray(reference, np.float64)
    if x.shape != y.shape:
        raise ValueError(f"images of different shapes: {x.shape} and {y.shape}")
    return x, y


def ssim(rendered: NDArray, reference: NDArray) -> float:
    """Single-scale SSIM of colors [H, W, 3] in 0..1, the mean over channels and window positions.

    11x11 Gaussian window of sigma 1.5, K1 = 0.01, K2 = 0.03, no padding. Source: Wang, Bovik, Sheikh,
    Simoncelli, IEEE TIP 2004.
    """
    return _ssim_terms(*_clipped(rendered, reference))[0]


def ms_ssim(rendered: NDArray, reference: NDArray, weights: Sequence[float] = MS_SSIM_WEIGHTS) -> float:
    """Multi-scale SSIM: a different number from `ssim`, and usually a higher one; never give it under that name.

    Five scales (2x2 means between them), so both sides of the image must be at least 176 pixels. Negative
    contrast-structure terms count as zero. Source: Wang, Simoncelli, Bovik, Asilomar 2003.
    """
    x, y = _clipped(rendered, reference)
    smallest = (2 * _WINDOW_RADIUS + 1) << (len(weights) - 1)
    if min(x.shape[:2]) < smallest:
        raise ValueError(
            f"MS-SSIM of {len(weights)} scales needs {smallest} pixels, found {x.shape[1]}x{x.shape[0]}"
        )
    product = 1.0
    for scale, weight in enumerate(weights):
        whole, structure = _ssim_terms(x, y)
        last = scale == len(weights) - 1
        product *= max(whole if last else structure, 0.0) ** weight
        x, y = halve(x), halve(y)
    return product


def halve(image: NDArray) -> NDArray:
    """Means of the 2x2 blocks of an image [H, W, ...]; a last odd row or column is cut."""
    h, w = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    top, bottom = image[0:h:2, :w], image[1:h:2, :w]
    quarter = image.dtype.type(0.25)
    return quarter * (top[:, 0::2] + top[:, 1::2] + bottom[:, 0::2] + bottom[:, 1::2])


def depth_error(render: Rendered, depth_m: Image, min_alpha: float = 0.5) -> tuple[float, float]:
    """Depth L1 in meters over measured pixels that the map covers, and the share that it covers.

    The rendered depth is normalized, D / A, and counts where A >= min_alpha. NaN if nothing is covered.
    """
    measured = depth_m > 0
    covered = measured & (render.alpha >= min_alpha)
    count = int(np.count_nonzero(covered))
    completeness = count / max(int(np.count_nonzero(measured)), 1)
    if count == 0:
        return float("nan"), completeness
    error = np.abs(render.depth[covered] / render.alpha[covered] - depth_m[covered])
    return float(np.mean(error, dtype=np.float64)), completeness
