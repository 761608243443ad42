"""The last part of the optimization of a map of tiles: the views of all tiles, each with all that it may see.

In a building a view shows more of other tiles than of its own, and a tile that is optimized alone knows few of the
views that look into it. So the end of the schedule goes over the views of all tiles in random order. A step draws and
moves what its view may see, whichever tile owns it; images are read when their turn comes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, SupportsIndex

import numpy as np

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.checkpoints import Checkpoints
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.frontend.growing_map import GrowingMap
from duagc.pipeline.frontend.view_poses import PoseSteps
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.kernels import LossWeights, Rasterizer
from duagc.pipeline.kernels.sparse_steps import LookedAt, SparseSteps
from duagc.pipeline.kernels.training import (
    ScaleLimits,
    TrainingStep,
    TrainingView,
    step_in_place,
)
from duagc.pipeline.splat.map_cells import MapCells
from duagc.pipeline.splat.optimizer import smoothstep_decay


@dataclass(frozen=True)
class JointView:
    """A view of any tile.

    Attributes:
        frame_index: of its images.
        T_map_camera: [4, 4], its pose at first.
        information: [6, 6] of the pose, by tracking (right tangent: translation m, rotation rad).
        fixed: whether the pose stays.
        read: gives its images; the pose they have there is not used.
    """

    frame_index: int
    T_map_camera: Array
    information: Array
    fixed: bool
    read: Callable[[], PosedRgbd]


class JointTraining:
    """Optimizes a map, and the poses of its views, over all of them."""

    def __init__(
        self,
        views: Sequence[JointView],
        camera: PinholeCamera,
        config: MappingConfig,
        *,
        depth: DepthKind,
        seed: int,
        threads: SupportsIndex = 1,
    ) -> None:
        """Begin at the given poses of the views, before the first step.

        Args:
            views: of all tiles.
            camera: of all of them.
            config: of the mapping.
            depth: of a Gaussian at a pixel.
            seed: of the run; the order of the views is drawn from it.
            threads: of the rasterizer; changes no bit.
        """
        self._views, self._camera, self._config, self._seed = views, camera, config, seed
        weights = LossWeights(**config.loss.of(depth).model_dump())
        self._step = TrainingStep(Rasterizer(threads=threads), weights, depth)
        self._limits = ScaleLimits.of(config)
        self._refined = config.pose_rate > 0 and depth != "ray_plane"
        self._pose_steps = PoseSteps([view.information for view in views])
        self._T_map_camera = np.array([view.T_map_camera for view in views])
        self._losses = np.full(len(views), np.nan)

    @property
    def poses(self) -> dict[int, Array]:
        """T_map_camera [4, 4] of the views by frame index, as refined so far."""
        return {view.frame_index: T for view, T in zip(self._views, self._T_map_camera, strict=True)}

    @property
    def losses(self) -> dict[int, float]:
        """The loss of each view that had a step, by frame index, before its last one."""
        losses = zip(self._views, self._losses, strict=True)
        return {view.frame_index: float(x) for view, x in losses if not np.isnan(x)}

    def run(self, whole: GrowingMap, steps: int, checkpoints: Checkpoints, part: str) -> int:
        """Take the steps.

        Args:
            whole: the map; changed in place.
            steps: how many.
            checkpoints: of the stage.
            part: its name there.

        Returns:
            How many Gaussians were removed.
        """
        config, count = self._config, len(self._views)
        first, cells = self._begin(whole, checkpoints.resume(part))
        in_all = round(steps / config.joint_share)  # as if tiles were no more than the beginning of it
        begun = in_all - steps
        sparse = SparseSteps(config.sparse, self._camera, in_all)
        turns = random_streams.in_turn(self._seed, "mapping.joint", count, first=first)
        for step in range(first, steps):
            chosen, visit = next(turns)
            looked_at = sparse.at(begun + step, visit)
            share = smoothstep_decay(begun + step, in_all, config.final_rate_decay)
            self._take_step(whole, cells, chosen, share=share, looked_at=looked_at)
            state = partial(self._state, cells, whole)
            checkpoints.at(part, step + 1, steps, state, shown=lambda: whole.gaussians)
        return whole.prune_transparent()

    def _begin(self, whole: GrowingMap, found: tuple[int, Any] | None) -> tuple[int, MapCells]:
        """The first step, and the cells of the map; goes on from what was found of a process before."""
        first = 0
        if found is None:
            cells = MapCells.of(whole.gaussians)
        else:
            first, (cells, pose_steps, self._T_map_camera, self._losses, of_map) = found
            self._pose_steps.go_on(pose_steps)
            whole.go_on(of_map)
        whole.gaussians = whole.gaussians.select(
            np.arange(len(whole))
        )  # of its own: steps change it in place
        return first, cells

    def _take_step(
        self, whole: GrowingMap, cells: MapCells, chosen: int, *, share: float, looked_at: LookedAt
    ) -> None:
        """One step of what a view may see, and of its pose."""
        T_map_camera = self._T_map_camera[chosen]
        posed = replace(self._views[chosen].read(), T_world_camera=T_map_camera)
        view = TrainingView.of(posed, self._step.loss)
        rows = cells.seen(view.depth_m, T_map_camera, self._camera)
        moves = self._refined and not self._views[chosen].fixed
        loss, gradients = self._step.gradients(
            whole.gaussians.select(rows),
            self._camera,
            looked_at.of(view),
            pose=moves,
            closing=looked_at.closing,
        )
        rates = self._config.rates.times(share)
        step_in_place(whole.gaussians, whole.adam, gradients, rates=rates, limits=self._limits, rows=rows)
        if moves:
            assert gradients.pose is not None  # it was asked for
            tangent = self._pose_steps.step(chosen, gradients.pose, self._config.pose_rate * share)
            self._T_map_camera[chosen] = T_map_camera @ se3.exp(tangent)
        self._losses[chosen] = loss.value

    def _state(self, cells: MapCells, whole: GrowingMap) -> tuple[Any, ...]:
        return cells, self._pose_steps.state(), self._T_map_camera, self._losses, whole.state()
