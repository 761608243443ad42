"""How far the Gaussians of a map lie from the true surface, and how far they were predicted to lie."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.evaluation import uncertainty_calibration
from duagc.pipeline.evaluation.groundtruth import Surface
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry import se3
from duagc.pipeline.messages import GaussianMap
from duagc.pipeline.runs.folder import position_information
from duagc.pipeline.splat.information import sigma_along

MIN_GAUSSIANS = 100
NAMES = (
    "ece_paper", "ece_rank", "ece_rank_if_right", "ece_rank_shuffled", "spearman", "ause", "nll", "coverage_95",
    "nll_scaled", "coverage_95_scaled", "sigma_scale", "gaussians", "gaussians_without_information",
)  # fmt: skip


@dataclass(frozen=True)
class MapErrors:
    """One row per Gaussian with full position information.

    Attributes:
        error_m: distance from the nearest surface.
        sigma_m: predicted standard deviation of that distance, along the surface normal.
        paper_uncertainty: 1 / sqrt of the trace of the position information, as the companion code has it.
        without_information: Gaussians left out, because a direction of their position is not determined.
    """

    error_m: Array
    sigma_m: Array
    paper_uncertainty: Array
    without_information: int


def map_errors(gaussian_map: GaussianMap, surface: Surface, T_gt_map: Array) -> MapErrors:
    """Measure a map against the true surface.

    Args:
        gaussian_map: with information, in its frame.
        surface: the true one, in the ground-truth world.
        T_gt_map: [4, 4], from that frame into the ground-truth world.
    """
    means_gt = se3.transform(T_gt_map, gaussian_map.gaussians.means.astype(np.float64))
    error_m, normals_gt = surface.closest(means_gt)
    F = np.zeros((len(means_gt), 3, 3))
    if gaussian_map.information is not None:
        F = position_information(gaussian_map.information.geometry)
    sigma_m, determined = sigma_along(F, normals_gt @ T_gt_map[:3, :3])
    return MapErrors(
        error_m[determined],
        sigma_m[determined],
        1.0 / np.sqrt(np.trace(F[determined], axis1=1, axis2=2)),
        int(np.count_nonzero(~determined)),
    )


def scores(errors: MapErrors, robot: str) -> dict[str, Any]:
    """All calibration numbers of one map, in the names of metrics.json.

    The scale of `nll_scaled` and `coverage_95_scaled` is fitted on every second Gaussian and judged on the
    others.

    Args:
        errors: of the Gaussians that have full position information.
        robot: whose map it is; it names the random streams and stands in the reason of absent values.
    """
    n = len(errors.error_m)
    if n < MIN_GAUSSIANS:
        absent = Absent(
            f"only {n} Gaussians of {robot} have full position information, {MIN_GAUSSIANS} are needed"
        )
        counts = {"gaussians": n, "gaussians_without_information": errors.without_information}
        return {name: counts.get(name, absent) for name in NAMES}
    sigma, error = errors.sigma_m, errors.error_m
    scale = uncertainty_calibration.fitted_scale(sigma[::2], error[::2])
    judged = scale * sigma[1::2], error[1::2]
    return {
        "ece_paper": uncertainty_calibration.ece_paper(errors.paper_uncertainty, error),
        "ece_rank": uncertainty_calibration.ece_rank(sigma, error),
        "ece_rank_if_right": uncertainty_calibration.ece_rank(
            sigma, uncertainty_calibration.if_right(sigma, robot)
        ),
        "ece_rank_shuffled": uncertainty_calibration.ece_rank(
            uncertainty_calibration.shuffled(sigma, robot), error
        ),
        "spearman": uncertainty_calibration.spearman(sigma, error),
        "ause": uncertainty_calibration.ause(sigma, error),
        "nll": uncertainty_calibration.nll(sigma, error),
        "coverage_95": uncertainty_calibration.coverage_95(sigma, error),
        "nll_scaled": uncertainty_calibration.nll(*judged),
        "coverage_95_scaled": uncertainty_calibration.coverage_95(*judged),
        "sigma_scale": scale,
        "gaussians": n,
        "gaussians_without_information": errors.without_information,
    }
