"""What SSIM says of windows of images: compiled passes behind checked numpy arrays.

`kernels.window_terms_definition` defines what they compute, to the bit, on every instruction set.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.kernels import _raster
from duagc.pipeline.kernels.arguments import floats_of
from duagc.pipeline.kernels.window_terms_definition import WINDOW_RADIUS, Image, SeenWindows, half_window

ALL_ALIKE: Image = np.empty((0, 0, 0), np.float32)


def window_means(image: NDArray[np.floating], *, isa: str = "auto") -> Image:
    """`kernels.window_terms_definition.window_means`.

    Args:
        image: [h, w, c].
        isa: instruction set, as of `Rasterizer`.
    Raises:
        ValueError: no window lies inside the image.
    """
    means = np.empty(_windows(image), np.float32)
    _raster.window_means(isa, floats_of("image", image, image.shape), half_window(), means)
    return means


def window_terms(drawn: NDArray[np.floating], seen: SeenWindows, *, isa: str = "auto") -> tuple[float, float]:
    """`kernels.window_terms_definition.window_terms`.

    Args:
        drawn: [h, w, c] in 0..1.
        seen: the image that it is compared with.
        isa: instruction set, as of `Rasterizer`.
    Raises:
        ValueError: shapes that do not belong together, or no window lies inside the image.
    """
    shape, windows = seen.image.shape, _windows(seen.image)
    images = (floats_of("drawn", drawn, shape), floats_of("seen", seen.image, shape))
    weight = ALL_ALIKE if seen.weight is None else floats_of("weight", seen.weight, windows)
    of_windows = (
        floats_of("mean", seen.mean, windows),
        floats_of("variance", seen.variance, windows),
        weight,
    )
    sums = np.zeros(2)
    _raster.window_terms(isa, *images, *of_windows, half_window(), sums)
    return float(sums[0]), float(sums[1])


def _windows(image: NDArray[np.floating]) -> tuple[int, int, int]:
    """Shape of what is said of the windows of an image."""
    if image.ndim != 3 or min(image.shape[:2]) <= 2 * WINDOW_RADIUS or not image.shape[2]:
        raise ValueError(f"an image of shape {image.shape} has no window of 11x11 pixels, expected (h, w, c)")
    height, width, channels = image.shape
    return height - 2 * WINDOW_RADIUS, width - 2 * WINDOW_RADIUS, channels
