"""The flat chart of Gaussians and the information in it, as packed numbers: the only owner of these layouts.

    theta        [13]   mean 3 (m), vec log Sigma 6 (order of `geometry.spd`), color 3 (RGB 0..1), opacity logit 1
    information  [31]   block diagonal in that chart: upper triangles, row by row, of the 3x3 of the mean (6; 1/m^2) and
                        of the 6x6 of vec log Sigma (21), the diagonal of the color (3), the opacity (1)
    geometry     [45]   upper triangle, row by row, of the 9x9 of (mean, vec log Sigma), cross terms included

Without the cross terms the blocks are conditional, not marginal, information. Zero is no information.
"""

from __future__ import annotations

from functools import cache

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
_ROWS, _COLUMNS = np.triu_indices(9)
_MEAN_PLACES = np.flatnonzero(_COLUMNS < 3)  # of the upper triangles of blocks in that of the 9x9
_LOG_COVARIANCE_PLACES = np.flatnonzero(_ROWS >= 3)


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
    """Symmetric matrices [..., size, size] of their upper triangles, row by row.

    Args:
        upper: [..., size (size + 1) / 2].
        size: rows of a matrix.
    """
    upper = np.asarray(upper, dtype=np.float64)
    return np.take(upper, _places_of_elements(size), axis=-1).reshape(*upper.shape[:-1], size, size)


def pack_symmetric(matrix: Array) -> Array:
    """Upper triangles, row by row, of symmetric matrices.

    Args:
        matrix: [..., size, size]; only the upper triangle is read.
    """
    size = matrix.shape[-1]
    return np.take(matrix.reshape(*matrix.shape[:-2], size * size), _places_of_upper(size), axis=-1)


@cache
def _places_of_upper(size: int) -> NDArray[np.int64]:
    """Of the upper triangle, row by row, in a matrix [size * size]."""
    return np.ravel_multi_index(np.triu_indices(size), (size, size)).astype(np.int64)


@cache
def _places_of_elements(size: int) -> NDArray[np.int64]:
    """Of all elements [size * size] of a symmetric matrix in its upper triangle; faster than to index twice."""
    places = np.empty((size, size), np.int64)
    rows, columns = np.triu_indices(size)
    places[rows, columns] = places[columns, rows] = np.arange(len(rows))
    return places.ravel()


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
    """[n, 3, 3] of information [n, 31], 1/m^2.

    Args:
        information: [n, 31].
    """
    return unpack_symmetric(information[:, MEAN_INFORMATION], 3)


def log_covariance_block(information: Array) -> Array:
    """[n, 6, 6] of information [n, 31], over vec log Sigma.

    Args:
        information: [n, 31].
    """
    return unpack_symmetric(information[:, LOG_COVARIANCE_INFORMATION], 6)


def unpack_geometry(geometry: ArrayLike) -> Array:
    """Symmetric matrices [n, 9, 9] of geometry [n, 45].

    Args:
        geometry: [n, 45].
    """
    return unpack_symmetric(geometry, 9)


def pack_geometry(matrices: Array) -> Array:
    """Geometry [n, 45] of symmetric matrices [n, 9, 9].

    Args:
        matrices: [n, 9, 9], over (mean in meters, vec log Sigma).
    """
    return pack_symmetric(matrices)


def information_of_geometry(geometry: ArrayLike, color: ArrayLike, opacity: ArrayLike) -> Array:
    """Information [n, 31] of geometry [n, 45], color [n, 3] and opacity [n]; the cross terms are dropped.

    Args:
        geometry: [n, 45].
        color: [n, 3], diagonal of the color.
        opacity: [n], of the logit.
    """
    upper = np.asarray(geometry, dtype=np.float64)
    out = np.empty((len(upper), INFORMATION_SIZE))
    out[:, MEAN_INFORMATION] = upper[:, _MEAN_PLACES]
    out[:, LOG_COVARIANCE_INFORMATION] = upper[:, _LOG_COVARIANCE_PLACES]
    out[:, COLOR_INFORMATION] = color
    out[:, OPACITY_INFORMATION] = opacity
    return out


def geometry_of_information(information: Array) -> Array:
    """Geometry [n, 45] of information [n, 31]; the cross terms are zero.

    Args:
        information: [n, 31].
    """
    out = np.zeros((len(information), len(_ROWS)))
    out[:, _MEAN_PLACES] = information[:, MEAN_INFORMATION]
    out[:, _LOG_COVARIANCE_PLACES] = information[:, LOG_COVARIANCE_INFORMATION]
    return out


def theta_of(gaussians: Gaussians) -> Array:
    """theta [n, 13] of Gaussians, in their frame.

    Args:
        gaussians: n, means in meters.
    """
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
