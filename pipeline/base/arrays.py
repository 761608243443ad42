"""Names of array types that many modules use, bytes of arrays, the rows that an index means, and those not finite."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array: TypeAlias = NDArray[np.float64]
"""Double precision, any shape; the docstring of every parameter gives the shape."""


def array_bytes(values: Any, dtype: str) -> bytes:
    """Little-endian bytes in C order.

    Args:
        values: of any shape.
        dtype: as numpy names it, for example "float32".
    """
    return np.ascontiguousarray(values, dtype=np.dtype(dtype).newbyteorder("<")).tobytes()


def rows_of(index: ArrayLike) -> NDArray[np.int64]:
    """Rows for `take`, which is several times as fast as an index in brackets.

    Args:
        index: mask [n], or rows.
    """
    rows = np.asarray(index)
    return np.flatnonzero(rows) if rows.dtype == np.bool_ else rows


def rows_not_finite(values: ArrayLike) -> NDArray[np.int64]:
    """Rows that have a number that is not finite, ascending.

    Args:
        values: [n, ...], any unit.
    """
    finite = np.isfinite(values)
    return np.flatnonzero(~finite.all(axis=tuple(range(1, finite.ndim))))
