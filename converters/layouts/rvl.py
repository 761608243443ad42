"""RVL (Wilson 2017), a lossless code of depth images: runs of zeros and of differences, in nibbles of three bits."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray


def decoded_rvl(body: bytes) -> NDArray[np.uint16] | None:
    """A depth image [h, w], in the units it was encoded in; None if it is broken.

    Args:
        body: encoded, columns and rows in front.
    """
    if len(body) < 8:
        return None
    columns, rows = struct.unpack("<II", body[:8])
    if not 0 < columns * rows <= 1 << 26:
        return None
    words = np.frombuffer(body[8 : 8 + (len(body) - 8) // 4 * 4], "<u4")
    shifts = np.arange(28, -4, -4, dtype=np.uint32)
    nibbles = ((words[:, None] >> shifts) & 15).ravel().astype(np.int64)  # the highest nibble comes first
    ends = np.flatnonzero(nibbles < 8)
    if not len(ends):
        return None
    starts = np.concatenate([[0], ends[:-1] + 1])
    nibbles = nibbles[: ends[-1] + 1]
    place = np.arange(len(nibbles)) - np.repeat(starts, ends - starts + 1)
    if place.max() > 10:
        return None
    numbers = np.add.reduceat((nibbles & 7) << (3 * place), starts)
    out = np.zeros(columns * rows, np.int64)
    at = position = previous = 0
    while position < len(out):
        if at + 1 >= len(numbers):
            return None
        zeros, count = int(numbers[at]), int(numbers[at + 1])
        at += 2
        position += zeros
        if position + count > len(out) or at + count > len(numbers):
            return None
        coded = numbers[at : at + count]
        steps = (coded >> 1) ^ -(coded & 1)
        values = previous + np.cumsum(steps)
        out[position : position + count] = values
        previous = int(values[-1]) if count else previous
        at, position = at + count, position + count
    if out.min(initial=0) < 0 or out.max(initial=0) > 65535:
        return None
    return out.reshape(rows, columns).astype(np.uint16)
