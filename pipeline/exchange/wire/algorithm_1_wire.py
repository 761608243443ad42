"""Bytes of what Algorithm 1 exchanges besides poses and the setup of a link: matches and means. Strict as the others.

Matches go from the lower-named robot, once; means of matched Gaussians in every round, in parts that are useful alone.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array, array_bytes
from duagc.pipeline.exchange.wire.reader import MAX_COORDINATE, Reader
from duagc.pipeline.network.packets import MalformedError

_COUNT = struct.Struct("<I")
_PART = struct.Struct("<IH")
_MEAN_BYTES = 12


def write_pairs(ids: NDArray[np.int64]) -> bytes:
    """Bytes of matched Gaussians.

    Args:
        ids: [n, 2], of the sender first.
    """
    return _COUNT.pack(len(ids)) + array_bytes(ids, "int64")


def read_pairs(data: bytes) -> NDArray[np.int64]:
    """From `write_pairs`.

    Args:
        data: the bytes.

    Raises:
        MalformedError: it is not what it should be.
    """
    reader = Reader(data, "pairs")
    (n,) = reader.fields(_COUNT)
    ids: NDArray[np.int64] = reader.array("int64", (n, 2))
    reader.done()
    return ids


def write_means(means: Array, room_bytes: int) -> list[bytes]:
    """Means [n, 3] (m) in float32, in parts that fit into `room_bytes`.

    Args:
        means: in the common frame, in the order of the matches.
        room_bytes: of a part.
    """
    step = (room_bytes - _PART.size) // _MEAN_BYTES
    cuts = range(0, len(means), step)
    return [
        _PART.pack(k, len(means[k : k + step])) + array_bytes(means[k : k + step], "float32") for k in cuts
    ]


def read_means(data: bytes, count: int) -> tuple[int, Array]:
    """Place of the first, and means [n, 3], from a part.

    Args:
        data: the bytes.
        count: of all matches.

    Raises:
        MalformedError: it is not what it should be.
    """
    reader = Reader(data, "means")
    first, n = reader.fields(_PART)
    if first + n > count:
        raise MalformedError("means: of more Gaussians than were matched")
    means = reader.array("float32", (n, 3)).astype(np.float64)
    reader.done()
    if np.abs(means).max(initial=0.0) > MAX_COORDINATE:
        raise MalformedError("means: an impossible place")
    return first, means
