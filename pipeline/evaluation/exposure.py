"""PSNR with the exposure of a view fitted: each half of the image in the exposure that was fitted on the other half.

A camera that sets its own exposure shows a surface brighter in one image than in the next, and PSNR counts that as an
error of the map. Here gain and offset of each channel are fitted between render and image on one half and applied to
the render of the other half, which alone is scored. So nothing is scored on pixels that it was fitted to.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.evaluation.image_metrics import decibels
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry import masks
from duagc.pipeline.geometry.statistics import huber_divisor, mad_sigma
from duagc.pipeline.splat.losses import Rendered

Array = NDArray[np.float64]
Image = NDArray[np.float32]
MIN_ALPHA = 0.5
"""Opacity from which on a pixel of the render takes part in the fit."""
MIN_PIXELS = 100
"""Pixels of a channel that a fit needs."""
MOST_PIXELS = 10_000
"""A fit uses no more than about so many, evenly spaced."""
ROUNDS = 5
"""Of reweighting."""
HUBER_SIGMAS = 1.345
"""Residuals beyond count linearly (Huber 1964: 95 % of the efficiency of least squares)."""
PRIOR_SPREAD = 0.01
"""Standard deviation of the rendered colors (0..1) below which the gain stays nearer to one than to its fit."""
CLIPPED = (1.5 / 255, 253.5 / 255)
"""Colors of the image beyond are black or saturated, and tell nothing of the gain."""


@dataclass(frozen=True)
class FittedPsnr:
    """PSNR of the halves of a view, dB, each in the exposure fitted on the other half; infinite if equal.

    Attributes:
        left: of the left half.
        right: of the right half.
        both: of both halves together.
    """

    left: float
    right: float
    both: float


def fit_exposure(drawn: Array, image: Array) -> tuple[float, float] | Absent:
    """Gain and offset of one channel, by robust least squares: image = gain * drawn + offset.

    Args:
        drawn: rendered colors [n].
        image: colors [n] in 0..1 of the same pixels; clipped ones are left out.

    Returns:
        Gain and offset, or why there are none.
    """
    usable = (image >= CLIPPED[0]) & (image <= CLIPPED[1])
    count = int(np.count_nonzero(usable))
    if count < MIN_PIXELS:
        return Absent(
            f"an exposure needs {MIN_PIXELS} pixels of a half that are neither uncovered, black nor white"
        )
    x, y = drawn[usable], image[usable]
    weight: NDArray[np.floating] = np.ones_like(x)
    gain, offset = 1.0, 0.0
    for done in range(1, ROUNDS + 1):
        total = float(weight.sum())
        middle_x, middle_y = float(weight @ x) / total, float(weight @ y) / total
        dx, dy = x - middle_x, y - middle_y
        spread = PRIOR_SPREAD**2 * total
        gain = (float(weight @ (dx * dy)) + spread) / (float(weight @ (dx * dx)) + spread)
        offset = middle_y - gain * middle_x
        if done == ROUNDS:
            break
        residual = y - gain * x - offset
        weight = 1.0 / huber_divisor(residual, HUBER_SIGMAS * mad_sigma(residual) + 1e-6)
    return gain, offset


def fitted_psnr(
    render: Rendered,
    image: Array,
    valid: NDArray[np.bool_] | None = None,
    *,
    color: Image | None = None,
    seen: Image | None = None,
) -> FittedPsnr | Absent:
    """PSNR of each half of a view in the exposure that was fitted on the other half.

    The exposure changes what the map shows, not the black background behind it.

    Args:
        render: of the map, on black.
        image: colors [h, w, 3] in 0..1.
        valid: bool [h, w], pixels that are fitted and scored; None: all.
        color: `planes` of the render, where more is done with them; None: made here.
        seen: `planes` of the image, where several renders are compared with it; None: made here.

    Returns:
        The scores, or why there are none.
    """
    height, width = image.shape[:2]
    counted = np.ones((height, width), dtype=bool) if valid is None else valid
    covered = counted & (render.alpha >= MIN_ALPHA)
    whole = bool(counted.all())
    halves = (slice(0, width // 2), slice(width // 2, width))
    color = planes(render.color) if color is None else color
    seen = planes(image) if seen is None else seen
    sums, counts = [], []
    for scored, other in (halves, halves[::-1]):
        squares = _squared_errors((color, render.alpha, seen), scored, other, covered=covered)
        if isinstance(squares, Absent):
            return squares
        pixels = counted[:, scored]
        sums.append(float(np.sum(squares, dtype=np.float64)) if whole else masks.total(squares, pixels))
        counts.append(len(squares) * int(np.count_nonzero(pixels)))
    if not all(counts):
        return Absent("half of the image has no valid pixel")
    left, right = (decibels(total / count) for total, count in zip(sums, counts, strict=True))
    return FittedPsnr(left, right, decibels(sum(sums) / sum(counts)))


def _squared_errors(
    images: tuple[Image, Image, Image], scored: slice, fitted: slice, *, covered: NDArray[np.bool_]
) -> Image | Absent:
    """Squared errors [3, h, w'] of the scored columns in the exposure of the fitted columns.

    Args:
        images: rendered colors [3, h, w] and opacity [h, w], and the colors of the image [3, h, w].
        scored: columns.
        fitted: columns.
        covered: bool [h, w], pixels that may be fitted.
    """
    color, alpha, image = images
    grid = _grid(covered[:, fitted].size)
    used = covered[:, fitted][grid]
    squares = np.empty_like(image[:, :, scored])
    for drawn, seen, error in zip(color, image, squares, strict=True):
        found = fit_exposure(*(plane[:, fitted][grid][used].astype(np.float64) for plane in (drawn, seen)))
        if isinstance(found, Absent):
            return found
        gain, offset = found
        np.multiply(drawn[:, scored], np.float32(gain), out=error)
        error += np.float32(offset) * alpha[:, scored]
        np.clip(error, 0, 1, out=error)
        error -= seen[:, scored]
        error *= error
    return squares


def planes(colors: NDArray[np.floating]) -> Image:
    """Colors [h, w, 3] as [3, h, w]: arithmetic on every third number is slow.

    Args:
        colors: of any floating type.
    """
    return np.ascontiguousarray(colors.transpose(2, 0, 1), dtype=np.float32)


def _grid(pixels: int) -> tuple[slice, slice]:
    """Rows and columns of about `MOST_PIXELS` pixels, evenly spread in an image of so many."""
    stride = max(1, round(float(np.sqrt(pixels / MOST_PIXELS))))
    return np.s_[stride // 2 :: stride, stride // 2 :: stride]
