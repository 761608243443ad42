"""Covariances of Gaussians and their Log-Euclidean chart (paper eq. (9), method section 1).

A symmetric 3x3 matrix is kept as its 6-vector (xx, yy, zz, sqrt2 xy, sqrt2 xz, sqrt2 yz): the factor makes the
Euclidean norm of the vector the Frobenius norm of the matrix.
"""

import numpy as np
from numpy.typing import ArrayLike

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import so3

SQRT2 = float(np.sqrt(2.0))
_ROW = np.array([0, 1, 2, 0, 0, 1])
_COLUMN = np.array([0, 1, 2, 1, 2, 2])
_WEIGHT = np.array([1, 1, 1, SQRT2, SQRT2, SQRT2])


def sym_to_vec(S: ArrayLike) -> Array:
    """6-vector [..., 6] of a symmetric matrix.

    Args:
        S: [..., 3, 3].
    """
    return np.asarray(S, dtype=np.float64)[..., _ROW, _COLUMN] * _WEIGHT


def vec_to_sym(v: ArrayLike) -> Array:
    """Symmetric matrix [..., 3, 3] of a 6-vector.

    Args:
        v: [..., 6].
    """
    entries = np.asarray(v, dtype=np.float64) / _WEIGHT
    S = np.empty((*entries.shape[:-1], 3, 3))
    S[..., _ROW, _COLUMN] = entries
    S[..., _COLUMN, _ROW] = entries
    return S


def sym_rotation(R: ArrayLike) -> Array:
    """D(R) [..., 6, 6] with vec(R S R^T) = D(R) vec(S); orthogonal when R is.

    Args:
        R: [..., 3, 3].
    """
    R = np.asarray(R, dtype=np.float64)
    basis = vec_to_sym(np.eye(6))
    rotated = R[..., None, :, :] @ basis @ np.swapaxes(R, -1, -2)[..., None, :, :]
    return np.swapaxes(sym_to_vec(rotated), -1, -2)


def log_covariance(quats_wxyz: ArrayLike, log_scales: ArrayLike) -> Array:
    """vec log Sigma [..., 6] of Sigma = R diag(exp 2 s) R^T.

    Args:
        quats_wxyz: [..., 4], of R.
        log_scales: [..., 3], s, of meters.
    """
    R = so3.from_quat_wxyz(quats_wxyz)
    s = np.asarray(log_scales, dtype=np.float64)
    return sym_to_vec((R * (2.0 * s)[..., None, :]) @ np.swapaxes(R, -1, -2))


def from_log_covariance(vec_log: ArrayLike) -> tuple[Array, Array]:
    """Quaternion wxyz [..., 4] and log-scales [..., 3], descending, of vec log Sigma.

    Args:
        vec_log: [..., 6].
    """
    values, vectors = np.linalg.eigh(vec_to_sym(vec_log))
    vectors = vectors[..., ::-1].copy()
    vectors[..., :, 2] *= np.linalg.det(vectors)[..., None]
    return so3.to_quat_wxyz(vectors), 0.5 * values[..., ::-1]


def without_negative(matrices: ArrayLike) -> Array:
    """Symmetric matrices [..., d, d] with zero in the place of negative eigenvalues, such as rounding leaves.

    Args:
        matrices: [..., d, d], symmetric.
    """
    values, vectors = np.linalg.eigh(np.asarray(matrices, dtype=np.float64))
    return np.asarray((vectors * np.maximum(values, 0.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2))


def add_covariance(information: ArrayLike, covariance: ArrayLike) -> Array:
    """(W^-1 + C)^-1 for positive semidefinite W and C [..., d, d], either may be singular.

    Computed as (I + W C)^-1 W, which needs no inverse of either: a direction without information stays without.

    Args:
        information: W [..., d, d].
        covariance: C [..., d, d], in the inverse unit of W.
    """
    W, C = np.asarray(information, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    out = np.linalg.solve(np.eye(W.shape[-1]) + W @ C, W)
    return np.asarray(0.5 * (out + np.swapaxes(out, -1, -2)), dtype=np.float64)
