"""Standard deviations of depth as the images of a log hold them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SIGMA_SCALE_M = 1e-4  # of the images of standard deviations


def sigma_units(sigma_m: NDArray[np.floating], depth: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Standard deviations in units of the log, 0 where there is no depth or none is known.

    They are kept to 3 %, and from 0.1 mm to 6.5 m: five binary digits say all that a sigma can, and take a third of
    the space.

    Args:
        sigma_m: [H, W], meters.
        depth: [H, W], 0 = none.
    """
    is_known = (depth > 0) & (np.asarray(sigma_m) > 0)
    most = np.iinfo(np.uint16).max
    units = np.clip(np.rint(np.asarray(sigma_m, dtype=np.float64) / SIGMA_SCALE_M), 1, most)
    step = 2.0 ** np.maximum(np.frexp(units)[1] - 5, 0)
    return np.where(is_known, np.minimum(np.rint(units / step) * step, most), 0).astype(np.uint16)
