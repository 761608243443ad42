"""What is computed row by row, in blocks: what it needs meanwhile is bounded, however many rows there are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROWS = 1 << 16
"""Of a block: matrices of as many take tens of megabytes."""


def row_blocks(rows: int) -> Iterator[slice]:
    """Slices that cover rows, in order.

    Args:
        rows: how many there are.
    """
    for start in range(0, rows, ROWS):
        yield slice(start, min(start + ROWS, rows))


def in_blocks(compute: Callable[..., NDArray[Any]], *arrays: NDArray[Any]) -> NDArray[Any]:
    """The rows that a function gives of each row of some arrays by itself.

    Args:
        compute: gives as many rows as it gets.
        arrays: as many rows each.
    """
    rows = len(arrays[0])
    if rows <= ROWS:
        return compute(*arrays)
    out: NDArray[Any] | None = None
    for block in row_blocks(rows):
        part = compute(*(array[block] for array in arrays))
        if out is None:
            out = np.empty((rows, *part.shape[1:]), part.dtype)
        out[block] = part
    assert out is not None  # there are rows
    return out
