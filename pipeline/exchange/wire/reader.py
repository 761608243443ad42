"""Strict reading of the bytes of messages, and bytes of poses. Little-endian.

Readers trust nothing: every count is checked against the bytes that are there, every index against its limit, every
number that enters the mathematics must be finite. What does not fit raises MalformedError with the reason. The other
modules here are as strict.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array, array_bytes
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.network.packets import MalformedError

MAX_KEYFRAMES = 100_000
MAX_COORDINATE = 1e6  # m, or units of theta; beyond it positions lose their meaning
MAX_INFORMATION = 1e15  # of a coordinate, 1/m^2: 30 nm
ROTATION_TOLERANCE = 1e-6  # of R R' = 1 in a pose that a neighbor sent
INFORMATION_TOLERANCE = (
    1e-6  # of the largest entry: sums of many residuals say next to nothing of some directions
)


class Reader:
    """Walks through the bytes of a message and never past their end."""

    def __init__(self, data: bytes, what: str) -> None:
        """Begin at the first byte.

        Args:
            data: of the message, or of what is left of it.
            what: name of the message, for errors.
        """
        self.data, self.what, self.position = data, what, 0

    def fields(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Fixed fields.

        Args:
            layout: of the fields.
        """
        return layout.unpack(self._take(layout.size))

    def array(self, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """An array in C order; floats must be finite.

        Args:
            dtype: of the numbers, as numpy names it.
            shape: of the array.
        Raises:
            MalformedError: there are too few bytes, or a float is not finite.
        """
        kind = np.dtype(dtype).newbyteorder("<")
        count = 1
        for n in shape:
            count *= n
        values = np.frombuffer(self._take(count * kind.itemsize), kind).reshape(shape).astype(dtype)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise MalformedError(f"{self.what}: not a finite number")
        return values

    def poses(self, n: int) -> Array:
        """Motions [n, 4, 4] from their upper rows, float64.

        Args:
            n: how many there must be.
        """
        rows = self.array("float64", (n, 3, 4))  # first: n is checked against the bytes that are there
        T = np.tile(np.eye(4), (n, 1, 1))
        T[:, :3] = rows
        R = T[:, :3, :3]
        if np.abs(R).max(initial=0.0) > 2.0 or np.abs(T[:, :3, 3]).max(initial=0.0) > MAX_COORDINATE:
            raise MalformedError(f"{self.what}: a pose is not a rigid motion, or beyond {MAX_COORDINATE:g} m")
        off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(initial=0.0)
        if off > ROTATION_TOLERANCE or np.linalg.det(R).min(initial=1.0) < 0:
            raise MalformedError(f"{self.what}: a pose is not a rigid motion")
        return T

    def motions(self, n: int, precision: str) -> Array:
        """Motions [n, 4, 4] from quaternions and translations, all quaternions first.

        Args:
            n: how many there must be.
            precision: of the numbers, float32 or float64.
        """
        quats_wxyz = self.array(precision, (n, 4)).astype(np.float64)
        translations = self.array(precision, (n, 3)).astype(np.float64)
        off = np.abs((quats_wxyz**2).sum(axis=1) - 1).max(initial=0.0)
        if off > 1e-3 or np.abs(translations).max(initial=0.0) > MAX_COORDINATE:
            raise MalformedError(f"{self.what}: not a rigid motion, or beyond {MAX_COORDINATE:g} m")
        return se3.from_quat_translation(quats_wxyz, translations)

    def done(self) -> None:
        """Check that nothing is left."""
        if self.position != len(self.data):
            raise MalformedError(f"{self.what}: {len(self.data) - self.position} bytes too many")

    def _take(self, size: int) -> bytes:
        if self.position + size > len(self.data):
            raise MalformedError(f"{self.what}: {len(self.data)} bytes, more were announced")
        part = self.data[self.position : self.position + size]
        self.position += size
        return part


def check_information(information: Array, what: str) -> None:
    """Refuse information that no measurement gives; rounding may leave it a little below zero.

    Args:
        information: [n, 6, 6], of relative poses, right tangent (m, rad).
        what: name of the message, for errors.

    Raises:
        MalformedError: some is beyond `MAX_INFORMATION`, not symmetric, or negative.
    """
    largest = np.abs(information).max(axis=(1, 2), initial=0.0)
    skew = np.abs(information - np.swapaxes(information, -1, -2)).max(axis=(1, 2), initial=0.0)
    least = np.linalg.eigvalsh(information).min(axis=1, initial=0.0)
    if np.any(largest > MAX_INFORMATION) or np.any(
        np.maximum(skew, -least) > INFORMATION_TOLERANCE * largest
    ):
        raise MalformedError(f"{what}: information that is too large, not symmetric or negative")


def pose_bytes(T: Array) -> bytes:
    """Upper rows of motions [..., 4, 4], float64.

    Args:
        T: [..., 4, 4], meters.
    """
    return array_bytes(np.asarray(T)[..., :3, :], "float64")


def motion_bytes(T: Array, precision: str) -> bytes:
    """Motions [n, 4, 4] as quaternions and translations, all quaternions first.

    Args:
        T: [n, 4, 4], meters.
        precision: of the numbers, float32 or float64.
    """
    return array_bytes(so3.to_quat_wxyz(T[:, :3, :3]), precision) + array_bytes(T[:, :3, 3], precision)
