"""Mapping: one robot's Gaussian map, grown keyframe by keyframe from RGB-D images with known poses.

At a keyframe the map is rendered, discs are seeded where it does not explain the image, and the Gaussians of a
window of keyframes are optimized by Adam on a robust color and depth loss. `finalize` optimizes the map over all
keyframes. Everything is elementwise or summed in a fixed order: the same input gives the same bits on any number of
threads. See docs/explanation/mapping.md.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS, Checkpoints
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import DepthKind, LearningRates
from duagc.pipeline.frontend.growing_map import GrowingMap
from duagc.pipeline.frontend.map_content import MapContent
from duagc.pipeline.frontend.mapping_budget import MappingBudget, alone_steps
from duagc.pipeline.frontend.mapping_views import Image, View
from duagc.pipeline.frontend.view_poses import PoseStep, PoseSteps
from duagc.pipeline.frontend.view_selection import optimization_window
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.kernels import LossWeights
from duagc.pipeline.kernels.sparse_steps import EVERYTHING, LookedAt, SparseSteps
from duagc.pipeline.kernels.training import ScaleLimits, TrainingStep
from duagc.pipeline.messages import Keyframe, MapUpdate
from duagc.pipeline.splat.optimizer import smoothstep_decay

MANY_VIEWS = 16
"""Views from which on every second one reports what a Gaussian contributes to all."""
LOSS_VIEWS = 4
"""Most keyframes, spread over all, at which the loss of a whole map is measured."""


@dataclass(frozen=True)
class MappingStats:
    """Changes of the map at a keyframe.

    Attributes:
        inserted: number of Gaussians.
        pruned: number of Gaussians.
        total: number of Gaussians afterwards.
        loss_before: of the keyframe's own view, at the pixels of its first step.
        loss_after: of the same pixels, after the last one.
    """

    inserted: int
    pruned: int
    total: int
    loss_before: float
    loss_after: float

    @staticmethod
    def of_tiles(stats: Sequence[MappingStats], keyframes: Sequence[int]) -> MappingStats:
        """Counts and mean losses of all tiles; a Gaussian is counted in every tile that sees it.

        Args:
            stats: of each.
            keyframes: of each, how many.
        """
        if len(stats) == 1:
            return stats[0]
        return MappingStats(
            inserted=sum(tile.inserted for tile in stats),
            pruned=sum(tile.pruned for tile in stats),
            total=sum(tile.total for tile in stats),
            loss_before=float(np.average([tile.loss_before for tile in stats], weights=keyframes)),
            loss_after=float(np.average([tile.loss_after for tile in stats], weights=keyframes)),
        )

    def message(self, keyframe: Keyframe, robot: str, total: int) -> MapUpdate:
        """The message about a step of mapping.

        Args:
            keyframe: at which it was taken.
            robot: name of the component.
            total: Gaussians of the whole map afterwards.
        """
        return MapUpdate(
            stamp_ns=keyframe.stamp_ns,
            robot=robot,
            keyframe_index=keyframe.keyframe_index,
            inserted=self.inserted,
            pruned=self.pruned,
            total=total,
            loss_before=self.loss_before,
            loss_after=self.loss_after,
        )


class Mapper(MapContent):
    """Grow and optimize the Gaussian map of one robot."""

    def __init__(
        self,
        camera: PinholeCamera,
        config: MappingConfig,
        seed: int,
        *,
        threads: SupportsIndex = 1,
        depth: DepthKind | None = None,
        begun: GrowingMap | None = None,
        tile: int = 0,
    ) -> None:
        """Begin with an empty map, or with a tile of one.

        Args:
            camera: of all views.
            config: how the map is grown and optimized.
            seed: of the run; random keyframes of the window and the order of the final optimization are drawn
                from it.
            threads: of the rasterizer; changes no bit of the map.
            depth: of the Gaussians, as it is drawn; None: as configured, and of depth whose noise is unknown.
            begun: the Gaussians of a tile of the map; None: an empty map.
            tile: its number.
        """
        super().__init__(camera, config, depth=depth or config.depth_kind(None), threads=threads, begun=begun)
        self.seed, self._tile = seed, tile
        self.budget = MappingBudget(config, camera, self.depth)
        self._loss_weights = LossWeights(**config.loss.of(self.depth).model_dump())
        self._limits = ScaleLimits.of(config)
        self._step = TrainingStep(self.rasterizer, self._loss_weights, self.depth)

    @property
    def exact_depth(self) -> bool:
        """Whether the map has the depth kind of exact depth images."""
        return self.depth == "ray_plane"

    def put_back(
        self,
        keyframe_index: int,
        image: PosedRgbd,
        *,
        information: NDArray[np.float64] | None = None,
        far_m: Image | None = None,
    ) -> None:
        """Take in a keyframe of which a state follows, and do nothing for it.

        Args:
            keyframe_index: as of `add_keyframe`.
            image: as of `add_keyframe`.
            information: as of `add_keyframe`.
            far_m: as of `add_keyframe`.
        """
        self._views.append(
            View.of(keyframe_index, image, self._loss_weights, information=information, far_m=far_m)
        )

    def add_border(
        self, keyframe_index: int, image: PosedRgbd, *, information: NDArray[np.float64] | None = None
    ) -> None:
        """Take in a keyframe of another tile, which sees some of this one; its pose stays.

        Args:
            keyframe_index: as of `add_keyframe`.
            image: as of `add_keyframe`.
            information: as of `add_keyframe`.
        """
        self._borders.append(
            SHELF.put(View.of(keyframe_index, image, self._loss_weights, information=information))
        )

    def add_keyframe(
        self,
        keyframe_index: int,
        image: PosedRgbd,
        *,
        information: NDArray[np.float64] | None = None,
        far_m: Image | None = None,
        iterations: int | None = None,
    ) -> MappingStats:
        """Seed what the map does not explain of a new keyframe and optimize the window around it.

        Args:
            keyframe_index: 0, 1, 2, ... in order of arrival; a tile has some of them.
            image: with its pose in the map frame; kept, not copied. Pixels outside its mask neither seed nor count in
                a loss.
            information: [6, 6] of the pose; None: nothing is known of it.
            far_m: [H, W], depth of what was too far to be measured, meters, 0 where it is unknown; None: nowhere.
            iterations: most optimization steps; None: those of the configuration.
        """
        last = self._views[-1].index if self._views else -1
        if keyframe_index <= last or (last < 0 and not self._tile and keyframe_index):
            raise ValueError(f"keyframe {keyframe_index} added after {len(self._views)} keyframes")
        view = View.of(keyframe_index, image, self._loss_weights, information=information, far_m=far_m)
        first = not self._views and not len(self._map)
        self._views.append(view)
        self._map.adam.freeze_after(self.config.stable_steps or None)
        inserted, pruned = self._seed(view, self.config.first_share if first else self.config.keyframe_share)
        level = self.config.iterations_level
        views = [*self._borders, *self._views]
        steps = self.config.steps(self.depth).keyframe
        window = optimization_window(
            views, view, self.config, steps=steps, camera=self.cameras[0], seed=self.seed
        )[:iterations]
        sparse = SparseSteps(self.config.sparse, self.cameras[level], len(window))
        self._map.own_arrays()
        losses, visits = [], Counter[int]()
        for step, other in enumerate(window):
            looked_at = sparse.at(step, visits[other.index])
            visits[other.index] += 1
            losses.append(self._optimize(other, level, self.config.rates, looked_at))
        compared = sparse.at(0, 0)
        before = losses[0] if losses else self._loss(view, level, compared)  # the newest keyframe comes first
        pruned += self._map.prune_transparent()
        after = self._loss(view, level, compared)
        return MappingStats(inserted, pruned, len(self._map), before, after)

    def add_view(
        self, keyframe_index: int, image: PosedRgbd, *, information: NDArray[np.float64] | None = None
    ) -> None:
        """Let a tracked frame that is no keyframe take part in `finalize`.

        It seeds Gaussians only where no keyframe saw anything. Never give a frame that is held out for evaluation.

        Args:
            keyframe_index: the keyframe that it is anchored to.
            image: with its pose in the map frame; kept, not copied.
            information: [6, 6] of the pose; None: nothing is known of it.
        """
        self._support.append(View.of(keyframe_index, image, self._loss_weights, information=information))

    def finalize(
        self,
        checkpoints: Checkpoints = NO_CHECKPOINTS,
        part: str = "final",
        *,
        log_s: float = math.inf,
        joint_share: float = 0.0,
    ) -> MappingStats:
        """Optimize geometry, color and, where depth is not exact, poses over all views at full size.

        The views come in random order, each once before any comes again. In the first half, what contributes
        nothing is replaced `densify_rounds` times by discs where the keyframes are drawn worst.

        Args:
            checkpoints: of the stage.
            part: its name there.
            log_s: time that the log took to record, for the budget.
            joint_share: last share of the schedule that is left out, since all tiles are optimized together then.

        Returns:
            Counts of the whole optimization; losses as means over a few keyframes, at the pixels of a first step and as
            if the camera stood still.
        """
        config = self.config
        views = [*self._views, *self._support, *self._borders]
        fixed = self._fixed_views(len(views))
        first, found = checkpoints.resume(part) or (0, None)
        _, steps = self.budget.final_steps(len(self._views), len(views), log_s)
        sparse = SparseSteps(config.sparse, self.cameras[0], steps)
        compared = sparse.at(0, 0)
        before, inserted, pruned = (self._mean_loss(compared), *self._cover()) if found is None else found[0]
        alone = alone_steps(steps, joint_share)
        last_prune = min(steps // 2, alone - 1)
        rounds = [steps * (k + 1) // (2 * config.densify_rounds + 2) for k in range(config.densify_rounds)]
        self._map.adam.freeze_after(None)
        poses = PoseSteps([view.information for view in views])
        refined = config.pose_rate > 0 and not self.exact_depth  # where depth is exact, so are the poses
        if found is not None:
            poses.go_on(found[1])
            self.go_on(found[2])
        turns = random_streams.in_turn(self.seed, "mapping.finish", len(views), first=first, **self._of_tile)
        self._map.own_arrays()
        for step in range(first, alone):
            if step in rounds:
                number = rounds.index(step)
                half = views[number % 2 :: 2] if len(views) >= MANY_VIEWS else views
                pruned += self._prune_useless(half, len(views))
                inserted += self._densify(1.0 / (len(rounds) - number))
            elif step == last_prune:
                pruned += self._prune_useless(views, len(views))
            share = smoothstep_decay(step, steps, config.final_rate_decay)
            chosen, visit = next(turns)
            pose_step = (
                poses.of(chosen, config.pose_rate * share) if refined and chosen not in fixed else None
            )
            looked_at = sparse.at(step, visit)
            rates = config.rates.times(share)
            self._optimize(views[chosen], 0, rates, looked_at, pose_step=pose_step, keep_guests=True)
            state = partial(self._optimized, (before, inserted, pruned), poses)
            checkpoints.at(part, step + 1, steps, state, shown=lambda: self.gaussians)
        pruned += self._map.prune_transparent()
        return MappingStats(inserted, pruned, len(self._map), before, self._mean_loss(compared))

    def _fixed_views(self, views: int) -> set[int]:
        """Positions of the views whose poses stay: the first of the map, or those of other tiles."""
        borders = set(range(views - len(self._borders), views))
        return borders if borders and self._views[0].index else borders | {0}

    @property
    def _of_tile(self) -> dict[str, int]:
        """The key of the stream of the order of the views."""
        return {"tile": self._tile} if self._tile else {}

    def _optimized(self, so_far: tuple[float, int, int], poses: PoseSteps) -> tuple[Any, ...]:
        """From which the final optimization can go on."""
        return so_far, poses.state(), self.state()

    # --- one view -----------------------------------------------------------------------------------------------

    def _loss(self, view: View, level: int, looked_at: LookedAt) -> float:
        of_view = looked_at.of(view.training(level))
        return self._step.loss_of(self._seen(view), self.cameras[level], of_view).value

    def _mean_loss(self, looked_at: LookedAt) -> float:
        """Of a few keyframes, spread over all."""
        views = self._views
        spread = [views[k] for k in evenly_spaced(len(views), min(LOSS_VIEWS, len(views)))]
        return float(np.mean([self._loss(view, 0, looked_at) for view in spread])) if spread else 0.0

    def _optimize(
        self,
        view: View,
        level: int,
        rates: LearningRates,
        looked_at: LookedAt = EVERYTHING,
        *,
        pose_step: PoseStep | None = None,
        keep_guests: bool = False,
    ) -> float:
        """One Adam step of the Gaussians in one view, and of its pose where a step is given; the loss before."""
        loss, gradients = self._step.gradients(
            self._seen(view),
            self.cameras[level],
            looked_at.of(view.training(level)),
            pose=pose_step is not None,
            closing=looked_at.closing,
        )
        if self._map.guests:
            guests = self._guests(view)
            self._map.step(guests, gradients, rates, limits=self._limits, keep_guests=keep_guests)
        else:
            self._map.step_all(gradients, rates, limits=self._limits)
        if pose_step is not None:
            assert gradients.pose is not None  # it was asked for
            view.T_map_camera = view.T_map_camera @ se3.exp(pose_step(gradients.pose))
        return loss.value
