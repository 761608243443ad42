"""How far a map's Gaussians are from the surfaces that the depth images show."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.surface_distance import DepthView, median_distances
from duagc.pipeline.splat.gaussians import Gaussians


def surface_deviation(
    gaussians: Gaussians, camera: PinholeCamera, views: Iterable[DepthView], gate_m: float
) -> NDArray[np.float64]:
    """How far every Gaussian's mean is from the surface that the depth images show, meters [n].

    Overlapping splats compensate for each other's positions: where their sum is drawn to a millimeter, each may be a
    centimeter off, and no pixel shows it. Depth images do (`median_distances`). What no view shows, because neighbors
    or all views share it, counts as half of what is typical: of the median of these distances over all Gaussians. A
    Gaussian that no view measured has the gate.

    Args:
        gaussians: of a map.
        camera: of the views.
        views: of the robot that made the map, in its frame; the more, the less noise is left.
        gate_m: a surface farther than this from a Gaussian belongs to another one.
    """
    counts, off_m = median_distances(gaussians.means.astype(np.float64), camera, views, gate_m)
    measured, deviation_m = counts > 0, np.full(len(gaussians), gate_m)
    if measured.any():
        typical_m = np.median(np.abs(off_m[measured]))
        deviation_m[measured] = np.hypot(off_m[measured], 0.5 * typical_m)
    return deviation_m
