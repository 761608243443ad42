"""How close a render is to an image: PSNR, SSIM, MS-SSIM and depth error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry import masks
from duagc.pipeline.kernels.squared_error import squared_error
from duagc.pipeline.kernels.squared_error_definition import ExposedRender
from duagc.pipeline.kernels.window_terms import window_means, window_terms
from duagc.pipeline.kernels.window_terms_definition import WINDOW_RADIUS, SeenWindows
from duagc.pipeline.splat.losses import Rendered, halve

Image = NDArray[np.float32]
NEITHER = np.ones(3, np.float32), np.zeros(3, np.float32)
"""Gain and offset of a render in the exposure that it was drawn in."""


def psnr(rendered: NDArray, reference: NDArray, mask: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio in dB; equal images give infinity.

    Args:
        rendered: colors [H, W, 3], clipped to 0..1 first.
        reference: colors [H, W, 3] in 0..1.
        mask: bool [H, W], pixels that count; None: all.
    """
    color = np.asarray(rendered, np.float32)
    as_drawn = ExposedRender(color, np.zeros(color.shape[:2], np.float32), *NEITHER)
    return psnr_in_exposure(as_drawn, np.asarray(reference, np.float32), mask)


def psnr_in_exposure(render: ExposedRender, reference: Image, mask: NDArray[np.bool_] | None = None) -> float:
    """The function `psnr` of a render in an exposure.

    Args:
        render: drawn, in its exposure.
        reference: colors [H, W, 3] in 0..1.
        mask: bool [H, W], pixels that count; None: all.
    """
    values = reference.size if mask is None else reference.shape[2] * np.count_nonzero(mask)
    return decibels(squared_error(render, reference, mask) / values)


def decibels(mse: float) -> float:
    """PSNR in dB of colors 0..1; none is lost: infinity.

    Args:
        mse: mean square of the errors.
    """
    return float("inf") if mse == 0 else float(-10.0 * np.log10(mse))


MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


def counted_windows(mask: masks.Mask) -> masks.Mask:
    """Positions of the 11x11 window of SSIM at which it lies inside the image and touches usable pixels only.

    Args:
        mask: bool [H, W], pixels that count.
    """
    inside = slice(WINDOW_RADIUS, -WINDOW_RADIUS)
    return masks.whole_windows(mask, WINDOW_RADIUS)[inside, inside]


@dataclass(frozen=True)
class _Scale:
    """One scale of an image that renders are compared with, and what SSIM needs of it.

    `windows`: their weight is 1 at positions that count, else 0; None: all count. `mask`: pixels that count.
    """

    windows: SeenWindows
    mask: masks.Mask | None

    @staticmethod
    def of(image: Image, mask: masks.Mask | None) -> _Scale:
        mean = window_means(image)
        variance = window_means(image * image) - mean * mean
        weight = None
        if mask is not None and not (counted := counted_windows(mask)).all():
            weight = np.where(counted[..., None], np.ones_like(mean), np.float32(0))
        return _Scale(SeenWindows(image, mean, variance, weight), mask)

    @cached_property
    def count(self) -> int:
        """Windows that count, in all channels."""
        weight = self.windows.weight
        return self.windows.mean.size if weight is None else int(np.count_nonzero(weight))

    def halved(self) -> _Scale:
        """The next scale."""
        mask = None if self.mask is None else masks.halved(self.mask)
        return _Scale.of(halve(self.windows.image), mask)

    def terms(self, drawn: Image) -> tuple[float, float]:
        """Mean contrast-structure term and SSIM of a render [H, W, C] in 0..1, over the windows that count."""
        if not self.count:
            raise ValueError("no 11x11 window of SSIM has usable pixels only")
        structure, similarity = window_terms(drawn, self.windows)
        return structure / self.count, similarity / self.count


class SsimReference:
    """An image that renders are compared with by SSIM and MS-SSIM; what depends on it alone is computed once."""

    def __init__(self, reference: NDArray, mask: masks.Mask | None = None) -> None:
        """Keep the image; each of its scales is computed when it is first needed.

        Args:
            reference: colors [H, W, 3] in 0..1.
            mask: bool [H, W], pixels that count: window positions that touch another one are left out; None: all.
        """
        self._y, self._mask = np.asarray(reference, np.float32), mask
        self._scales: list[_Scale] = []

    def has_windows(self, scales: int) -> bool:
        """Whether each of so many scales has a window position that counts.

        Args:
            scales: the first ones.
        """
        if self._mask is None:
            return True
        return all(self._scale(k).count for k in range(scales))

    def ssim(self, rendered: NDArray) -> float:
        """As the function `ssim`.

        Args:
            rendered: colors [H, W, 3], clipped to 0..1 first.
        """
        return self._scale(0).terms(self._clipped(rendered))[1]

    def both(self, rendered: NDArray, weights: Sequence[float] = MS_SSIM_WEIGHTS) -> tuple[float, float]:
        """SSIM and MS-SSIM of a render, as the functions of these names.

        Args:
            rendered: colors [H, W, 3], clipped to 0..1 first.
            weights: of the scales, fine to coarse.
        """
        x = self._clipped(rendered)
        smallest = (2 * WINDOW_RADIUS + 1) << (len(weights) - 1)
        if min(x.shape[:2]) < smallest:
            raise ValueError(
                f"MS-SSIM of {len(weights)} scales needs {smallest} pixels, found {x.shape[1]}x{x.shape[0]}"
            )
        first, product = 0.0, 1.0
        last = len(weights) - 1
        for k, weight in enumerate(weights):
            structure, whole = self._scale(k).terms(x)
            first = first if k else whole
            product *= max(whole if k == last else structure, 0.0) ** weight
            x = halve(x) if k < last else x
        return first, product

    def _clipped(self, rendered: NDArray) -> Image:
        x = np.clip(np.asarray(rendered, np.float32), 0.0, 1.0)
        if x.shape != self._y.shape:
            raise ValueError(f"images of different shapes: {x.shape} and {self._y.shape}")
        return x

    def _scale(self, k: int) -> _Scale:
        if not self._scales:
            self._scales.append(_Scale.of(self._y, self._mask))
        while len(self._scales) <= k:
            self._scales.append(self._scales[-1].halved())
        return self._scales[k]


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
    return SsimReference(reference, mask).ssim(rendered)


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
    return SsimReference(reference, mask).both(rendered, weights)[1]


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
    error = render.depth / np.maximum(render.alpha, np.float32(min_alpha))
    error -= depth_m
    return masks.total(np.abs(error, out=error), covered) / count, completeness
