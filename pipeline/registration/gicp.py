"""Registration of two views' points by generalized ICP (package small_gicp), to compare with.

Points alone: no gray values, no features. It starts from a given motion and narrows the distance at which points
correspond. Its residuals have no unit, so its information is scaled by what they come to.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.packages import NO_GICP
from duagc.pipeline.config.registration import GicpConfig

_NEIGHBORS = 20  # points from which a covariance is estimated
_LEAST_POINTS = 100


@dataclass(frozen=True)
class GicpResult:
    """Result of `register_points`.

    Attributes:
        T_target_source: [4, 4].
        information: [6, 6] of its right tangent, translation first.
        inliers: source points with a target point within the last distance.
        points: source points.
    """

    T_target_source: Array
    information: Array
    inliers: int
    points: int

    @property
    def overlap(self) -> float:
        """Share of the source points that correspond."""
        return self.inliers / max(self.points, 1)


def small_gicp() -> Any:
    """The package.

    Raises:
        DuagError: it is not installed.
    """
    try:
        import small_gicp as package
    except ImportError as error:
        raise DuagError(NO_GICP) from error
    return package


def register_points(
    target: Array, source: Array, T_target_source: Array, config: GicpConfig
) -> GicpResult | None:
    """Lay the points of one view onto those of another; None if either has too few, or no step was possible.

    Args:
        target: points [n, 3], meters.
        source: points [m, 3], meters.
        T_target_source: [4, 4], where it starts.
        config: resolution, distances.

    Raises:
        DuagError: the package is not installed.
    """
    package = small_gicp()
    clouds = []
    for points in (target, source):
        cloud = package.voxelgrid_sampling(np.ascontiguousarray(points, np.float64), config.voxel_m)
        if cloud.size() < _LEAST_POINTS:
            return None
        package.estimate_covariances(cloud, num_neighbors=_NEIGHBORS)
        clouds.append(cloud)
    tree = package.KdTree(clouds[0])
    T, result = np.asarray(T_target_source, np.float64), None
    for distance_m in config.distances_m:
        result = package.align(
            clouds[0],
            clouds[1],
            tree,
            init_T_target_source=T,
            registration_type="GICP",
            max_correspondence_distance=distance_m,
            max_iterations=config.iterations,
        )
        T = np.asarray(result.T_target_source, np.float64)
        if result.num_inliers < _LEAST_POINTS or not np.isfinite(T).all():
            return None
    assert result is not None
    H = np.asarray(result.H, np.float64)
    turned = np.block([[H[3:, 3:], H[3:, :3]], [H[:3, 3:], H[:3, :3]]])  # rotation first there
    variance = max(2 * float(result.error) / result.num_inliers, 1e-12)
    return GicpResult(T, turned / variance, int(result.num_inliers), int(clouds[1].size()))
