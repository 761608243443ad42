"""Bytes of evidence of every kind, in chunks that are useful alone. Strict as `wire`."""

from __future__ import annotations

import struct
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.row_blocks import in_blocks
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.exchange.wire.compact_wire import COMPACT, decode, encode
from duagc.pipeline.exchange.wire.reader import MAX_COORDINATE, MAX_INFORMATION, Reader
from duagc.pipeline.geometry import spd
from duagc.pipeline.network.packets import (
    EVIDENCE_BYTES,
    EVIDENCE_DOUBLE_BYTES,
    EVIDENCE_EXACT_BYTES,
    EVIDENCE_HEAD_BYTES,
    EVIDENCE_KINDS,
    Kind,
    MalformedError,
    chunk_bytes,
    records_per_chunk,
)
from duagc.pipeline.splat.gaussians import DEPTH_KINDS
from duagc.pipeline.splat.information import (
    COLOR_INFORMATION,
    INFORMATION_SIZE,
    LOG_COVARIANCE,
    LOG_COVARIANCE_INFORMATION,
    MEAN_INFORMATION,
    THETA_SIZE,
    log_covariance_block,
    mean_block,
    pack_symmetric,
)

INDEFINITE_TOLERANCE = 1e-4  # of the largest eigenvalue: rounding of float32
SENT_TOLERANCE = 0.5 * INDEFINITE_TOLERANCE  # of what is sent, which may be rounded to float32
MAX_LOG_COVARIANCE = 60.0  # beyond it exponentials overflow in float32

RECORD = np.dtype(
    [("id", "<i8"), ("anchor", "<i4"), ("theta", "<f4", THETA_SIZE), ("information", "<f4", INFORMATION_SIZE)]
)
RECORD_DOUBLE = np.dtype(
    [("id", "<i8"), ("anchor", "<i4"), ("theta", "<f8", THETA_SIZE), ("information", "<f8", INFORMATION_SIZE)]
)
_BLOCKS = (MEAN_INFORMATION, mean_block), (LOG_COVARIANCE_INFORMATION, log_covariance_block)
# owner, 1 + index of the depth its map was made with, records of the whole message
_EVIDENCE = struct.Struct("<HHI")
assert RECORD.itemsize == EVIDENCE_EXACT_BYTES
assert RECORD_DOUBLE.itemsize == EVIDENCE_DOUBLE_BYTES
assert COMPACT.itemsize == EVIDENCE_BYTES
assert _EVIDENCE.size == EVIDENCE_HEAD_BYTES


def record_dtype(kind: Kind) -> np.dtype[Any]:
    """Records as they are made and read for this kind of evidence.

    Args:
        kind: of the evidence; EVIDENCE_DOUBLE has float64, the others float32.
    """
    return RECORD_DOUBLE if kind is Kind.EVIDENCE_DOUBLE else RECORD


def to_body(kind: Kind, records: NDArray[Any]) -> NDArray[Any]:
    """Records as a packet of this kind has them. Rounding happens here, once: a body is passed on unchanged.

    Args:
        kind: of the evidence.
        records: [n] of `record_dtype(kind)`.

    Returns:
        [n] of `COMPACT` for EVIDENCE; otherwise of the same dtype.

    Raises:
        ValueError: an id or an anchor is beyond what the compact kind holds.
    """
    return in_blocks(encode if kind is Kind.EVIDENCE else _possible, records)


def _possible(records: NDArray[Any]) -> NDArray[Any]:
    """Records without the negative eigenvalues of information that receivers would refuse.

    Sums of float32 err by a share of their largest eigenvalue. Once that is bounded by what a robot states of itself,
    the error may be much of it.
    """
    information = records["information"].astype(np.float64)
    out = records
    for place, block in _BLOCKS:
        odd = np.flatnonzero(_indefinite(block(information), SENT_TOLERANCE))
        if len(odd):
            out = out.copy() if out is records else out
            out["information"][odd, place] = pack_symmetric(spd.without_negative(block(information[odd])))
    return out


def from_body(kind: Kind, body: NDArray[Any]) -> NDArray[Any]:
    """Records as every receiver reads them.

    Args:
        kind: of the evidence.
        body: [n], from `to_body`.

    Returns:
        [n] of `record_dtype(kind)`.
    """
    return in_blocks(partial(decode, record=RECORD), body) if kind is Kind.EVIDENCE else body


def write_evidence(kind: Kind, owner: int, depth: DepthKind, body: NDArray[Any]) -> bytes:
    """Bytes of evidence of any kind: chunks of whole records, each with its own head, as they are cut.

    Args:
        kind: of the evidence.
        owner: index of the robot whose evidence it is.
        depth: of a Gaussian at a pixel, as the owner's map was made.
        body: [n], from `to_body`; n may be 0.
    """
    n, per, size = len(body), records_per_chunk(kind), body.itemsize
    head = _EVIDENCE.pack(owner, 1 + DEPTH_KINDS.index(depth), n)
    chunks = max(1, -(-n // per))
    rows = np.zeros((chunks, chunk_bytes(kind)), np.uint8)
    rows[:, :EVIDENCE_HEAD_BYTES] = np.frombuffer(head, np.uint8)
    padded = np.zeros(chunks * per, body.dtype)
    padded[:n] = body
    rows[:, EVIDENCE_HEAD_BYTES:] = padded.view(np.uint8).reshape(chunks, per * size)
    return rows.tobytes()[: chunks * EVIDENCE_HEAD_BYTES + n * size]


def read_evidence_head(kind: Kind, chunk: bytes, team: int) -> tuple[int, DepthKind, int]:
    """Owner of a chunk of evidence, the depth its map was made with, and the number of records of the whole message.

    Args:
        kind: of the evidence.
        chunk: whole, or its first `EVIDENCE_HEAD_BYTES` bytes.
        team: number of robots.

    Raises:
        MalformedError: it is not what it should be, or of a robot outside the team.
    """
    owner, depth, n = Reader(chunk[:EVIDENCE_HEAD_BYTES], "evidence").fields(_EVIDENCE)
    if owner >= team or (len(chunk) - EVIDENCE_HEAD_BYTES) % EVIDENCE_KINDS[kind]:
        raise MalformedError("evidence: names a robot outside the team, or holds a part of a record")
    if not 1 <= depth <= len(DEPTH_KINDS):
        raise MalformedError("evidence: of a map with an unknown kind of depth")
    return owner, DEPTH_KINDS[depth - 1], n


def read_evidence(kind: Kind, data: bytes, team: int) -> tuple[int, NDArray[Any], NDArray[Any]]:
    """Owner, body and records of any number of consecutive chunks of one message, each id once.

    A complete message has the announced number of records; parts of one have fewer.

    Args:
        kind: of the evidence.
        data: the chunks, one after the other.
        team: number of robots.

    Returns:
        Index of the owner; [n] as they were sent; [n] of `record_dtype(kind)`.

    Raises:
        MalformedError: it is not what it should be, or of a robot outside the team.
    """
    owner, body = _read_body(kind, data, team)
    records = from_body(kind, body)
    check_evidence(records)
    if kind is not Kind.EVIDENCE:  # the factors of the compact kind are always possible
        check_information(records["information"].astype(np.float64))
    return owner, body, records


def check_chunk(kind: Kind, chunk: bytes, team: int) -> int:
    """Owner of one chunk of a message that is read when all of it is here.

    Args:
        kind: of the evidence.
        chunk: as it came in a packet.
        team: number of robots.

    Raises:
        MalformedError: `read_evidence` would refuse it.
    """
    if kind is not Kind.EVIDENCE:
        return read_evidence(kind, chunk, team)[0]
    owner, body = _read_body(kind, chunk, team)
    check_evidence(decode(body, RECORD, information=False))
    return owner


def _read_body(kind: Kind, data: bytes, team: int) -> tuple[int, NDArray[Any]]:
    """Owner of consecutive chunks, and their records as they were sent, of finite numbers; as `read_evidence`."""
    owner, _, announced = read_evidence_head(kind, data[:EVIDENCE_HEAD_BYTES], team)
    step = chunk_bytes(kind)
    chunks = -(-len(data) // step)
    padded = np.zeros(chunks * step, np.uint8)
    padded[: len(data)] = np.frombuffer(data, np.uint8)
    rows = padded.reshape(chunks, step)
    if (rows[:, :EVIDENCE_HEAD_BYTES] != rows[0, :EVIDENCE_HEAD_BYTES]).any():
        raise MalformedError("evidence: chunks of different messages")
    n, odd = divmod(len(data) - chunks * EVIDENCE_HEAD_BYTES, EVIDENCE_KINDS[kind])
    if odd or n > announced:
        raise MalformedError(f"evidence: {len(data)} bytes are no {announced} records")
    flat = np.ascontiguousarray(rows[:, EVIDENCE_HEAD_BYTES:]).reshape(-1)
    body: NDArray[Any] = flat.view(COMPACT if kind is Kind.EVIDENCE else record_dtype(kind))[:n].copy()
    for name in body.dtype.names or ():
        if body[name].dtype.kind == "f" and not np.isfinite(body[name]).all():
            raise MalformedError("evidence: not a finite number")
    return owner, body


def check_evidence(records: NDArray[Any]) -> None:
    """Refuse records with impossible numbers.

    Args:
        records: [n] of `record_dtype`, one owner's.

    Raises:
        MalformedError: a mean or size is impossible, a keyframe negative, or an id there twice.
    """
    theta = records["theta"]
    if len(records) and (
        np.abs(theta).max() > MAX_COORDINATE or np.abs(theta[:, LOG_COVARIANCE]).max() > MAX_LOG_COVARIANCE
    ):
        raise MalformedError("evidence: a Gaussian of impossible place or size")
    if len(records) and records["anchor"].min() < 0:
        raise MalformedError("evidence: a negative keyframe")
    if len(np.unique(records["id"])) != len(records):
        raise MalformedError("evidence: a Gaussian twice")


def check_information(information: Array) -> None:
    """Refuse information that no measurement can give: indefinite, or beyond all sensors.

    Args:
        information: [n, 31], laid out as in `splat.information`; position in 1/m^2.

    Raises:
        MalformedError: with the reason.
    """
    if np.abs(information).max(initial=0.0) > MAX_INFORMATION:
        raise MalformedError(f"evidence: information beyond {MAX_INFORMATION:g}")
    if information[:, COLOR_INFORMATION.start :].min(initial=0.0) < 0:
        raise MalformedError("evidence: negative information")
    if any(_indefinite(block(information), INDEFINITE_TOLERANCE).any() for _, block in _BLOCKS):
        raise MalformedError("evidence: indefinite information")


def _indefinite(matrices: Array, tolerance: float) -> NDArray[np.bool_]:
    """Which symmetric matrices [n, d, d] have an eigenvalue below zero by a share of their largest."""
    values = np.linalg.eigvalsh(matrices)
    return np.asarray(values[:, 0] < -tolerance * np.maximum(values[:, -1], 1e-6))
