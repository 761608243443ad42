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
from duagc.pipeline.geometry.statistics import huber_divisor, mad_sigma
from duagc.pipeline.kernels.squared_error import squared_error
from duagc.pipeline.kernels.squared_error_definition import ExposedRender
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
    render: Rendered, image: Image, valid: NDArray[np.bool_] | None = None
) -> FittedPsnr | Absent:
    """PSNR of each half of a view in the exposure that was fitted on the other half.

    The exposure changes what the map shows, not the black background behind it.

    Args:
        render: of the map, on black.
        image: colors [h, w, 3] in 0..1.
        valid: bool [h, w], pixels that are fitted and scored; None: all.

    Returns:
        The scores, or why there are none.
    """
    height, width = image.shape[:2]
    covered = render.alpha >= MIN_ALPHA if valid is None else valid & (render.alpha >= MIN_ALPHA)
    halves = (slice(0, width // 2), slice(width // 2, width))
    sums, counts = [], []
    for scored, other in (halves, halves[::-1]):
        found = _fitted_on(render, image, other, covered=covered)
        if isinstance(found, Absent):
            return found
        sums.append(squared_error(found, image, valid, scored))
        pixels = (
            height * (scored.stop - scored.start) if valid is None else np.count_nonzero(valid[:, scored])
        )
        counts.append(image.shape[2] * int(pixels))
    if not all(counts):
        return Absent("half of the image has no valid pixel")
    left, right = (decibels(total / count) for total, count in zip(sums, counts, strict=True))
    return FittedPsnr(left, right, decibels(sum(sums) / sum(counts)))


def _fitted_on(
    render: Rendered, image: Image, columns: slice, *, covered: NDArray[np.bool_]
) -> ExposedRender | Absent:
    """The render in the exposure that is fitted on some columns, where they are covered."""
    grid = _grid(covered[:, columns].size)
    used = covered[:, columns][grid]
    drawn, seen = (colors[:, columns][grid][used].astype(np.float64) for colors in (render.color, image))
    exposure = []
    for of_channel in zip(drawn.T, seen.T, strict=True):
        found = fit_exposure(*(np.ascontiguousarray(values) for values in of_channel))
        if isinstance(found, Absent):
            return found
        exposure.append(found)
    gain, offset = np.array(exposure, np.float32).T
    return ExposedRender(render.color, render.alpha, gain, offset)


def _grid(pixels: int) -> tuple[slice, slice]:
    """Rows and columns of about `MOST_PIXELS` pixels, evenly spread in an image of so many."""
    stride = max(1, round(float(np.sqrt(pixels / MOST_PIXELS))))
    return np.s_[stride // 2 :: stride, stride // 2 :: stride]
