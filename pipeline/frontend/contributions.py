"""What each Gaussian contributes to images: what they would lack without it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.frontend.mapping_views import View, halve_depth
from duagc.pipeline.geometry import masks, se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.losses import halve


def contributions(
    gaussians: Gaussians,
    views: Sequence[View],
    rasterizer: Rasterizer,
    config: MappingConfig,
    *,
    camera: PinholeCamera,
    depth: DepthKind,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Squared change of images, in units of the noise, if a Gaussian was removed; and if any saw it.

    It is measured in small images, each pixel of which counts for all that it is made of.

    A pixel is linear in each Gaussian's blending factor, and the derivative by the opacity logit is that
    factor's derivative times (1 - opacity), so the Gauss-Newton information of the logit divided by
    (1 - opacity)^2 is exactly the sum of squared changes.

    Args:
        gaussians: n of the map.
        views: that are looked at.
        rasterizer: that draws them.
        config: size of the small images, and noise.
        camera: of the views.
        depth: kind of the map.
    Returns:
        [n] both.
    """
    information, observations = np.zeros(len(gaussians)), np.zeros(len(gaussians), np.uint32)
    small, level = camera.halved(), 1
    while small.width * small.height > config.contribution_pixels:
        small, level = small.halved(), level + 1
    of_color, of_depth = (
        np.float32(4**level / sigma**2)
        for sigma in (config.contribution_color_sigma, config.contribution_depth_sigma_m)
    )
    inverse_color = np.full((small.height, small.width), of_color)
    for view in views:
        mask, depth_m, certainty = view.half_mask, view.half_depth_m, view.half_certainty
        for _ in range(level - 1):
            mask = None if mask is None else masks.halved(mask)
            depth_m = halve_depth(depth_m)
            certainty = None if certainty is None else halve(certainty)
        rasterizer.forward(gaussians, small, se3.inverse(view.T_map_camera), mask=mask, depth_kind=depth)
        inverse_depth = (depth_m > 0) * of_depth
        if certainty is not None:
            inverse_depth = inverse_depth * certainty**2
        rasterizer.opacity_information(inverse_color, inverse_depth, information, observations)
    transparency = 1.0 / (1.0 + np.exp(gaussians.opacity_logits.astype(np.float64)))
    return information / transparency**2, observations > 0
