"""How close a render is to an image: PSNR, SSIM, MS-SSIM and depth error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry import masks
from duagc.pipeline.splat.losses import Rendered, halve

Image = NDArray[np.float32]


def psnr(rendered: NDArray, reference: NDArray, mask: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio in dB; equal images give infinity.

    Args:
        rendered: colors [H, W, 3], clipped to 0..1 first.
        reference: colors [H, W, 3] in 0..1.
        mask: bool [H, W], pixels that count; None: all.
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


def counted_windows(mask: masks.Mask) -> masks.Mask:
    """Positions of the 11x11 window of SSIM at which it lies inside the image and touches usable pixels only.

    Args:
        mask: bool [H, W], pixels that count.
    """
    inside = slice(_WINDOW_RADIUS, -_WINDOW_RADIUS)
    return masks.whole_windows(mask, _WINDOW_RADIUS)[inside, inside]


def _ssim_terms(
    x: NDArray[np.float64], y: NDArray[np.float64], mask: masks.Mask | None
) -> tuple[float, float]:
    """Mean SSIM and mean contrast-structure term of two images [H, W, C] in 0..1."""
    if min(x.shape[:2]) < 2 * _WINDOW_RADIUS + 1:
        raise ValueError(f"an image of {x.shape[1]}x{x.shape[0]} is smaller than the 11x11 window of SSIM")
    mx, my = _window_mean(x), _window_mean(y)
    vx, vy = _window_mean(x * x) - mx * mx, _window_mean(y * y) - my * my
    cov = _window_mean(x * y) - mx * my
    structure = (2 * cov + _C2) / (vx + vy + _C2)
    luminance = (2 * mx * my + _C1) / (mx * mx + my * my + _C1)
    if mask is not None:
        counted = counted_windows(mask)
        if not counted.any():
            raise ValueError("no 11x11 window of SSIM has usable pixels only")
        luminance, structure = luminance[counted], structure[counted]
    return float(np.mean(luminance * structure)), float(np.mean(structure))


def _clipped(rendered: NDArray, reference: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = np.clip(np.asarray(rendered, np.float64), 0.0, 1.0), np.asarray(reference, np.float64)
    if x.shape != y.shape:
        raise ValueError(f"images of different shapes: {x.shape} and {y.shape}")
    return x, y


def ssim(rendered: NDArray, reference: NDArray, mask: masks.Mask | None = None) -> float:
    """Single-scale SSIM of colors [H, W, 3] in 0..1, the mean over channels and window positions.

    11x11 Gaussian window of sigma 1.5, K1 = 0.01, K2 = 0.03, no padding.

    Args:
        rendered: colors [H, W, 3], clipped to 0..1 first.
        reference: colors [H, W, 3] in 0..1.
        mask: bool [H, W], pixels that count: window positions that touch another one are left out; None: all.
    Raises:
        ValueError: images of different shapes, smaller than the window, or none of its positions counts.
    Source: Wang, Bovik, Sheikh, Simoncelli, IEEE TIP 2004.
    """
    return _ssim_terms(*_clipped(rendered, reference), mask)[0]


def ms_ssim(
    rendered: NDArray,
    reference: NDArray,
    weights: Sequence[float] = MS_SSIM_WEIGHTS,
    mask: masks.Mask | None = None,
) -> float:
    """Multi-scale SSIM: a different number from `ssim`, and usually a higher one; never report it under that name.

    Five scales (2x2 means between them), so both sides of the image must be at least 176 pixels. Negative
    contrast-structure terms count as zero.

    Args:
        rendered: colors [H, W, 3], clipped to 0..1 first.
        reference: colors [H, W, 3] in 0..1.
        weights: of the scales, fine to coarse.
        mask: bool [H, W], pixels that count, as of `ssim`; a pixel of a coarser scale counts if all its parts
            do. None: all.
    Raises:
        ValueError: images of different shapes, too small for the scales, or no window position counts at one.
    Source: Wang, Simoncelli, Bovik, Asilomar 2003.
    """
    x, y = _clipped(rendered, reference)
    smallest = (2 * _WINDOW_RADIUS + 1) << (len(weights) - 1)
    if min(x.shape[:2]) < smallest:
        raise ValueError(
            f"MS-SSIM of {len(weights)} scales needs {smallest} pixels, found {x.shape[1]}x{x.shape[0]}"
        )
    product = 1.0
    for scale, weight in enumerate(weights):
        whole, structure = _ssim_terms(x, y, mask)
        last = scale == len(weights) - 1
        product *= max(whole if last else structure, 0.0) ** weight
        x, y = halve(x), halve(y)
        mask = None if mask is None else masks.halved(mask)
    return product


def depth_error(render: Rendered, depth_m: Image, min_alpha: float = 0.5) -> tuple[float, float]:
    """Depth L1 in meters over measured pixels that the map covers, and the share that it covers.

    The rendered depth is normalized, D / A. NaN if nothing is covered.

    Args:
        render: of the map.
        depth_m: measured depth [H, W], 0 where there is none.
        min_alpha: opacity from which on a pixel is covered.
    """
    measured = depth_m > 0
    covered = measured & (render.alpha >= min_alpha)
    count = int(np.count_nonzero(covered))
    completeness = count / max(int(np.count_nonzero(measured)), 1)
    if count == 0:
        return float("nan"), completeness
    error = np.abs(render.depth[covered] / render.alpha[covered] - depth_m[covered])
    return float(np.mean(error, dtype=np.float64)), completeness
