"""The opacities of imported Gaussians by the robot's own images.

A peer's splat that lies in front of what the own camera saw, or reaches over its edge, is contradicted by own pixels;
the owner's pixels did not cover that view. Both are evidence on the opacity. The owner's came with the splat, the own
pixels have not been used on it yet; so its logit a goes where

    sum over own pixels |color rendered - color seen|^2 / (2 sigma^2)  +  1/2 W (a - a_owner)^2

is least, by some Gauss-Newton steps on all of them, the own map held fixed. What no own pixel sees stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.fuse import FusedMap
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.kernels import FisherSums, Rasterizer
from duagc.pipeline.kernels.training import LARGEST_LOGIT
from duagc.pipeline.splat.information import OPACITY, OPACITY_INFORMATION

LARGEST_RESIDUAL_SIGMA = 10.0  # residuals are clipped there: beyond it they are outliers, not noise
LARGEST_STEP = 2.0


def update_opacities(
    fused: FusedMap,
    views: Sequence[PosedRgbd],
    context: MapContext,
    *,
    num_own: int,
    color_sigma: float,
    pixels_per_sample: float,
) -> FusedMap:
    """The fused map with new opacities of the imported Gaussians; all else keeps every bit.

    Args:
        fused: own Gaussians first.
        views: own keyframes at their corrected poses.
        context: camera and settings.
        num_own: how many Gaussians are own ones.
        color_sigma: standard deviation of these images' color channels, 0..1.
        pixels_per_sample: neighboring pixels that are worth one independent one (`information.noise`).
    """
    camera, imported = context.camera, slice(num_own, None)
    if num_own == len(fused.gaussians):
        return fused
    owners = fused.theta[imported, OPACITY]
    weight = fused.information[imported, OPACITY_INFORMATION]
    logits, gaussians = owners.copy(), fused.gaussians
    rasterizer = Rasterizer(threads=context.threads)
    precision = np.float32(1 / (color_sigma**2 * pixels_per_sample))
    limit = np.float32(LARGEST_RESIDUAL_SIGMA * color_sigma)
    everywhere = np.full((camera.height, camera.width), precision, np.float32)
    nowhere = np.zeros_like(everywhere)
    for _ in range(context.config.own_pixel_steps):
        slope, sums = np.zeros(len(gaussians)), FisherSums(len(gaussians))
        for view in views:
            T_camera_world = se3.inverse(view.T_world_camera)
            render = rasterizer.forward(
                gaussians, camera, T_camera_world, mask=view.mask, depth_kind=context.depth_kind
            )
            off = np.clip(render.color - view.unit_color, -limit, limit)
            if view.mask is not None:
                off[~view.mask] = 0.0
            slope += rasterizer.backward(off * precision).opacity_logits
            rasterizer.fisher(everywhere, nowhere, sums)
        seen = sums.opacity[imported]
        step = -(slope[imported] + weight * (logits - owners)) / np.where(seen > 0, seen + weight, 1.0)
        moved = logits + np.clip(step, -LARGEST_STEP, LARGEST_STEP)
        logits = np.where(seen > 0, np.clip(moved, -LARGEST_LOGIT, LARGEST_LOGIT), logits)
        drawn = gaussians.opacity_logits.copy()
        drawn[imported] = logits
        gaussians = gaussians.replace(opacity_logits=drawn)
    theta = fused.theta.copy()
    theta[imported, OPACITY] = logits
    return replace(fused, gaussians=gaussians, theta=theta)
