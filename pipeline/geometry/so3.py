"""Rotations: exponential, logarithm, quaternions (wxyz). Batched over leading axes, float64."""

import math

import numpy as np
from numpy.typing import ArrayLike

from duagc.pipeline.base.arrays import Array

SMALL_ANGLE_RAD = 1e-4


def hat(w: ArrayLike) -> Array:
    """Skew matrix [..., 3, 3] of a vector: hat(w) @ v = w x v.

    Args:
        w: [..., 3].
    """
    w = np.asarray(w, dtype=np.float64)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return out


def exp(w: ArrayLike) -> Array:
    """Rotation matrix [..., 3, 3] of a rotation vector (Rodrigues).

    Args:
        w: [..., 3], radians.
    """
    w = np.asarray(w, dtype=np.float64)
    return from_quat_wxyz(quat_from_rotvec(w))


def log(R: ArrayLike) -> Array:
    """Rotation vector [..., 3] in radians, of length at most pi, of a rotation matrix.

    Args:
        R: [..., 3, 3].
    """
    R = np.asarray(R, dtype=np.float64)
    if R.ndim == 2:
        return _log_of_one(R)
    q = to_quat_wxyz(R)
    norm = np.linalg.norm(q[..., 1:], axis=-1)
    angle = 2.0 * np.arctan2(norm, q[..., 0])
    scale = np.where(norm > 1e-10, angle / np.where(norm > 1e-10, norm, 1.0), 2.0)
    return scale[..., None] * q[..., 1:]


def _log_of_one(R: Array) -> Array:
    """`log` of one matrix [3, 3], the same bits in a tenth of the time: numpy takes a microsecond for every number."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
    squares = (1.0 + (xx + yy + zz), 1.0 + (xx - yy - zz), 1.0 + (yy - xx - zz), 1.0 + (zz - xx - yy))
    wx, wy, wz = zy - yz, xz - zx, yx - xy
    candidates = (
        (squares[0], wx, wy, wz),
        (wx, squares[1], xy + yx, xz + zx),
        (wy, xy + yx, squares[2], yz + zy),
        (wz, xz + zx, yz + zy, squares[3]),
    )
    q = candidates[squares.index(max(squares))]
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    w, x, y, z = (number / length for number in q)
    if w < 0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-10 else 2.0
    return np.array([scale * x, scale * y, scale * z])


def quat_from_rotvec(w: ArrayLike) -> Array:
    """Unit quaternion wxyz [..., 4] of a rotation vector.

    Args:
        w: [..., 3], radians.
    """
    w = np.asarray(w, dtype=np.float64)
    angle = np.linalg.norm(w, axis=-1)
    half = 0.5 * angle
    safe = np.where(angle > SMALL_ANGLE_RAD, angle, 1.0)
    scale = np.where(angle > SMALL_ANGLE_RAD, np.sin(half) / safe, 0.5 - angle**2 / 48.0)
    return np.concatenate([np.cos(half)[..., None], scale[..., None] * w], axis=-1)


def from_quat_wxyz(q: ArrayLike) -> Array:
    """Rotation matrix [..., 3, 3] of a quaternion.

    Args:
        q: [..., 4], of any non-zero length.
    """
    q = np.asarray(q, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    R = np.empty((*q.shape[:-1], 3, 3))
    for i in range(3):
        for j in range(3):
            R[..., i, j] = rows[i][j]
    return R


def to_quat_wxyz(R: ArrayLike) -> Array:
    """Unit quaternion wxyz [..., 4] with w >= 0 of a rotation matrix (largest-component rule).

    Args:
        R: [..., 3, 3].
    """
    R = np.asarray(R, dtype=np.float64)
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    squares = 1.0 + np.stack([xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy], axis=-1)
    wx, wy, wz = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    xy, xz, yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    candidates = np.stack(
        [
            np.stack([squares[..., 0], wx, wy, wz], axis=-1),
            np.stack([wx, squares[..., 1], xy, xz], axis=-1),
            np.stack([wy, xy, squares[..., 2], yz], axis=-1),
            np.stack([wz, xz, yz, squares[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(squares, axis=-1)
    q = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def multiply_quat_wxyz(a: ArrayLike, b: ArrayLike) -> Array:
    """Quaternion product a * b, wxyz [..., 4]; its rotation is R(a) @ R(b).

    Args:
        a: [..., 4].
        b: [..., 4].
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def project(M: ArrayLike) -> Array:
    """Nearest rotation [..., 3, 3] in the Frobenius norm to a matrix.

    Args:
        M: [..., 3, 3].
    """
    U, _, Vt = np.linalg.svd(np.asarray(M, dtype=np.float64))
    U[..., :, -1] *= np.linalg.det(U @ Vt)[..., None]
    return U @ Vt
