"""Evidence in 100 bytes instead of 188: steps far below the standard deviations that it comes with.

    mean                 float32, m, frame of the anchor
    vec log Sigma        int16 in steps of 2^-10 (0.1 % of a variance)
    color               int16 in steps of 2^-13;  opacity logit  int16 in steps of 2^-10
    information          float16 Cholesky factors of the 3x3 and the 6x6 block, float16 roots of color and opacity

A factor instead of the matrix: whatever its entries are rounded to, the product with its transpose is positive
semidefinite, and a direction without information stays without.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import spd
from duagc.pipeline.splat.information import (
    COLOR,
    COLOR_INFORMATION,
    LOG_COVARIANCE,
    LOG_COVARIANCE_INFORMATION,
    MEAN,
    MEAN_INFORMATION,
    OPACITY,
    OPACITY_INFORMATION,
    log_covariance_block,
    mean_block,
    pack_symmetric,
)

COMPACT = np.dtype(
    [
        ("id", "<u4"),
        ("anchor", "<u2"),
        ("mean", "<f4", 3),
        ("shape", "<i2", 6),
        ("color", "<i2", 3),
        ("opacity", "<i2"),
        ("position_factor", "<f2", 6),
        ("shape_factor", "<f2", 21),
        ("color_root", "<f2", 3),
        ("opacity_root", "<f2"),
    ]
)
SHAPE_STEP, COLOR_STEP, OPACITY_STEP = 2.0**-10, 2.0**-13, 2.0**-10
POSITION_UNIT = 16.0  # 1/m; float16 then holds roots of information up to 1e6 1/m
_LARGEST = float(np.finfo(np.float16).max)
_PIVOT = (
    1e-6  # pivots below this share of the diagonal are rounding of the float32 that came in: no information
)
_MISSED = 1e-3  # of the largest entry: by so much a product may differ from its matrix, as float16 does


def encode(records: NDArray[Any]) -> NDArray[Any]:
    """Compact records [n] of records [n] as `evidence_wire.RECORD`.

    Args:
        records: [n], theta [13] and information [31] in the frames of the anchors, means in meters.

    Returns:
        [n] of `COMPACT`, rounded to its steps.

    Raises:
        ValueError: an id beyond 32 bits or an anchor beyond 16; no map of this project has them.
    """
    if len(records) and not (
        records["id"].min() >= 0 and records["id"].max() < 1 << 32 and records["anchor"].min() >= 0
        and records["anchor"].max() < 1 << 16
    ):  # fmt: skip
        raise ValueError(
            "compact evidence holds ids below 2^32 and anchors below 2^16; use evidence_wire = float32"
        )
    out = np.zeros(len(records), COMPACT)
    theta = records["theta"].astype(np.float64)
    information = records["information"].astype(np.float64)
    out["id"], out["anchor"], out["mean"] = records["id"], records["anchor"], records["theta"][:, MEAN]
    out["shape"] = _steps(theta[:, LOG_COVARIANCE], SHAPE_STEP)
    out["color"] = _steps(theta[:, COLOR], COLOR_STEP)
    out["opacity"] = _steps(theta[:, OPACITY], OPACITY_STEP)
    out["position_factor"] = _half(_lower(_factor(mean_block(information))) / POSITION_UNIT)
    out["shape_factor"] = _half(_lower(_factor(log_covariance_block(information))))
    out["color_root"] = _half(np.sqrt(np.maximum(information[:, COLOR_INFORMATION], 0.0)))
    out["opacity_root"] = _half(np.sqrt(np.maximum(information[:, OPACITY_INFORMATION], 0.0)))
    return out


def decode(compact: NDArray[Any], record: np.dtype[Any], *, information: bool = True) -> NDArray[Any]:
    """Records of dtype `record` (`evidence_wire.RECORD`) from compact ones.

    Args:
        compact: [n] of `COMPACT`.
        record: dtype of the result.
        information: also that; else it is zero.

    Returns:
        [n] of `record`, in the same order and frames.
    """
    out = np.zeros(len(compact), record)
    out["id"], out["anchor"] = compact["id"], compact["anchor"]
    out["theta"][:, MEAN] = compact["mean"]
    out["theta"][:, LOG_COVARIANCE] = compact["shape"] * SHAPE_STEP
    out["theta"][:, COLOR] = compact["color"] * COLOR_STEP
    out["theta"][:, OPACITY] = compact["opacity"] * OPACITY_STEP
    if not information:
        return out
    position = _product(compact["position_factor"].astype(np.float64) * POSITION_UNIT, 3)
    out["information"][:, MEAN_INFORMATION] = pack_symmetric(position)
    out["information"][:, LOG_COVARIANCE_INFORMATION] = pack_symmetric(
        _product(compact["shape_factor"].astype(np.float64), 6)
    )
    out["information"][:, COLOR_INFORMATION] = compact["color_root"].astype(np.float64) ** 2
    out["information"][:, OPACITY_INFORMATION] = compact["opacity_root"].astype(np.float64) ** 2
    return out


def _steps(values: Array, step: float) -> NDArray[np.int16]:
    return np.clip(np.rint(values / step), -32767, 32767).astype(np.int16)


def _half(values: Array) -> NDArray[np.float16]:
    return np.clip(values, -_LARGEST, _LARGEST).astype(np.float16)


def _factor(matrices: Array) -> Array:
    """L [n, d, d] lower with L L' = M for positive semidefinite M; of others, without their negative eigenvalues.

    Rounding leaves some of these, and a pivot that is hardly above zero then makes a product many times too large.
    """
    L = _cholesky(matrices)
    largest = np.abs(matrices).max(axis=(1, 2), initial=0.0)
    missed = np.abs(L @ L.swapaxes(-1, -2) - matrices).max(axis=(1, 2), initial=0.0) > _MISSED * largest
    L[missed] = _cholesky(spd.without_negative(matrices[missed]))
    return L


def _cholesky(matrices: Array) -> Array:
    """L [n, d, d] lower with L L' = M for positive semidefinite M; a column without a sound pivot is zero."""
    n, d, _ = matrices.shape
    L = np.zeros((n, d, d))
    for j in range(d):
        pivot = matrices[:, j, j] - np.sum(L[:, j, :j] ** 2, axis=1)
        sound = pivot > _PIVOT * matrices[:, j, j]
        root = np.sqrt(np.where(sound, pivot, 1.0))
        column = matrices[:, j:, j] - (L[:, j:, :j] @ L[:, j, :j, None])[..., 0]
        L[:, j:, j] = np.where(sound[:, None], column / root[:, None], 0.0)
    return L


def _lower(L: Array) -> Array:
    """Lower triangles [n, d (d + 1) / 2], row by row."""
    rows, columns = np.tril_indices(L.shape[-1])
    return L[:, rows, columns]


def _product(lower: Array, size: int) -> Array:
    """L L' [n, d, d] of lower triangles."""
    rows, columns = np.tril_indices(size)
    L = np.zeros((len(lower), size, size))
    L[:, rows, columns] = lower
    return L @ L.swapaxes(-1, -2)
