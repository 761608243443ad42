"""What a robot's own images say about Gaussians that it took over from neighbors: how opaque they are.

A neighbor's splat that hangs before what the own camera saw, or reaches over its edge, is contradicted by own pixels;
its owner's pixels could not tell. Both are evidence on the opacity. The owner's came with the splat, the own pixels
have said nothing on it yet; so its logit a goes where

    sum over own pixels |color drawn - color seen|^2 / (2 sigma^2)  +  1/2 W (a - a_owner)^2

is least, by some Gauss-Newton steps on all of them, the own map held fixed. What no own pixel sees stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.fusion.finetune import View
from duagc.pipeline.fusion.fuse import FusedMap
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import FisherSums, Rasterizer
from duagc.pipeline.splat.information import OPACITY, OPACITY_INFORMATION

LARGEST_RESIDUAL_SIGMA = 10.0  # what is farther off is no noise; it counts as that much
LARGEST_STEP, LARGEST_LOGIT = 2.0, 6.0


def weigh_by_own_pixels(
    fused: FusedMap,
    own: int,
    views: Sequence[View],
    camera: PinholeCamera,
    color_sigma: float,
    pixels_per_sample: float,
    config: FusionConfig,
    depth: DepthKind,
    threads: int = 1,
) -> FusedMap:
    """The fused map with new opacities of what was taken over; all else keeps every bit.

    Args:
        fused: own Gaussians first. own: how many these are.
        views: own keyframes at their corrected poses.
        color_sigma, pixels_per_sample: noise of these images, see `information.stage`.
        depth: as the map was made. threads: changes no bit.
    """
    taken = slice(own, None)
    if own == len(fused.gaussians):
        return fused
    told = fused.theta[taken, OPACITY]
    weight = fused.information[taken, OPACITY_INFORMATION]
    logits, gaussians = told.copy(), fused.gaussians
    rasterizer = Rasterizer(threads=threads)
    precision = np.float32(1 / (color_sigma**2 * pixels_per_sample))
    limit = np.float32(LARGEST_RESIDUAL_SIGMA * color_sigma)
    everywhere = np.full((camera.height, camera.width), precision, np.float32)
    nowhere = np.zeros_like(everywhere)
    for _ in range(config.own_pixel_steps):
        slope, sums = np.zeros(len(gaussians)), FisherSums(len(gaussians))
        for view in views:
            T_camera_world = se3.inverse(view.T_world_camera)
            render = rasterizer.forward(gaussians, camera, T_camera_world, mask=view.mask, depth_kind=depth)
            off = np.clip(render.color - view.color * np.float32(1 / 255), -limit, limit)
            if view.mask is not None:
                off[~view.mask] = 0.0
            slope += rasterizer.backward(off * precision).opacity_logits
            rasterizer.fisher(everywhere, nowhere, sums)
        seen = sums.opacity[taken]
        step = -(slope[taken] + weight * (logits - told)) / np.where(seen > 0, seen + weight, 1.0)
        moved = logits + np.clip(step, -LARGEST_STEP, LARGEST_STEP)
        logits = np.where(seen > 0, np.clip(moved, -LARGEST_LOGIT, LARGEST_LOGIT), logits)
        drawn = gaussians.opacity_logits.copy()
        drawn[taken] = logits
        gaussians = gaussians.replace(opacity_logits=drawn)
    theta = fused.theta.copy()
    theta[taken, OPACITY] = logits
    return replace(fused, gaussians=gaussians, theta=theta)
