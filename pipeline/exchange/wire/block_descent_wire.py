"""Bytes of what block-coordinate descent sends besides poses: loop closures with the start, and robust weights."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from duagc.pipeline.base.arrays import Array, array_bytes
from duagc.pipeline.exchange.wire.link_setup_wire import LinkSetup, read_setup, write_setup
from duagc.pipeline.exchange.wire.reader import Reader
from duagc.pipeline.network.packets import MalformedError

_SETUP, _WEIGHTS = b"\0", b"\1"
_COUNT = struct.Struct("<BIBH")


@dataclass(frozen=True)
class ClosureWeights:
    """Robust weights of the loop closures of a link, from the end that weighs them.

    Attributes:
        version: counts changes from 0.
        final: they do not change any more.
        weights: [m], 0 to 1.
    """

    version: int
    final: bool
    weights: Array


def write_message(message: LinkSetup | ClosureWeights) -> bytes:
    """Bytes of a message.

    Args:
        message: the first one of a link, or weights.
    """
    if isinstance(message, LinkSetup):
        return _SETUP + write_setup(message)
    head = _COUNT.pack(_WEIGHTS[0], message.version, message.final, len(message.weights))
    return head + array_bytes(message.weights, "float64")


def read_message(data: bytes, keyframes: int) -> LinkSetup | ClosureWeights:
    """From `write_message`.

    Args:
        data: the bytes.
        keyframes: of the robot that reads, which loop closures name.

    Raises:
        MalformedError: it is not what it should be.
    """
    if data[:1] == _SETUP:
        return read_setup(data[1:], keyframes, "block descent")
    reader = Reader(data, "weights")
    code, version, final, count = reader.fields(_COUNT)
    if code != _WEIGHTS[0] or final > 1:
        raise MalformedError("block descent: neither loop closures nor weights")
    weights = reader.array("float64", (count,))
    reader.done()
    if weights.min(initial=0.0) < 0.0 or weights.max(initial=1.0) > 1.0:
        raise MalformedError("weights: below 0 or above 1")
    return ClosureWeights(version, bool(final), weights)
