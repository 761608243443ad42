"""Inverse depth, and depth by it: 0 stands for unknown in both."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def inverse_or_zero(values: NDArray[Any]) -> NDArray[Any]:
    """One over each value, 0 where it is unknown; of the same type.

    Args:
        values: of any shape, floats; 0 or less = unknown.
    """
    known, one = values > 0, values.dtype.type(1)
    return np.where(known, one / np.where(known, values, one), values.dtype.type(0))
