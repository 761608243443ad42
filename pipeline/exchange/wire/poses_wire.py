"""Bytes of the poses of a round: 30 1/4 per shared keyframe, 24 1/4 all in float32, 48 1/4 in float64."""

from __future__ import annotations

import struct
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import array_bytes
from duagc.pipeline.consensus.admm_edge import STEP_M, PosePacket
from duagc.pipeline.exchange.wire.reader import MAX_COORDINATE, Reader
from duagc.pipeline.network.packets import MalformedError

_POSES = struct.Struct("<IIBHH2f")
_CONVERGED, _CURVATURE, _PENALTIES, _POSE_DOUBLE, _POSE_FIXED = 1, 2, 4, 8, 16
_NUMBERS = {0: 24, _POSE_DOUBLE: 48, _POSE_FIXED: 30}  # bytes of a pose without its two bits, by its flag
_FIXED_BYTES = 6
_OTHERS = np.array(
    [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]
)  # components that are sent, all but the largest


def write_poses(packet: PosePacket, first: int, count: int, decides: bool) -> bytes:
    """Bytes of some of the poses of a round.

    The largest component of the quaternion is left out, which one takes two bits; both ends know the keyframes. The
    end that decides sends its penalties, the other end its curvature.

    Args:
        packet: all poses of the round.
        first: place of the first one among the shared keyframes of the link.
        count: how many follow from there.
        decides: whether this end decides on penalties.
    """
    part = packet.part(slice(first, first + count))
    precision = _precision(part)
    flags = _CONVERGED * part.converged + precision
    numbers = (0.0, 0.0)
    if decides:
        flags, numbers = flags + _PENALTIES, part.penalties.tolist()
    elif part.curvature is not None:
        flags, numbers = flags + _CURVATURE, part.curvature.tolist()
    q = part.quats_wxyz
    largest = np.argmax(np.abs(q), axis=1)
    rows = np.arange(count)
    q = np.where(q[rows, largest] < 0, -1, 1)[:, None] * q
    bits = np.unpackbits(largest.astype(np.uint8)[:, None], axis=1, count=2, bitorder="little")
    return b"".join(
        [
            _POSES.pack(part.sequence, part.version, flags, first, count, *numbers),
            np.packbits(bits, bitorder="little").tobytes(),
            array_bytes(q[rows[:, None], _OTHERS[largest]], _dtype(precision)),
            _fixed_bytes(part.translations)
            if precision == _POSE_FIXED
            else array_bytes(part.translations, _dtype(precision)),
        ]
    )


def _precision(packet: PosePacket) -> int:
    """The flag of a packet's numbers."""
    if packet.translations.dtype == np.float32:
        return 0
    return _POSE_DOUBLE if packet.quats_wxyz.dtype == np.float64 else _POSE_FIXED


def _dtype(precision: int) -> str:
    """Of quaternions; of translations, too, where they are not fixed."""
    return "float64" if precision == _POSE_DOUBLE else "float32"


def _fixed_bytes(translations: NDArray[np.float64]) -> bytes:
    """Translations [n, 3] as whole numbers of STEP_M, six bytes each; what is beyond their reach, at its end."""
    end = 2 ** (8 * _FIXED_BYTES - 1) - 1
    steps = np.clip(np.rint(translations / STEP_M), -end, end).astype("<i8")
    return np.ascontiguousarray(steps.view(np.uint8).reshape(-1, 3, 8)[..., :_FIXED_BYTES]).tobytes()


def _read_fixed(reader: Reader, n: int) -> NDArray[np.float64]:
    """From `_fixed_bytes`."""
    whole = np.zeros((n, 3, 8), np.uint8)
    whole[..., 8 - _FIXED_BYTES :] = reader.array("uint8", (n, 3, _FIXED_BYTES))
    steps = whole.view(np.int64)[..., 0] >> 8 * (8 - _FIXED_BYTES)  # with its sign
    return steps.astype(np.float64) * STEP_M


def write_poses_in_parts(packet: PosePacket, room_bytes: int, decides: bool) -> list[bytes]:
    """All poses of a round in parts of equal size, each useful alone.

    Args:
        packet: all poses of the round, [s] shared keyframes.
        room_bytes: most bytes of a part.
        decides: whether this end decides on penalties.
    """
    n = len(packet.keyframes)
    parts = -(-n // poses_per_packet(room_bytes, _precision(packet)))
    cuts = [n * k // parts for k in range(parts + 1)]
    return [write_poses(packet, a, b - a, decides) for a, b in pairwise(cuts)]


def poses_per_packet(room_bytes: int, precision: int) -> int:
    """Poses that fit into a packet.

    Args:
        room_bytes: most bytes of the packet.
        precision: flag of the numbers of the packet; 0 for float32, 8 for float64, 16 for steps of `STEP_M`.
    """
    return 4 * (room_bytes - _POSES.size) // (1 + 4 * _NUMBERS[precision])


def read_poses(data: bytes, shared: NDArray[np.int32], from_decider: bool) -> PosePacket:
    """Poses of a round about some of the shared keyframes.

    Args:
        data: of the packet.
        shared: int32 [s], indices of the keyframes that the link shares, ascending.
        from_decider: whether the other end decides on penalties.

    Raises:
        MalformedError: it is not what it should be, not from this end, or of keyframes that are not shared.
    """
    reader = Reader(data, "poses")
    sequence, version, flags, first, n, *numbers = reader.fields(_POSES)
    precision = flags & (_POSE_DOUBLE | _POSE_FIXED)
    known = flags < 2 * _POSE_FIXED and precision in _NUMBERS
    if not known or bool(flags & _PENALTIES) != from_decider or first + n > len(shared):
        raise MalformedError("poses: unknown flags, not from this end, or of keyframes that are not shared")
    brings = flags & (_PENALTIES | _CURVATURE)
    if brings and not (np.isfinite(numbers).all() and min(numbers) > 1e-12 and max(numbers) < 1e9):
        raise MalformedError("poses: penalties and curvature must be positive")
    bits = np.unpackbits(reader.array("uint8", (-(-n // 4),)), count=2 * n, bitorder="little").reshape(n, 2)
    others = reader.array(_dtype(precision), (n, 3)).astype(np.float64)
    if precision == _POSE_FIXED:
        translations: NDArray[np.float64] = _read_fixed(reader, n)
    else:
        translations = reader.array(_dtype(precision), (n, 3))
    reader.done()
    rest = 1.0 - (others**2).sum(axis=1)
    if rest.min(initial=1.0) < 0.2 or np.abs(translations).max(initial=0.0) > MAX_COORDINATE:
        raise MalformedError("poses: not rigid motions")
    largest, rows = bits[:, 0] + 2 * bits[:, 1], np.arange(n)
    quats = np.zeros((n, 4))
    quats[rows, largest] = np.sqrt(rest)
    quats[rows[:, None], _OTHERS[largest]] = others
    pair = np.array(numbers, dtype=np.float32)
    penalties = pair if from_decider else np.zeros(2, dtype=np.float32)
    curvature, converged = pair if flags & _CURVATURE else None, bool(flags & _CONVERGED)
    keyframes = shared[first : first + n]
    return PosePacket(
        sequence=sequence,
        version=version,
        keyframes=keyframes,
        quats_wxyz=quats,
        translations=translations,
        penalties=penalties,
        curvature=curvature,
        converged=converged,
    )


# --- which shared keyframes still pull


_VERSION = struct.Struct("<I")


def write_mask(version: int, active: NDArray[np.bool_]) -> bytes:
    """Bytes of a mask of the shared keyframes [s]: its version, then one bit each.

    Args:
        version: of the mask; a later one replaces an earlier one.
        active: bool [s], shared keyframes that loop closures with weight name.
    """
    return _VERSION.pack(version) + np.packbits(active, bitorder="little").tobytes()


def read_mask(data: bytes, count: int) -> tuple[int, NDArray[np.bool_]]:
    """Version and mask [count] of shared keyframes.

    Args:
        data: of the message.
        count: number of keyframes that the link shares.
    Raises:
        MalformedError: another length, or bits beyond the last keyframe.
    """
    if len(data) != _VERSION.size + -(-count // 8):
        raise MalformedError(f"mask: {len(data)} bytes for {count} shared keyframes")
    (version,) = _VERSION.unpack_from(data)
    bits = np.unpackbits(np.frombuffer(data, np.uint8, offset=_VERSION.size), bitorder="little")
    if bits[count:].any():
        raise MalformedError(f"mask: names more than {count} shared keyframes")
    return version, bits[:count].astype(bool)
