"""Finetuning of a fused map on the robot's own images, and on renders of its peers' maps, at the corrected poses.

Consensus moves keyframes and fusion moves Gaussians; neither checks that the result still renders the images. So the
map takes some steps of the mapper's own kind: color and depth loss of the robot's keyframes and frames between them,
never of held-out ones. Own images alone would fit the map to the robot's own viewpoints and to no others, so renders of
peers' maps from the peers' keyframes (`peer_views`) are mixed in; own images, which are measurements, come last.
Without such views only the robot's own Gaussians are trained: the few own views that see an imported one, from afar or
through a door, have less information on it than its owner's many. The information of the Gaussians stays that of
before: what is learned here comes from the same pixels and is not counted again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS, Checkpoints
from duagc.pipeline.config.fusion import FinetuneConfig
from duagc.pipeline.config.training import DepthKind, LearningRates
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.kernels import CompiledAdam, LossWeights, Rasterizer
from duagc.pipeline.kernels.sparse_steps import LookedAt, SparseSteps
from duagc.pipeline.kernels.training import (
    ScaleLimits,
    TrainingStep,
    TrainingView,
    step_in_place,
)
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.map_cells import MapCells
from duagc.pipeline.splat.optimizer import smoothstep_decay

PEERS_UNTIL = 0.6
"""Share of the steps after which only own images are used."""
PART = "training"


def num_steps(
    config: FinetuneConfig, own_views: int, peer_views: int, keyframes: int = 0, *, depth: DepthKind
) -> tuple[int, int]:
    """How many steps the training takes on own views and on views of peers' maps.

    Args:
        config: schedule.
        own_views: how many there are.
        peer_views: how many there are.
        keyframes: of the robot.
        depth: of a Gaussian at a pixel.
    """
    steps = min(config.steps(depth).per_view * own_views, config.at_most(config.steps_max, keyframes))
    return steps, round(config.peer_share * steps) if peer_views else 0


def finetune_map(
    gaussians: Gaussians,
    views: Sequence[PosedRgbd],
    context: MapContext,
    *,
    trained: NDArray[np.bool_] | None = None,
    peer_views: Sequence[PosedRgbd] = (),
    keyframes: int = 0,
    steps: tuple[int, int] | None = None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> Gaussians:
    """The map after some training steps, each on one view.

    Own views come in random order, each once before any comes again; peer views likewise, evenly spread among the
    first steps. Of a long log a step takes only what its view may see (`map_cells`).

    Args:
        gaussians: in the world frame of the views.
        views: own images.
        context: camera and settings; `config.finetune` is the schedule.
        trained: bool [n], which of the Gaussians may change; None: all.
        peer_views: as peers' maps show them.
        keyframes: of the robot: of a longer log there are more steps.
        steps: on own views and on views of peers' maps; None: as of `num_steps`.
        checkpoints: of the stage.
    Returns:
        As many Gaussians, in the same order, with the same ids and anchors.
    """
    config = context.config.finetune
    own_steps, peer_steps = steps or num_steps(
        config, len(views), len(peer_views), keyframes, depth=context.depth_kind
    )
    if not own_steps or not len(gaussians):
        return gaussians
    total, rate = own_steps + peer_steps, config.steps(context.depth_kind).rate
    head = max(peer_steps, round(PEERS_UNTIL * total))
    training = _Training(gaussians, context, trained, in_parts=keyframes > config.keyframes)
    # the streams keep the names that they had: under other names they would draw other views
    own = random_streams.in_turn(context.seed, "fusion.refine", len(views))
    peer = random_streams.in_turn(context.seed, "fusion.refine.peers", len(peer_views))
    sparse = SparseSteps(config.sparse, context.camera, total)
    first = 0
    if (saved := checkpoints.resume(PART)) is not None:
        first, state = saved
        training.go_on(state)
    for step in range(total):
        of_peer = step < head and (step + 1) * peer_steps // head > step * peer_steps // head
        number, visit = next(peer if of_peer else own)
        if step < first:
            continue  # its view was taken by the process before
        share = rate * smoothstep_decay(step, total, config.rate_decay)
        view = (peer_views if of_peer else views)[number]
        training.step(view, sparse.at(step, visit, view.camera), config.rates.times(share))
        checkpoints.at(PART, step + 1, total, training.state)
    return training.gaussians


class _Training:
    """A map that is trained, whole or what a view may see of it."""

    def __init__(
        self,
        gaussians: Gaussians,
        context: MapContext,
        trained: NDArray[np.bool_] | None,
        *,
        in_parts: bool,
    ) -> None:
        self.gaussians = gaussians.copy()  # it changes in place
        self._trained, self._camera = trained, context.camera
        weights = LossWeights(**context.config.finetune.loss.of(context.depth_kind).model_dump())
        self._take = TrainingStep(Rasterizer(threads=context.threads), weights, context.depth_kind)
        self._adam = CompiledAdam(len(gaussians), threads=context.threads)
        floor_m = context.matching.thickness_floor_m
        # thinner ones stay as they are
        self._floor = np.minimum(gaussians.log_scales, np.float32(np.log(floor_m)))
        self._cells = MapCells.of(gaussians) if in_parts else None

    def state(self) -> tuple[Any, ...]:
        """From which the training can go on."""
        return self.gaussians, self._adam.state()

    def go_on(self, state: tuple[Any, ...]) -> None:
        """Go on from where another one was."""
        self.gaussians, adam = state
        self._adam.go_on(adam)

    def step(self, view: PosedRgbd, looked_at: LookedAt, rates: LearningRates) -> None:
        """Take a step on a view."""
        image = looked_at.of(TrainingView.of(view, self._take.loss))
        rows, seen, camera = None, self.gaussians, view.camera or self._camera
        if self._cells is not None:
            rows = self._cells.seen(view.depth_m, view.T_world_camera, camera)
            seen = self.gaussians.select(rows)
        _, gradients = self._take.gradients(seen, camera, image, closing=looked_at.closing)
        limits = ScaleLimits(self._floor)
        step_in_place(
            self.gaussians, self._adam, gradients, rates=rates, limits=limits, rows=rows, chosen=self._trained
        )
