"""Squared errors of drawn images: a compiled pass behind checked numpy arrays.

`kernels.squared_error_definition` defines what it computes, to the bit, on every instruction set.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.kernels import _raster
from duagc.pipeline.kernels.arguments import checked_mask, floats_of
from duagc.pipeline.kernels.squared_error_definition import ExposedRender
from duagc.pipeline.kernels.window_terms_definition import Image

ALL_PIXELS: NDArray[np.uint8] = np.empty((0, 0), np.uint8)


def squared_error(
    render: ExposedRender,
    seen: Image,
    mask: NDArray[np.bool_] | None = None,
    columns: slice = slice(None),
    *,
    isa: str = "auto",
) -> float:
    """`kernels.squared_error_definition.squared_error`.

    Args:
        render: drawn, in its exposure.
        seen: [h, w, 3].
        mask: [h, w], pixels that count; None: all.
        columns: of both images; all by default.
        isa: instruction set, as of `Rasterizer`.
    Raises:
        ValueError: shapes that do not belong together, or columns with a step.
    """
    if seen.ndim != 3 or seen.shape[2] != 3:
        raise ValueError(f"seen has shape {seen.shape}, expected (h, w, 3)")
    left, right, step = columns.indices(seen.shape[1])
    if step != 1:
        raise ValueError(f"columns have a step of {step}, expected 1")
    drawn = floats_of("color", render.color, seen.shape)
    alpha = floats_of("alpha", render.alpha, seen.shape[:2])
    exposure = [floats_of(name, getattr(render, name), (3,)) for name in ("gain", "offset")]
    counted = ALL_PIXELS if mask is None else checked_mask(mask, seen.shape[:2])
    images = (drawn, alpha, floats_of("seen", seen, seen.shape), counted)
    return _raster.squared_error(isa, *images, np.concatenate(exposure), left, max(left, right))
