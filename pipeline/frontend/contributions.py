"""What each Gaussian contributes to images: what they would lack without it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.frontend.mapping_views import View
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians


def contributions(
    gaussians: Gaussians,
    views: Sequence[View],
    rasterizer: Rasterizer,
    config: MappingConfig,
    *,
    camera: PinholeCamera,
    depth: DepthKind,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Squared change of views' half-size images, in units of the noise, if a Gaussian was removed; and if any saw it.

    A pixel is linear in each Gaussian's blending factor, and the derivative by the opacity logit is that
    factor's derivative times (1 - opacity), so the Gauss-Newton information of the logit divided by
    (1 - opacity)^2 is exactly the sum of squared changes.

    Args:
        gaussians: n of the map.
        views: that are looked at.
        rasterizer: that draws them.
        config: noise of the images.
        camera: of the half-size images.
        depth: kind of the map.
    Returns:
        [n] both.
    """
    information, observations = np.zeros(len(gaussians)), np.zeros(len(gaussians), np.uint32)
    inverse_color = np.full((camera.height, camera.width), config.contribution_color_sigma**-2, np.float32)
    for view in views:
        rasterizer.forward(
            gaussians, camera, se3.inverse(view.T_map_camera), mask=view.half_mask, depth_kind=depth
        )
        inverse_depth = (view.half_depth_m > 0) * np.float32(config.contribution_depth_sigma_m**-2)
        if view.half_certainty is not None:
            inverse_depth = inverse_depth * view.half_certainty**2
        rasterizer.opacity_information(inverse_color, inverse_depth, information, observations)
    transparency = 1.0 / (1.0 + np.exp(gaussians.opacity_logits.astype(np.float64)))
    return information / transparency**2, observations > 0
