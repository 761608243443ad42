"""How close a render is to an image: PSNR, SSIM, MS-SSIM and depth error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

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
    drawn, seen = (np.moveaxis(np.asarray(colors), -1, 0) for colors in (rendered, reference))
    return psnr_of_planes(drawn, seen, mask)


def psnr_of_planes(
    rendered: NDArray[np.floating], reference: NDArray[np.floating], mask: NDArray[np.bool_] | None = None
) -> float:
    """The function `psnr` of colors by channel, which is faster.

    Args:
        rendered: colors [3, H, W], clipped to 0..1 first.
        reference: colors [3, H, W] in 0..1.
        mask: bool [H, W], pixels that count; None: all.
    """
    error = np.clip(rendered, 0, 1) - reference
    squares = np.square(error, out=error)
    if mask is None or mask.all():
        return decibels(float(np.mean(squares, dtype=np.float64)))
    return decibels(masks.total(squares, mask) / (len(squares) * np.count_nonzero(mask)))


def decibels(mse: float) -> float:
    """PSNR in dB of colors 0..1; none is lost: infinity.

    Args:
        mse: mean square of the errors.
    """
    return float("inf") if mse == 0 else float(-10.0 * np.log10(mse))


_WINDOW_RADIUS = 5
_WINDOW_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2
MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


@cache
def _window() -> Image:
    """Weights of a row of the window."""
    import cv2

    return np.asarray(cv2.getGaussianKernel(2 * _WINDOW_RADIUS + 1, _WINDOW_SIGMA, cv2.CV_32F))


def _window_mean(image: Image) -> Image:
    """11x11 Gaussian-weighted mean (sigma 1.5), only where the window lies inside the image."""
    import cv2

    smooth = cv2.sepFilter2D(image, cv2.CV_32F, _window(), _window())
    inside = slice(_WINDOW_RADIUS, -_WINDOW_RADIUS)
    return np.asarray(smooth[inside, inside])


def counted_windows(mask: masks.Mask) -> masks.Mask:
    """Positions of the 11x11 window of SSIM at which it lies inside the image and touches usable pixels only.

    Args:
        mask: bool [H, W], pixels that count.
    """
    inside = slice(_WINDOW_RADIUS, -_WINDOW_RADIUS)
    return masks.whole_windows(mask, _WINDOW_RADIUS)[inside, inside]


_STRIP_ROWS = 32  # of windows at a time: what is computed of them stays in the cache


@dataclass(frozen=True)
class _Scale:
    """One scale of an image that renders are compared with, and what SSIM needs of it, [H, W, C].

    `y`: colors. `twice`: 2 y. `mean`, `mean2`, `variance`: 2 means, squares of means and variances of windows.
    `weight`: 1 at window positions that count, else 0; None: all count.
    """

    y: Image
    twice: Image
    mean: Image
    mean2: Image
    variance: Image
    mask: masks.Mask | None
    weight: Image | None

    @staticmethod
    def of(y: Image, mask: masks.Mask | None) -> _Scale:
        if min(y.shape[:2]) < 2 * _WINDOW_RADIUS + 1:
            raise ValueError(
                f"an image of {y.shape[1]}x{y.shape[0]} is smaller than the 11x11 window of SSIM"
            )
        mean = _window_mean(y)
        mean2 = mean * mean
        variance = _window_mean(y * y) - mean2
        weight = None
        if mask is not None and not (counted := counted_windows(mask)).all():
            weight = np.where(counted[..., None], np.ones_like(mean), np.float32(0))
        return _Scale(y, twice=2 * y, mean=2 * mean, mean2=mean2, variance=variance, mask=mask, weight=weight)

    @cached_property
    def count(self) -> int:
        """Windows that count, in all channels."""
        return self.mean.size if self.weight is None else int(np.count_nonzero(self.weight))

    def halved(self) -> _Scale:
        """The next scale."""
        return _Scale.of(halve(self.y), None if self.mask is None else masks.halved(self.mask))

    def terms(self, x: Image, *, whole: bool = True) -> tuple[float, float]:
        """Mean SSIM and contrast-structure term of a render [H, W, C] in 0..1; without `whole` the latter twice."""
        images = [np.empty_like(self.mean) for _ in range(1 + whole)]
        for top in range(0, len(self.mean), _STRIP_ROWS):
            rows = slice(top, top + _STRIP_ROWS)
            seen = slice(top, top + _STRIP_ROWS + 2 * _WINDOW_RADIUS)
            self._strip(x[seen], self.twice[seen], rows, images)
        means = [self._mean(image) for image in images]
        return means[-1], means[0]

    def _mean(self, image: Image) -> float:
        """Mean of what windows say, over those that count."""
        if self.weight is None:
            return float(np.mean(image, dtype=np.float64))
        if not self.count:
            raise ValueError("no 11x11 window of SSIM has usable pixels only")
        return float(np.sum(image * self.weight, dtype=np.float64)) / self.count

    def _strip(self, x: Image, twice: Image, rows: slice, images: Sequence[Image]) -> None:
        """Contrast-structure term of some rows of windows, from the pixels that they see, and SSIM if it has an image.

        (2 cov + C2) / (vx + vy + C2), and this times (2 mx my + C1) / (mx^2 + my^2 + C1).
        """
        mx = _window_mean(x)
        mx2, mxy = mx * mx, mx * self.mean[rows]
        below = _window_mean(x * x)
        below -= mx2
        below += self.variance[rows]
        below += _C2
        above = _window_mean(x * twice)
        above -= mxy
        above += _C2
        structure = np.divide(above, below, out=images[0][rows])
        if len(images) == 1:
            return
        mxy += _C1
        mx2 += self.mean2[rows]
        mx2 += _C1
        mxy /= mx2
        np.multiply(mxy, structure, out=images[1][rows])


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
        return self._scale(0).terms(self._clipped(rendered))[0]

    def both(self, rendered: NDArray, weights: Sequence[float] = MS_SSIM_WEIGHTS) -> tuple[float, float]:
        """SSIM and MS-SSIM of a render, as the functions of these names.

        Args:
            rendered: colors [H, W, 3], clipped to 0..1 first.
            weights: of the scales, fine to coarse.
        """
        x = self._clipped(rendered)
        smallest = (2 * _WINDOW_RADIUS + 1) << (len(weights) - 1)
        if min(x.shape[:2]) < smallest:
            raise ValueError(
                f"MS-SSIM of {len(weights)} scales needs {smallest} pixels, found {x.shape[1]}x{x.shape[0]}"
            )
        first, product = 0.0, 1.0
        last = len(weights) - 1
        for k, weight in enumerate(weights):
            whole, structure = self._scale(k).terms(x, whole=k in (0, last))
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
