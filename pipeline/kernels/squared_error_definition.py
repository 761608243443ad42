"""What the compiled pass of `kernels.squared_error` computes, in numpy, to be read and to test against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.kernels.window_terms_definition import LANES, Image

PIXELS_AT_A_TIME = 256
"""Of a row: the order of sums."""


@dataclass(frozen=True)
class ExposedRender:
    """A drawn image, and the exposure that it is seen in: gain * color + offset * alpha, clipped to 0..1.

    Attributes:
        color: [h, w, 3], on black.
        alpha: [h, w].
        gain: [3].
        offset: [3].
    """

    color: Image
    alpha: Image
    gain: Image
    offset: Image


def squared_error(
    render: ExposedRender, seen: Image, mask: NDArray[np.bool_] | None, columns: slice
) -> float:
    """Sum of the squared differences of a drawn image and another one.

    Args:
        render: drawn, in its exposure.
        seen: [h, w, 3].
        mask: [h, w], pixels that count; None: all.
        columns: of both images, from start to stop.
    """
    color = render.gain * render.color + render.offset * render.alpha[..., None]
    error = np.clip(color, np.float32(0), np.float32(1)) - seen
    squares = error * error if mask is None else error * error * mask[..., None].astype(np.float32)
    lanes = np.zeros(LANES)
    for row in squares:
        for left in range(columns.start, columns.stop, PIXELS_AT_A_TIME):
            values = row[left : min(left + PIXELS_AT_A_TIME, columns.stop)].ravel().astype(np.float64)
            for block in np.pad(values, (0, -len(values) % LANES)).reshape(-1, LANES):
                lanes = lanes + block
    return float(np.cumsum(lanes)[-1])
