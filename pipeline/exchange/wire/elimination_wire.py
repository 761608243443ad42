"""Bytes of what goes up and down the tree of robots in elimination (`consensus.tree`)."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from enum import IntEnum

import numpy as np

from duagc.pipeline.base.arrays import Array, array_bytes
from duagc.pipeline.consensus.elimination import BackSubstitution, Block, Variable
from duagc.pipeline.consensus.tree import Message, TreeNode
from duagc.pipeline.exchange.wire.reader import Reader
from duagc.pipeline.exchange.wire.state_wire import MAX_TEAM
from duagc.pipeline.network.packets import MalformedError


class Code(IntEnum):
    """First byte; above those of the set-up of a pose graph."""

    FRONT = 5  # up: variables that the subtree shares with others
    BLOCK = 6  # up: what is left of the subtree's cost after elimination
    STEP = 7  # down: how the shared variables move


def write_message(message: Message, precision: str) -> bytes:
    """Bytes of a message.

    Args:
        message: a front, a block with its exchange, or a step.
        precision: of matrices, float32 or float64.
    """
    if isinstance(message, BackSubstitution):
        return write_step(message)
    if isinstance(message, tuple):
        return write_block(*message, precision)
    return write_front(message)


def take_messages(
    node: TreeNode, arrived: list[tuple[int, bytes]], team: int
) -> tuple[list[tuple[int, bytes]], list[str]]:
    """Hand messages, each with its sender, to a node.

    Args:
        node: gets them; it computes only when it advances.
        arrived: index of the sender, and the payload.
        team: number of robots.

    Returns:
        Those that came too early (a block before its front: losses change the order), and why others were refused.
    """
    early, refused = [], []
    for sender, payload in sorted(arrived, key=lambda a: a[1][:1] != bytes([Code.FRONT])):
        try:
            if payload[:1] == bytes([Code.BLOCK]) and node.waits_for_front(sender):
                early.append((sender, payload))
            else:
                _take(node, sender, payload, team)
        except ValueError as error:
            refused.append(str(error))
    return early, refused


def _take(node: TreeNode, sender: int, payload: bytes, team: int) -> None:
    code = payload[0] if payload else 0
    if code == Code.FRONT:
        node.take_front(sender, read_front(payload, team))
    elif code == Code.BLOCK:
        node.take_block(sender, *read_block(payload, node.variables_of(sender)))
    elif code == Code.STEP:
        node.take_step(sender, read_step(payload, node.variables_above()))
    else:
        raise MalformedError(f"elimination: unknown message {code}")


_FRONT = struct.Struct("<BI")
_BLOCK = struct.Struct("<BIIddB")
_STEP = struct.Struct("<BIBdI")
_REWEIGHTED, _UNSURE, _DOUBLE, _NEW = 1, 2, 4, 8
_ACCEPTED, _FINISHED, _FRESH = 1, 2, 4
_UPPER = np.triu_indices(6)
LARGEST = 1e30  # of a matrix, a gradient or a step: sums and products of such numbers do not overflow


def write_front(variables: Mapping[Variable, int]) -> bytes:
    """Bytes of FRONT, 14 per variable: owner, keyframe, mask of all robots that have it (0: owner not below).

    Args:
        variables: mask of robots by (owner, keyframe).
    """
    names = sorted(variables)
    return b"".join(
        [
            _FRONT.pack(Code.FRONT, len(names)),
            array_bytes([owner for owner, _ in names], "uint16"),
            array_bytes([keyframe for _, keyframe in names], "uint32"),
            array_bytes(np.array([variables[v] for v in names], dtype=np.uint64), "uint64"),
        ]
    )


def read_front(data: bytes, team: int) -> dict[Variable, int]:
    """From FRONT.

    Args:
        data: of the message.
        team: number of robots.

    Returns:
        Mask of robots by (owner, keyframe), ascending.

    Raises:
        MalformedError: it is not what it should be, or names a robot outside the team.
    """
    reader = Reader(data, "front")
    _, n = reader.fields(_FRONT)
    owners = reader.array("uint16", (n,)).tolist()
    keyframes = reader.array("uint32", (n,)).tolist()
    masks = reader.array("uint64", (n,)).tolist()
    reader.done()
    names = list(zip(owners, keyframes, strict=True))
    if max(owners, default=0) >= team or any(mask >> team for mask in masks):
        raise MalformedError("front: names a robot outside the team")
    if names != sorted(set(names)):
        raise MalformedError("front: variables must ascend")
    return dict(zip(names, masks, strict=True))


def write_block(exchange: int, block: Block, precision: str) -> bytes:
    """Bytes of BLOCK. Of H the upper triangle, and of its 6x6 parts others the diagonal those that are not zero.

    The gradient, which decides where the iteration ends, is always float64.

    Args:
        exchange: number of the exchange.
        block: quadratic form over b variables, tangents (translation, rotation) in m and rad.
        precision: of H, float32 or float64.
    """
    n = len(block.g) // 6
    flags = _REWEIGHTED * block.reweighted + _UNSURE * block.unsure + _DOUBLE * (precision == "float64")
    flags += _NEW * (block.H is not None)
    head = _BLOCK.pack(Code.BLOCK, exchange, n, block.cost, block.largest_step, flags)
    if block.H is None:
        return head + array_bytes(block.g, "float64")
    parts = block.H.reshape(n, 6, n, 6).transpose(0, 2, 1, 3)
    others = parts[np.triu_indices(n, 1)].reshape(-1, 36)
    filled = others.any(axis=1)
    diagonal = parts[np.arange(n), np.arange(n)][:, _UPPER[0], _UPPER[1]]
    return b"".join(
        [
            head,
            array_bytes(block.g, "float64"),
            array_bytes(diagonal, precision),
            np.packbits(filled, bitorder="little").tobytes(),
            array_bytes(others[filled], precision),
        ]
    )


def read_block(data: bytes, variables: int) -> tuple[int, Block]:
    """Number of the exchange and the block, over so many variables.

    Args:
        data: of the message.
        variables: how many it must be about.

    Raises:
        MalformedError: it is not what it should be, or over another number of variables.
    """
    reader = Reader(data, "block")
    _, exchange, n, cost, largest_step, flags = reader.fields(_BLOCK)
    possible = 0 <= cost < np.inf and 0 <= largest_step < np.inf
    if n != variables or not possible or flags >= 2 * _NEW:
        raise MalformedError(f"block: over {n} variables, expected {variables}; or impossible numbers")
    g = reader.array("float64", (6 * n,))
    H = _read_matrix(reader, n, "float64" if flags & _DOUBLE else "float32") if flags & _NEW else None
    reader.done()
    _check_size(g, "block")
    if H is not None:
        _check_size(H, "block")
    return exchange, Block(H, g, cost, largest_step, bool(flags & _REWEIGHTED), bool(flags & _UNSURE))


def _check_size(numbers: Array, what: str) -> None:
    if np.abs(numbers).max(initial=0.0) > LARGEST:
        raise MalformedError(f"{what}: a number beyond {LARGEST:g}")


def _read_matrix(reader: Reader, n: int, precision: str) -> Array:
    """A symmetric matrix [6 n, 6 n] of 6x6 parts."""
    diagonal = reader.array(precision, (n, 21))
    off = n * (n - 1) // 2
    filled = np.unpackbits(reader.array("uint8", (-(-off // 8),)), count=off, bitorder="little").astype(bool)
    others = reader.array(precision, (int(filled.sum()), 6, 6))
    parts = np.zeros((n, n, 6, 6))
    rows, columns = (index[filled] for index in np.triu_indices(n, 1))
    parts[rows, columns], parts[columns, rows] = others, others.transpose(0, 2, 1)
    own = np.arange(n)[:, None]
    parts[own, own, _UPPER[0], _UPPER[1]] = parts[own, own, _UPPER[1], _UPPER[0]] = diagonal
    return np.ascontiguousarray(parts.transpose(0, 2, 1, 3)).reshape(6 * n, 6 * n)


def write_step(step: BackSubstitution) -> bytes:
    """Bytes of STEP: 48 per shared variable.

    Args:
        step: of s shared variables, tangents (translation, rotation) in m and rad; none if it was not
            accepted.
    """
    flags = _ACCEPTED * step.accepted + _FINISHED * step.finished + _FRESH * step.fresh
    head = _STEP.pack(Code.STEP, step.exchange, flags, step.damping, len(step.delta))
    return head + array_bytes(step.delta, "float64")


def read_step(data: bytes, variables: int) -> BackSubstitution:
    """From STEP over so many variables; without steps if it was not accepted.

    Args:
        data: of the message.
        variables: how many it must be about if it was accepted.

    Raises:
        MalformedError: it is not what it should be, or over another number of variables.
    """
    reader = Reader(data, "step")
    _, exchange, flags, damping, n = reader.fields(_STEP)
    delta = reader.array("float64", (n, 6))
    reader.done()
    accepted = bool(flags & _ACCEPTED)
    if flags >= 2 * _FRESH or n != accepted * variables or not 0 <= damping < np.inf:
        raise MalformedError(f"step: over {n} variables, expected {variables}; or impossible numbers")
    _check_size(delta, "step")
    return BackSubstitution(exchange, accepted, bool(flags & _FINISHED), bool(flags & _FRESH), damping, delta)


assert MAX_TEAM <= 64  # masks of robots are 64 bits
