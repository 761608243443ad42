"""Measures of the information of single Gaussians: what lies off its blocks, what that costs, and how (2) differs.

    r_meters          norm of the off-diagonal blocks of the 14x14 over that of the whole (Frobenius), SI units; blocks:
                      mean, quaternion, log-scales, color, logit
    r_millimeters     the same with the mean in millimeters
    r_unit_diagonal   the same with every diagonal entry one: parameters in units of their conditional deviations
    r_chart           the same of the 13x13; blocks: mean, vec log Sigma, color, logit
    r_turned          the same of the 14x14 of unit diagonal, turned at random
    A_B               largest canonical correlation of two blocks of the 13x13, 0 to 1, whatever their coordinates
    sigma_normal      deviation of the mean along the normal of its disc from the whole 13x13 over that from its own
                      block; `sigma_surface`, `sigma_color`, `sigma_opacity` likewise
    stated_normal     the same of the deviations that a robot states, after what it measured is added
    stated_weight     trace of the stated information of the mean, without cross terms over with
    rolling_K         deviation along the normal, by its own block, from the last K keyframes over that from all
    latest_K          the same from the last K keyframes that saw the Gaussian; `r_latest_K`: `r_chart` of these
    squared_gradients mean generalized eigenvalue of (2) and J^T R^-1 J over the directions that the latter knows;
                      `_least` and `_most`: the extremes; `_trace`: mean over the diagonal of the one entry over the
                      other; `_normal`: of the mean's blocks, along the normal; `_color`: of the color alone, as (2) is
                      printed
    normal_m          deviation of the mean along the normal, by its own block, of the covered pixels; `normal_m_color`
                      of the color alone; `squared_m`, `squared_m_color`: the same by (2)

Everything is one number for each Gaussian; infinite where nothing is known, NaN where there is nothing to compare.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.experiments.information_blocks import PARAMETERS, BlockSums
from duagc.pipeline.messages import GaussianInformation
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import COLOR, LOG_COVARIANCE, MEAN, pack_geometry

OF_PARAMETERS = {
    "mean": slice(0, 3),
    "quaternion": slice(3, 7),
    "scales": slice(7, 10),
    "color": slice(10, 13),
    "opacity": slice(13, 14),
}
OF_CHART = {"mean": MEAN, "shape": LOG_COVARIANCE, "color": COLOR, "opacity": slice(12, 13)}
PAIRS = tuple(itertools.combinations(OF_CHART, 2))
RANK_TOLERANCE = 1e-9
"""Least eigenvalue, of matrices of unit diagonal, that is information: float64 leaves 1e-13 of sums of a thousand
pixels, and float32 parameters are good to 1e-7."""


def measures(
    sums: BlockSums, gaussians: Gaussians, information: GaussianInformation, *, seed: int
) -> dict[str, Array]:
    """All measures by name, [r] each.

    Args:
        sums: of r Gaussians.
        gaussians: these.
        information: of them, as the stage wrote it.
        seed: of the random turns.
    """
    n = len(gaussians)
    normal = gaussians.normals()
    of_mm = np.ones(PARAMETERS)
    of_mm[OF_PARAMETERS["mean"]] = 1e-3
    unit = unit_diagonal(sums.parameters)
    out = {
        "r_meters": off_diagonal(sums.parameters, OF_PARAMETERS),
        "r_millimeters": off_diagonal(sums.parameters * np.outer(of_mm, of_mm), OF_PARAMETERS),
        "r_unit_diagonal": off_diagonal(unit, OF_PARAMETERS),
        "r_chart": off_diagonal(unit_diagonal(sums.chart), OF_CHART),
        "r_turned": off_diagonal(_turned(unit, seed), OF_PARAMETERS),
    }
    for a, b in PAIRS:
        out[f"{a}_{b}"] = canonical_correlation(sums.chart, OF_CHART[a], OF_CHART[b])

    marginal = {name: marginal_information(sums.chart, block) for name, block in OF_CHART.items()}
    own = {name: sums.chart[:, block, block] for name, block in OF_CHART.items()}
    tangents = _tangents(normal)
    for name, block, directions in (
        ("normal", "mean", normal[:, None, :]),
        ("surface", "mean", tangents),
        ("color", "color", np.broadcast_to(np.eye(3), (n, 3, 3))),
        ("opacity", "opacity", np.ones((n, 1, 1))),
    ):
        out[f"sigma_{name}"] = _over(_sigma(marginal[block], directions), _sigma(own[block], directions))

    stated = [_stated(sums.chart, W, gaussians, information) for W in (own["mean"], marginal["mean"])]
    out["stated_normal"] = _over(*(_sigma(W, normal[:, None, :]) for W in reversed(stated)))
    out["stated_surface"] = _over(*(_sigma(W, tangents) for W in reversed(stated)))
    out["stated_weight"] = _over(*(np.trace(W, axis1=1, axis2=2) for W in stated))

    of_all = _sigma(own["mean"], normal[:, None, :])
    for kind, windows in (("rolling", sums.rolling), ("latest", sums.latest)):
        for K, F in windows.items():
            out[f"{kind}_{K}"] = _over(_sigma(F[:, MEAN, MEAN], normal[:, None, :]), of_all)
            if kind == "latest":
                out[f"r_latest_{K}"] = off_diagonal(unit_diagonal(F), OF_CHART)

    for end, squared, covered in (
        ("", sums.squared, sums.covered),
        ("_color", sums.squared_color, sums.covered_color),
    ):
        name = f"squared_gradients{end}"
        out[name], out[f"{name}_least"], out[f"{name}_most"] = generalized_eigenvalues(squared, covered).T
        diagonals = [np.diagonal(F, axis1=1, axis2=2) for F in (squared, covered)]
        entries = _over(*diagonals)
        counted = np.maximum((~np.isnan(entries)).sum(axis=1), 1)
        out[f"{name}_trace"] = np.where(np.isnan(out[name]), np.nan, np.nansum(entries, axis=1) / counted)
        along = [np.einsum("ni,nij,nj->n", normal, F[:, MEAN, MEAN], normal) for F in (squared, covered)]
        out[f"{name}_normal"] = _over(*along)
        for kind, F in (("squared_m", squared), ("normal_m", covered)):
            out[f"{kind}{end}"] = _sigma(F[:, MEAN, MEAN], normal[:, None, :])
    return out


def off_diagonal(F: Array, blocks: Mapping[str, slice]) -> Array:
    """Frobenius norm of what is off the blocks over that of all, [n]; NaN of zero.

    Args:
        F: [n, d, d].
        blocks: by name.
    """
    kept = F.copy()
    for block in blocks.values():
        kept[:, block, block] = 0.0
    return _over(np.linalg.norm(kept, axis=(1, 2)), np.linalg.norm(F, axis=(1, 2)))


def unit_diagonal(F: Array) -> Array:
    """Information [n, d, d] over parameters in units of their conditional deviations; what is zero stays.

    Args:
        F: [n, d, d].
    """
    scale = _conditional_sigma(F)
    return F * scale[:, :, None] * scale[:, None, :]


def _conditional_sigma(F: Array) -> Array:
    """Deviations [n, d] of single parameters if all others are known; zero where nothing is known."""
    d = np.diagonal(F, axis1=1, axis2=2)
    return np.where(d > 0, 1 / np.sqrt(np.where(d > 0, d, 1.0)), 0.0)


def canonical_correlation(F: Array, a: slice, b: slice) -> Array:
    """Largest canonical correlation [n] of two blocks; 0 where one of them knows nothing.

    Args:
        F: [n, d, d], positive semidefinite.
        a: of the one block.
        b: of the other.
    """
    U = unit_diagonal(F)
    whitened = _root_inverse(U[:, a, a]) @ U[:, a, b] @ _root_inverse(U[:, b, b])
    return np.asarray(np.minimum(np.linalg.svd(whitened, compute_uv=False)[:, 0], 1.0))


def marginal_information(F: Array, block: slice) -> Array:
    """Information [n, k, k] on a block if the other parameters are unknown: the Schur complement.

    Args:
        F: [n, d, d], positive semidefinite.
        block: of k parameters.
    """
    inside = np.zeros(F.shape[1], bool)
    inside[block] = True
    to_rest = F[:, inside][:, :, ~inside]
    rest = F[:, ~inside][:, :, ~inside]
    half = to_rest * _conditional_sigma(rest)[:, None, :] @ _root_inverse(unit_diagonal(rest))
    return np.asarray(F[:, inside][:, :, inside] - half @ half.swapaxes(1, 2))


def generalized_eigenvalues(E: Array, F: Array) -> Array:
    """Mean, least and largest eigenvalue [n, 3] of F^-1 E over the directions that F knows; NaN if it knows none.

    Args:
        E: [n, d, d], positive semidefinite.
        F: [n, d, d], likewise.
    """
    scale = _conditional_sigma(F)
    values, vectors = np.linalg.eigh(unit_diagonal(F))
    out = np.full((len(F), 3), np.nan)
    for k in range(len(F)):
        known = values[k] > RANK_TOLERANCE * max(values[k, -1], 0.0)
        if values[k, -1] > 0:
            half = scale[k, :, None] * vectors[k][:, known] / np.sqrt(values[k, known])
            found = np.linalg.eigvalsh(half.T @ E[k] @ half)
            out[k] = found.mean(), found[0], found[-1]
    return out


def _root_inverse(U: Array) -> Array:
    """U^-1/2 [n, k, k] of matrices of unit diagonal; of directions without information zero."""
    values, vectors = np.linalg.eigh(U)
    known = values > RANK_TOLERANCE * np.maximum(values[:, -1:], RANK_TOLERANCE)
    roots = np.where(known, 1 / np.sqrt(np.where(known, values, 1.0)), 0.0)
    return np.asarray(vectors * roots[:, None, :] @ vectors.swapaxes(1, 2))


def _sigma(W: Array, directions: Array) -> Array:
    """Root [n] of the summed variances along directions [n, m, k] by information W [n, k, k]; infinite if unknown.

    A prior of RANK_TOLERANCE times the information of each parameter makes it finite in directions that are known to
    be unknown by comparison only.
    """
    d = np.diagonal(W, axis1=1, axis2=2)
    known: NDArray[np.bool_] = np.asarray((d > 0).all(axis=1))
    out = np.full(len(W), np.inf)
    prior = RANK_TOLERANCE * d[known][:, :, None] * np.eye(W.shape[1])
    covariance = np.linalg.inv(W[known] + prior)
    along = directions[known]
    out[known] = np.sqrt(np.maximum(np.einsum("nmi,nij,nmj->n", along, covariance, along), 0.0))
    return out


def _stated(chart: Array, mean: Array, gaussians: Gaussians, information: GaussianInformation) -> Array:
    """Information [n, 3, 3] of the mean that a robot states, with another block of the mean in its sums."""
    geometry = chart[:, :9, :9].copy()
    geometry[:, MEAN, MEAN] = mean
    changed = replace(information, geometry=pack_geometry(geometry).astype(np.float32))
    in_map = np.tile(np.eye(4), (int(gaussians.anchors.max(initial=0)) + 1, 1, 1))
    return Evidence.from_map(information.robot, gaussians, changed, in_map).position_information()


def _turned(U: Array, seed: int) -> Array:
    """Every matrix in coordinates that are turned at random, of unit diagonal again."""
    draws = random_streams.generator(seed, "turned information").normal(size=U.shape)
    Q, _ = np.linalg.qr(draws)
    return unit_diagonal(Q @ U @ Q.swapaxes(1, 2))


def _tangents(normals: Array) -> Array:
    """Two directions [n, 2, 3] across each normal [n, 3]."""
    aside = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = np.cross(normals, aside)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)], axis=1)


def _over(a: Array, b: Array) -> Array:
    """a / b; NaN where b is zero or infinite: then there is nothing to compare with."""
    known: NDArray[np.bool_] = np.isfinite(b) & (b > 0)
    return np.where(known, a / np.where(known, b, 1.0), np.nan)
