"""The opacities of imported Gaussians by the robot's own images.

A peer's splat that lies in front of what the own camera saw, or reaches over its edge, is contradicted by own pixels;
the owner's pixels did not cover that view. Both are evidence on the opacity. The owner's came with the splat, the own
pixels have not been used on it yet; so its logit a goes where

    sum over own pixels |color rendered - color seen|^2 / (2 sigma^2)  +  1/2 W (a - a_owner)^2

is least, by some Gauss-Newton steps, the own map held fixed. Every step looks at every second block of pixels, which
counts twice, the next one at the others. What no own pixel sees stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.fuse import FusedMap
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.kernels.sparse_steps import checkerboards
from duagc.pipeline.kernels.training import LARGEST_LOGIT
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import OPACITY, OPACITY_INFORMATION
from duagc.pipeline.splat.map_cells import MapCells

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
    imported = slice(num_own, None)
    if num_own == len(fused.gaussians):
        return fused
    owners = fused.theta[imported, OPACITY]
    weight = fused.information[imported, OPACITY_INFORMATION]
    logits, gaussians = owners.copy(), fused.gaussians
    precision = np.float32(2 / (color_sigma**2 * pixels_per_sample))
    pixels = _OwnPixels(views, context, precision, np.float32(LARGEST_RESIDUAL_SIGMA * color_sigma))
    for k in range(context.config.own_pixel_steps):
        slope, seen = (sums[imported] for sums in pixels.sums(gaussians, half=k % 2))
        step = -(slope + weight * (logits - owners)) / np.where(seen > 0, seen + weight, 1.0)
        moved = logits + np.clip(step, -LARGEST_STEP, LARGEST_STEP)
        logits = np.where(seen > 0, np.clip(moved, -LARGEST_LOGIT, LARGEST_LOGIT), logits)
        drawn = gaussians.opacity_logits.copy()
        drawn[imported] = logits
        gaussians = gaussians.replace(opacity_logits=drawn)
    theta = fused.theta.copy()
    theta[imported, OPACITY] = logits
    return replace(fused, gaussians=gaussians, theta=theta)


class _OwnPixels:
    """Own images, and what they say on the opacities of a map."""

    def __init__(
        self, views: Sequence[PosedRgbd], context: MapContext, precision: np.float32, limit: np.float32
    ) -> None:
        """Prepare the rasterizer and the two halves of the pixels; nothing is drawn yet.

        Args:
            views: the images.
            context: camera and settings.
            precision: of a color channel of a pixel that is looked at.
            limit: largest residual of a color.
        """
        self._views, self._context, self._limit = views, context, limit
        camera = context.camera
        self._everywhere = np.full((camera.height, camera.width), precision, np.float32)
        self._nowhere, self._precision = np.zeros_like(self._everywhere), precision
        self._halves = checkerboards(camera.height, camera.width)
        self._rasterizer = Rasterizer(threads=context.threads)
        self._cells: MapCells | None = None

    def sums(self, gaussians: Gaussians, half: int) -> tuple[Array, Array]:
        """Slope and information of the opacity logits [n] of a map by one half of the pixels, 0 or 1.

        Other parameters of the map never change.
        """
        slope, information = np.zeros(len(gaussians)), np.zeros(len(gaussians))
        if len(self._views) <= self._context.config.finetune.keyframes:
            for view in self._views:
                slope += self._of_view(view, gaussians, information, half=half)
            return slope, information
        self._cells = self._cells or MapCells.of(gaussians)
        for view in self._views:
            rows = self._cells.seen(view.depth_m, view.T_world_camera, self._context.camera)
            of_view = np.zeros(len(rows))
            slope[rows] += self._of_view(view, gaussians.select(rows), of_view, half=half)
            information[rows] += of_view
        return slope, information

    def _of_view(
        self, view: PosedRgbd, gaussians: Gaussians, information: Array, *, half: int
    ) -> NDArray[np.float32]:
        """The slope by a half of a view; its information is added."""
        pixels = self._halves[half] if view.mask is None else self._halves[half] & view.mask
        render = self._rasterizer.forward(
            gaussians,
            self._context.camera,
            se3.inverse(view.T_world_camera),
            mask=pixels,
            depth_kind=self._context.depth_kind,
        )
        off = np.clip(render.color - view.unit_color, -self._limit, self._limit)
        off[~pixels] = 0.0
        slope = self._rasterizer.backward(off * self._precision).opacity_logits
        observations = np.zeros(len(gaussians), np.uint32)
        self._rasterizer.opacity_information(self._everywhere, self._nowhere, information, observations)
        return slope
