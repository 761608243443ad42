"""Whether peers' Gaussians are as far from the surfaces that own depth images show as their information states.

A robot measures how far its Gaussians are from the surfaces of its own depth images. It cannot see an error that all of
its views share, as those of a stereo camera do. A peer looks from elsewhere, with a camera of its own. What the two
disagree by, in units of what is stated, says how many times the stated deviations are too small.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import NormalDist

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.fusion import StatedScaleConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.surface_distance import DepthView, median_distances
from duagc.pipeline.splat.information import MEAN, gaussians_of, sigma_along


def stated_scale(
    peers: Iterable[Evidence], camera: PinholeCamera, views: Sequence[DepthView], config: StatedScaleConfig
) -> float:
    """The factor on stated standard deviations of positions that own depth images ask for; 1 if they ask for none.

    Where deviations are right, a share p of the ratios |distance| / sigma is below the quantile of a normal error. The
    share is one at which most errors are those of the surface in question; the largest ratios are of others behind it.
    A factor below 1 is not taken: what both robots see well says little of the rest of a map.

    Each peer asks for a factor of its own, and the median counts, of two the smaller: a minority of peers that state
    too little does not make the robot's own map uncertain. What a single peer asks for is bounded as well.

    Args:
        peers: evidence of each that is used, in the frame of the views.
        camera: the robot's own.
        views: its own depth images.
        config: which Gaussians count, the share, the bounds.
    """
    ratios = (_ratios(peer, camera, views, config) for peer in peers)
    asked = sorted(factor for some in ratios if (factor := _asked(some, config)) is not None)
    if not asked:
        return 1.0
    return min(max(1.0, asked[(len(asked) - 1) // 2]), config.most)


def _asked(ratios: Array, config: StatedScaleConfig) -> float | None:
    """The factor that makes the ratios of a peer those of normal errors; None for too few."""
    if len(ratios) < config.min_gaussians:
        return None
    return float(np.quantile(ratios, config.share)) / NormalDist().inv_cdf(0.5 * (1 + config.share))


def _ratios(
    peer: Evidence, camera: PinholeCamera, views: Sequence[DepthView], config: StatedScaleConfig
) -> Array:
    """|distance| / sigma along the normals of the Gaussians that enough views measured a surface near."""
    counts, off_m = median_distances(peer.theta[:, MEAN], camera, views, config.gate_m)
    seen = counts >= config.min_views
    some = peer.select(seen)
    normals = gaussians_of(some.ids, some.anchors, some.theta).normals()
    sigma_m, determined = sigma_along(some.position_information(), normals)
    return np.asarray((np.abs(off_m[seen]) / sigma_m)[determined])
