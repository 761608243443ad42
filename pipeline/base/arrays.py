"""Names of array types that many modules use, and the rows that an index means."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array: TypeAlias = NDArray[np.float64]
"""Double precision, any shape; the docstring of every parameter gives the shape."""


def rows_of(index: ArrayLike) -> NDArray[np.int64]:
    """Rows for `take`, which is several times as fast as an index in brackets.

    Args:
        index: mask [n], or rows.
    """
    rows = np.asarray(index)
    return np.flatnonzero(rows) if rows.dtype == np.bool_ else rows
