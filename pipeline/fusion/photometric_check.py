"""A peer's map held against own images: what it explains of them, and which of its Gaussians they contradict.

What that means is said in `pipeline.fusion.peer_validation`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.fusion import PeerValidationConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.correlated_blocks import CorrelatedBlocks
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.geometry.projection import visible
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import MEAN, gaussians_of


class ColorStatistics:
    """Variance of colors 0..1, summed as they come."""

    def __init__(self, least_variance: float) -> None:
        """Begin without colors.

        Args:
            least_variance: of colors 0..1; `variance` is never less.
        """
        self.least_variance = least_variance
        self.pixels, self._sum, self._squares = 0, np.zeros(3), np.zeros(3)

    def add(self, colors: NDArray[np.float32]) -> None:
        """Take in colors.

        Args:
            colors: [..., 3], 0..1.
        """
        c = colors.reshape(-1, 3)
        self.pixels += len(c)
        self._sum += c.sum(axis=0, dtype=np.float64)
        self._squares += (c**2).sum(axis=0, dtype=np.float64)

    @property
    def variance(self) -> float:
        """Mean over the channels, of colors 0..1; not below the least one."""
        n = max(self.pixels, 1)
        return max(float(np.mean(self._squares / n - (self._sum / n) ** 2)), self.least_variance)


class PhotometricCheck:
    """Renders one peer's map at own keyframes.

    Attributes:
        explained: share of the variance of own pixels that the map must explain.
        own: own colors at the pixels on which the whole map was compared.
        color_mse: mean squared error of the map there, colors 0..1.
        num_contradicted: Gaussians that own images contradict.
    """

    def __init__(
        self,
        views: Sequence[PosedRgbd],
        context: MapContext,
        depth_kind: DepthKind,
        config: PeerValidationConfig,
        *,
        arrived: float,
    ) -> None:
        """Begin with nothing drawn.

        Args:
            views: own images, posed in the world.
            context: camera, settings and threads.
            depth_kind: depth of a Gaussian at a pixel, as the peer's map was made.
            config: thresholds of the check.
            arrived: share of the peer's map that arrived, 0..1.
        """
        self.explained = config.min_explained_variance * arrived
        self.views, self.context, self.depth_kind, self.config = views, context, depth_kind, config
        self.rasterizer = Rasterizer(threads=context.threads)
        self.own, self.color_mse = ColorStatistics(config.min_color_variance), 0.0
        self._seen_px = 0  # that saw the whole map
        self._correlates = False
        self.num_contradicted = 0

    def trusted(self, own_px: int) -> bool:
        """Whether the map explains own images, or blocks of them correlate with it, or too few own pixels see it.

        Of a map with holes as much is expected as there is of it; what is wrong explains nothing, however little it is.

        Args:
            own_px: number of all own pixels.
        """
        few = self._seen_px < self.config.min_overlap * own_px
        return self._explains or few or self._correlates

    @property
    def _explains(self) -> bool:
        """Whether the colors of the map explain enough where it is seen."""
        return self.color_mse <= (1 - self.explained) * self.own.variance

    def contradicted(self, world: Evidence, gray: float) -> NDArray[np.bool_]:
        """Which Gaussians [n] own images contradict: their mean squared error is above `gray`.

        Args:
            world: n Gaussians of the peer, in the world of the views.
            gray: variance of own colors 0..1.
        """
        gaussians = gaussians_of(world.ids, world.anchors, world.theta)
        against = self._against(gaussians, world, gray)
        self._correlates = not self._explains and self._blocks_correlate(gaussians)
        return against

    def _against(self, gaussians: Gaussians, world: Evidence, gray: float) -> NDArray[np.bool_]:
        """Which Gaussians [n] are contradicted, if need be by those that do not stand in free space."""
        against = self._judged(gaussians, np.zeros(len(world), bool), gray)
        if self._explains:
            return against
        free, seen = self._in_free_space(world.theta[:, MEAN])
        if free.any() and np.sum(free) <= self.config.max_in_free_space * np.sum(seen):
            self.explained = max(self.explained, self.config.min_explained_by_rest)
            against = self._judged(gaussians, free, gray)
        return against

    def _judged(self, gaussians: Gaussians, without: NDArray[np.bool_], gray: float) -> NDArray[np.bool_]:
        """Which Gaussians [n] are contradicted, drawn without some, which are; own colors are counted anew.

        If it explains too little because of few of them, it is judged by the rest.
        """
        against, judged = without.copy(), np.zeros_like(without)
        for turn in range(self.config.passes):
            rows = np.flatnonzero(~against)
            errors = self._errors(gaussians.select(rows), count=turn == 0)
            if not (turn or without.any()):
                self._seen_px = self.own.pixels
            against[rows[errors > gray]] = True
            judged[rows[errors > 0]] = True
        false_share = int(np.sum(against & ~without)) / max(int(np.sum(judged)), 1)
        if not self._explains and false_share <= self.config.max_contradicted:  # what is not used may be why
            self._errors(gaussians.select(~against), count=True)
            self.explained = max(self.explained, self.config.min_explained_by_rest)
        return against

    def _in_free_space(self, means_world: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which places [n, 3] most own depth images that see as far measured beyond; and which any of them saw."""
        config, camera = self.context.config, self.context.camera
        beyond, there = np.zeros((2, len(means_world)), np.int64)
        for view in self.views:
            at = se3.transform(se3.inverse(view.T_world_camera), means_world)
            index, column, row = visible(camera, at)
            z, measured_m = at[index, 2], view.usable_depth[row, column].astype(np.float64)
            slack_m = config.explained_m + config.explained_relative * z
            known = measured_m > 0
            beyond[index] += known & (measured_m > z + slack_m)
            there[index] += known & (np.abs(measured_m - z) <= slack_m)
        return beyond > there, beyond + there > 0

    def _blocks_correlate(self, gaussians: Gaussians) -> bool:
        """Whether own images show in many blocks what the map shows there."""
        found = CorrelatedBlocks()
        for view in self.views:
            color, judged = self._shown(gaussians, view)
            found.add(view.unit_color, color, judged)
        return found.blocks >= self.config.min_blocks and found.share >= self.config.min_correlated

    def _shown(self, gaussians: Gaussians, view: PosedRgbd) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Colors [h, w, 3] of the map in an own view, and the pixels at which it shows a surface that is not hidden."""
        render = self.rasterizer.forward(
            gaussians,
            self.context.camera,
            se3.inverse(view.T_world_camera),
            mask=view.mask,
            depth_kind=self.depth_kind,
        )
        fusion, least = self.context.config, self.config.min_opacity
        alpha = np.maximum(render.alpha, np.float32(least))
        reach = view.depth_m * (1 + fusion.explained_relative) + fusion.explained_m
        judged = (render.alpha >= least) & (view.depth_m > 0) & (render.depth / alpha <= reach)
        return render.color / alpha[..., None], judged

    def _errors(self, gaussians: Gaussians, *, count: bool) -> Array:
        """Mean squared error of the pixels of each Gaussian [n], zero of too few; `count`: own colors there, anew."""
        if count:
            self.own = ColorStatistics(self.config.min_color_variance)
        errors, weights = np.zeros(len(gaussians)), np.zeros(len(gaussians))
        total = 0.0
        for view in self.views:
            color, judged = self._shown(gaussians, view)
            off = color - view.unit_color
            images = np.zeros_like(color)
            images[..., 0] = np.where(judged, np.mean(np.clip(off, -1, 1) ** 2, axis=2), 0)
            images[..., 1] = judged
            sums = self.rasterizer.backward(images).colors  # of weight times image, over the pixels
            errors, weights = errors + sums[:, 0], weights + sums[:, 1]
            total += float(images[..., 0].sum(dtype=np.float64))
            if count:
                self.own.add(view.unit_color[judged])
        if count:
            self.color_mse = total / max(self.own.pixels, 1)
        least_px = self.config.min_gaussian_px
        return np.where(weights >= least_px, errors / np.maximum(weights, least_px), 0.0)
