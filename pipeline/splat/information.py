"""The flat chart of Gaussians and the information in it, as packed numbers: the only owner of these layouts.

    theta        [13]   mean 3 (m), vec log Sigma 6 (order of `geometry.spd`), color 3 (RGB 0..1), opacity logit 1
    information  [31]   block diagonal in that chart: upper triangles, row by row, of the 3x3 of the mean (6; 1/m^2) and
                        of the 6x6 of vec log Sigma (21), the diagonal of the color (3), the opacity (1)
    geometry     [45]   upper triangle, row by row, of the 9x9 of (mean, vec log Sigma), cross terms included

Without the cross terms the blocks are conditional, not marginal, information. Zero is no information.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import spd
from duagc.pipeline.splat.gaussians import Gaussians

THETA_SIZE = 13
MEAN, LOG_COVARIANCE, COLOR, OPACITY = slice(0, 3), slice(3, 9), slice(9, 12), 12
"""Places in theta."""

INFORMATION_SIZE = 31
MEAN_INFORMATION, LOG_COVARIANCE_INFORMATION = slice(0, 6), slice(6, 27)
COLOR_INFORMATION, OPACITY_INFORMATION = slice(27, 30), 30
"""Places in information."""

GEOMETRY_SIZE = 45
_UPPER = np.triu_indices(9)
_MEAN_BLOCK, _LOG_COVARIANCE_BLOCK = slice(0, 3), slice(3, 9)  # rows and columns of the 9x9


def _diagonal_of_upper(size: int) -> NDArray[np.int64]:
    """Places of the diagonal in the upper triangle, row by row, of a matrix [size, size]."""
    rows, columns = np.triu_indices(size)
    return np.flatnonzero(rows == columns).astype(np.int64)


INFORMATION_DIAGONAL = np.concatenate(
    [
        MEAN_INFORMATION.start + _diagonal_of_upper(3),
        LOG_COVARIANCE_INFORMATION.start + _diagonal_of_upper(6),
        np.arange(COLOR_INFORMATION.start, INFORMATION_SIZE),
    ]
)
"""Places of the diagonal [13] in information, in the order of theta."""

WORST_CONDITION = 1e12
"""Of the information of a position; a direction of one that is worse is not determined in float64."""


def unpack_symmetric(upper: ArrayLike, size: int) -> Array:
    """Symmetric matrices [..., size, size] of their upper triangles, row by row."""
    upper = np.asarray(upper, dtype=np.float64)
    rows, columns = np.triu_indices(size)
    out = np.empty((*upper.shape[:-1], size, size))
    out[..., rows, columns] = upper
    out[..., columns, rows] = upper
    return out


def pack_symmetric(matrix: Array) -> Array:
    """Upper triangles, row by row, of symmetric matrices [..., size, size]."""
    rows, columns = np.triu_indices(matrix.shape[-1])
    return matrix[..., rows, columns]


def pack_information(mean: Array, log_covariance: Array, color: Array, opacity: Array) -> Array:
    """Information [n, 31] of its blocks.

    Args:
        mean: [n, 3, 3], 1/m^2.
        log_covariance: [n, 6, 6], over vec log Sigma.
        color: [n, 3], the diagonal.
        opacity: [n], over the logit.
    """
    return np.concatenate(
        [pack_symmetric(mean), pack_symmetric(log_covariance), color, opacity[:, None]], axis=1
    )


def mean_block(information: Array) -> Array:
    """[n, 3, 3] of information [n, 31], 1/m^2."""
    return unpack_symmetric(information[:, MEAN_INFORMATION], 3)


def log_covariance_block(information: Array) -> Array:
    """[n, 6, 6] of information [n, 31], over vec log Sigma."""
    return unpack_symmetric(information[:, LOG_COVARIANCE_INFORMATION], 6)


def unpack_geometry(geometry: ArrayLike) -> Array:
    """Symmetric matrices [n, 9, 9] of geometry [n, 45]."""
    return unpack_symmetric(geometry, 9)


def pack_geometry(matrices: Array) -> Array:
    """Geometry [n, 45] of symmetric matrices [n, 9, 9]."""
    return matrices[:, _UPPER[0], _UPPER[1]]


def information_of_geometry(geometry: ArrayLike, color: ArrayLike, opacity: ArrayLike) -> Array:
    """Information [n, 31] of geometry [n, 45], color [n, 3] and opacity [n]; the cross terms are dropped."""
    full = unpack_geometry(geometry)
    out = np.empty((len(full), INFORMATION_SIZE))
    out[:, MEAN_INFORMATION] = pack_symmetric(full[:, _MEAN_BLOCK, _MEAN_BLOCK])
    out[:, LOG_COVARIANCE_INFORMATION] = pack_symmetric(full[:, _LOG_COVARIANCE_BLOCK, _LOG_COVARIANCE_BLOCK])
    out[:, COLOR_INFORMATION] = color
    out[:, OPACITY_INFORMATION] = opacity
    return out


def geometry_of_information(information: Array) -> Array:
    """Geometry [n, 45] of information [n, 31]; the cross terms are zero."""
    full = np.zeros((len(information), 9, 9))
    full[:, _MEAN_BLOCK, _MEAN_BLOCK] = mean_block(information)
    full[:, _LOG_COVARIANCE_BLOCK, _LOG_COVARIANCE_BLOCK] = log_covariance_block(information)
    return pack_geometry(full)


def theta_of(gaussians: Gaussians) -> Array:
    """theta [n, 13] of Gaussians, in their frame."""
    return np.concatenate(
        [
            gaussians.means.astype(np.float64),
            spd.log_covariance(gaussians.quats_wxyz, gaussians.log_scales),
            gaussians.colors.astype(np.float64),
            gaussians.opacity_logits.astype(np.float64)[:, None],
        ],
        axis=1,
    )


def gaussians_of(ids: NDArray[np.int64], anchors: NDArray[np.int32], theta: Array) -> Gaussians:
    """Gaussians of theta.

    Args:
        ids: [n].
        anchors: [n].
        theta: [n, 13], in the frame that the Gaussians shall be in.
    """
    quats, scales = spd.from_log_covariance(theta[:, LOG_COVARIANCE])
    return Gaussians(
        ids=ids,
        anchors=anchors,
        means=theta[:, MEAN].astype(np.float32),
        quats_wxyz=quats.astype(np.float32),
        log_scales=scales.astype(np.float32),
        colors=theta[:, COLOR].astype(np.float32),
        opacity_logits=theta[:, OPACITY].astype(np.float32),
    )


def sigma_along(information: Array, directions: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Standard deviation (m) [n] of positions along unit directions, and where it is determined; else infinite.

    sigma^2 = n^T F^-1 n: everything but the position and all poses held fixed.

    Args:
        information: of the positions, 1/m^2 [n, 3, 3]; singular (condition above 1e12) is not determined.
        directions: [n, 3], in the same frame.
    """
    sigma = np.full(len(information), np.inf)
    values = np.linalg.eigvalsh(information) if len(information) else np.zeros((0, 3))
    determined = (values[:, 0] > 0) & (values[:, 2] < WORST_CONDITION * values[:, 0])
    some = directions[determined]
    solved = np.linalg.solve(information[determined], some[..., None])[..., 0]
    sigma[determined] = np.sqrt(np.sum(some * solved, axis=1))
    return sigma, determined
