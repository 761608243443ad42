"""The map of a component, grown at the poses of its keyframes and optimized with other frames too, tile by tile.

All images are brought to one exposure, that of the map. Some frames between keyframes, never held-out ones, support its
final optimization; the others are registered to the finished map where depth is not exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, SupportsIndex, TypeVar

import numpy as np

from duagc.pipeline.base import progress as progress_bar
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS, Checkpoints
from duagc.pipeline.base.lap_times import LapTimes
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.frontend.growing_map import GrowingMap
from duagc.pipeline.frontend.joint_training import JointTraining, JointView
from duagc.pipeline.frontend.keyframe_sights import KeyframeSights
from duagc.pipeline.frontend.mapping import Mapper, MappingStats
from duagc.pipeline.frontend.mapping_budget import MappingBudget, alone_steps
from duagc.pipeline.frontend.model_registration import ModelTracker
from duagc.pipeline.frontend.output import BuiltMap, Maps
from duagc.pipeline.frontend.shutter import ShutterSearch
from duagc.pipeline.frontend.supporting_frames import supporting_frames
from duagc.pipeline.frontend.tile_checkpoints import TileCheckpoints
from duagc.pipeline.frontend.tiles import take_tile
from duagc.pipeline.frontend.tracked import TrackedFrame, tracked_path
from duagc.pipeline.frontend.view_gain import ViewGain
from duagc.pipeline.frontend.view_poses import moved_frames
from duagc.pipeline.geometry.exposure import ExposureTrack
from duagc.pipeline.geometry.masks import Mask, masked_depth
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.geometry.view_extent import ViewExtent
from duagc.pipeline.messages import Keyframe, MapUpdate
from duagc.pipeline.recording import RgbdFrame, RgbdLog
from duagc.pipeline.splat.gaussians import Gaussians

Result = TypeVar("Result")


class MapBuilder:
    """Builds the map of one component."""

    def __init__(
        self,
        log: RgbdLog,
        config: FrontendConfig,
        *,
        name: str,
        exposures: ExposureTrack,
        depth: DepthKind,
        seed: int,
        threads: SupportsIndex = 1,
        progress: bool = False,
        checkpoints: Checkpoints = NO_CHECKPOINTS,
    ) -> None:
        """Begin with an empty map.

        Args:
            log: of the robot.
            config: of the front end.
            name: of the component.
            exposures: of its frames.
            depth: of the Gaussians, as it is drawn.
            seed: of the run.
            threads: of the rasterizer; changes no bit.
            progress: whether it is shown.
            checkpoints: of the stage.
        """
        self._checkpoints = checkpoints
        self.log, self.config, self.name, self.exposures = log, config, name, exposures
        self._seed, self._depth, self._threads, self._progress = seed, depth, threads, progress
        self._budget = MappingBudget(config.mapping, log.camera, depth)
        self._sights = KeyframeSights(log, config)
        self._whole = GrowingMap(config.mapping, threads=threads)
        self._keyframes: Sequence[Keyframe] = ()
        self._tiles: list[list[int]] = []
        self._kept: Mapper | None = None  # the last tile that grew
        self._poses: dict[int, Array] = {}  # T_map_camera of views by frame index, as refined so far

    def build(
        self, keyframes: Sequence[Keyframe], frames: Sequence[TrackedFrame], clock: LapTimes
    ) -> BuiltMap:
        """Grow the map, optimize it, and register the other frames to it.

        Args:
            keyframes: with their optimized poses.
            frames: every frame of the log.
            clock: its laps get the times of the parts.
        """
        self._keyframes = keyframes
        self._poses = {k.frame_index: k.T_map_camera for k in keyframes}
        self._sights.look(keyframes)
        self._tiles = self._sights.tiles()
        log, save, config, threads = self.log, self._checkpoints, self.config, self._threads
        updates, state = save.done(f"{self.name}.mapping", self._grown)
        self._whole.go_on(state)
        del state  # or it would be in memory twice
        unrefined = self._whole.gaussians
        clock.lap("mapping_s")
        gain = ViewGain(unrefined, self._depth, log.camera, config.mapping, threads)
        supporting = supporting_frames(
            frames, keyframes, config, gain, tiles=len(self._tiles), seed=self._seed
        )
        before = np.array([k.T_map_camera for k in keyframes])
        path = tracked_path(frames, before)
        search = ShutterSearch(log, config.mapping, path, self._posed, depth=self._depth, threads=threads)
        shutter_s = save.done(
            f"{self.name}.shutter", lambda: search.run(self._whole.gaussians, supporting, keyframes)
        )
        log.open_shutter(shutter_s, path)
        log_s = 1e-9 * (frames[-1].stamp_ns - frames[0].stamp_ns)
        stats, self._poses, state = save.done(
            f"{self.name}.final", lambda: self._finalized(supporting, log_s)
        )
        self._whole.go_on(state)
        del state
        updates.append(stats.message(keyframes[-1], self.name, len(self._whole)))
        clock.lap("final_refinement_s")
        maps = Maps(self._whole.gaussians, unrefined, self._depth)
        after = np.array([self._poses[k.frame_index] for k in keyframes])
        if not np.array_equal(before, after):
            frames = moved_frames(frames, before, after, self._poses)
        registered = self._registered(frames, after, frozenset(self._poses))
        clock.lap("model_s")
        return BuiltMap(updates, maps, registered, after, shutter_s)

    def _grown(self) -> tuple[list[MapUpdate], Any]:
        """Add all keyframes to the map, tile by tile; the messages about it, and the state of the map."""
        part, count = f"{self.name}.mapping", len(self._keyframes)
        updates: list[MapUpdate] = []
        first, grown = 0, None
        if (saved := self._checkpoints.resume(part)) is not None:
            _, (first, updates, whole, grown) = saved
            self._whole.go_on(whole)
        steps = self._budget.keyframe_steps([keyframe.stamp_ns for keyframe in self._keyframes])
        wanted = self.config.mapping.steps(self._depth).keyframe * count
        self._budget.say_left_out(
            self._checkpoints.say, self.name, (wanted - sum(steps), wanted), "keyframe_megapixels_s"
        )
        for number, tile in enumerate(self._tiles[first:], first):
            before = [k for earlier in self._tiles[:number] for k in earlier]
            done = len(updates) - len(before)
            mapper = self._mapper(number, before, taken=not done)
            for k in tile[:done]:
                self._with_images(mapper.put_back, k, seeds=True)
            if grown is not None:
                mapper.go_on(grown)
            left = tile[done:]
            for k in progress_bar.track(left, f"mapping {self.name}") if self._progress else left:
                add = partial(mapper.add_keyframe, iterations=steps[k])
                stats = self._with_images(add, k, seeds=True)
                updates.append(stats.message(self._keyframes[k], self.name, len(self._whole) + stats.total))
                self._checkpoints.at(
                    part,
                    len(updates),
                    count,
                    partial(self._growing, number, updates, mapper),
                    shown=partial(self._shown, mapper),
                )
            self._whole.put_back(mapper.growing_map)
            self._kept = mapper if len(self._tiles) == 1 else None
            del mapper
            grown = None
        return updates, self._whole.state()

    def _growing(self, tile: int, updates: list[MapUpdate], mapper: Mapper) -> tuple[Any, ...]:
        """From which the growth of the map can go on."""
        return tile, updates, self._whole.state(), mapper.state()

    def _shown(self, mapper: Mapper) -> Gaussians:
        return Gaussians.concatenate([self._whole.gaussians, mapper.gaussians])

    def _mapper(
        self, number: int, others: Sequence[int], *, taken: bool, supporting: Sequence[TrackedFrame] = ()
    ) -> Mapper:
        """The mapper of a tile, with keyframes of others that look into it.

        Args:
            number: of the tile.
            others: keyframes that may be at its border.
            taken: whether its Gaussians are taken out of the map; else their state follows.
            supporting: frames between its keyframes that take part.
        """
        config, tile = self.config.mapping, self._tiles[number]
        border = self._border(tile, others)
        begun = GrowingMap(config, threads=self._threads)
        if taken:
            seen = [(self._sights.extents[k], self._pose(k)) for k in (*tile, *border)]
            for frame in supporting:
                depth_m = self.log.usable_depth(frame.frame_index)
                T_map_camera = self._pose(frame.keyframe_index) @ frame.T_keyframe_camera
                seen.append((ViewExtent.of(depth_m, self.log.camera), T_map_camera))
            begun = take_tile(self._whole, tile, seen[: len(tile)], seen[len(tile) :])
            self._whole.shelve()
        mapper = Mapper(
            self.log.camera,
            config,
            self._seed,
            threads=self._threads,
            depth=self._depth,
            begun=begun,
            tile=number,
        )
        for k in border:
            self._with_images(mapper.add_border, k)
        return mapper

    def _border(self, tile: Sequence[int], others: Sequence[int]) -> list[int]:
        """Keyframes of other tiles, out of some, that take part in the optimization of a tile."""
        return [] if len(self._tiles) == 1 else self._sights.border(tile, others)

    def _finalized(
        self, supporting: Sequence[TrackedFrame], log_s: float
    ) -> tuple[MappingStats, dict[int, Array], Any]:
        """Optimize all tiles in turn; counts, poses of the views by frame index, and the state of the map."""
        part, count = f"{self.name}.final", len(self._keyframes)
        tile_of = {k: number for number, tile in enumerate(self._tiles) for k in tile}
        of_tile = [[f for f in supporting if tile_of[f.keyframe_index] == n] for n in range(len(self._tiles))]
        shares_s = [log_s * len(t) / count if len(self._tiles) > 1 else log_s for t in self._tiles]
        taken = self._final_steps(of_tile, shares_s)
        steps, joint_share = sum(taken), self.config.mapping.joint_share if len(self._tiles) > 1 else 0.0
        alone = [alone_steps(of_one, joint_share) for of_one in taken]
        first, found = 0, None
        all_stats: list[MappingStats] = []
        if (saved := self._checkpoints.resume(part)) is not None:
            _, ((first, whole, self._poses, all_stats), *found) = saved
            if first < len(self._tiles):
                self._whole.go_on(whole)
        for number, tile in enumerate(self._tiles[first:], first):
            mapper = self._mapper_of_all_views(number, of_tile[number], taken=found is None)
            others = (number, self._whole.state(), self._poses, all_stats)
            before = sum(alone[:number])
            save = TileCheckpoints(self._checkpoints, others, found=found, before=before, total=steps)
            all_stats.append(mapper.finalize(save, part, log_s=shares_s[number], joint_share=joint_share))
            found = None
            for k, T_map_camera in zip(tile, mapper.keyframe_poses, strict=True):
                self._poses[self._keyframes[k].frame_index] = T_map_camera
            for frame, T_map_camera in zip(of_tile[number], mapper.support_poses, strict=True):
                self._poses[frame.frame_index] = T_map_camera
            self._whole.put_back(mapper.growing_map)
            del mapper, save, others
        stats = MappingStats.of_tiles(all_stats, [len(tile) for tile in self._tiles])
        if joint_share:
            done = (len(self._tiles), None, self._poses, all_stats)
            save = TileCheckpoints(self._checkpoints, done, found=found, before=sum(alone), total=steps)
            stats = self._trained_jointly(supporting, steps - sum(alone), save, stats)
        return replace(stats, total=len(self._whole)), self._poses, self._whole.state()

    def _final_steps(
        self, supporting: Sequence[Sequence[TrackedFrame]], shares_s: Sequence[float]
    ) -> list[int]:
        """Steps of each tile in the final optimization; what a budget leaves out is said.

        Args:
            supporting: frames between the keyframes of each tile.
            shares_s: of the time that the log took to record.
        """
        every = range(len(self._keyframes))
        plans = [
            self._budget.final_steps(
                len(tile), len(tile) + len(between) + len(self._border(tile, every)), share_s
            )
            for tile, between, share_s in zip(self._tiles, supporting, shares_s, strict=True)
        ]
        wanted, taken = (sum(counts) for counts in zip(*plans, strict=True))
        self._budget.say_left_out(
            self._checkpoints.say, self.name, (wanted - taken, wanted), "final_megapixels_s"
        )
        return [of_one for _, of_one in plans]

    def _mapper_of_all_views(self, number: int, supporting: Sequence[TrackedFrame], *, taken: bool) -> Mapper:
        """A tile's mapper with all views; its Gaussians are taken out of the whole map, or a checkpoint has them."""
        tile = self._tiles[number]
        mapper, self._kept = self._kept, None
        if mapper is not None and taken:
            mapper.begin(take_tile(self._whole, tile, (), ()))  # its images are here
        else:
            mapper = self._mapper(number, range(len(self._keyframes)), taken=taken, supporting=supporting)
            for k in tile:
                self._with_images(mapper.put_back, k, seeds=True)
        for frame in supporting:
            self._support(mapper, frame)
        own, border = ([self._keyframes[k].frame_index for k in ks] for ks in (tile, mapper.border_keyframes))
        views = [*own, *(frame.frame_index for frame in supporting), *border]
        mapper.open_shutter([self.log.moments(index) for index in views])
        return mapper

    def _trained_jointly(
        self, supporting: Sequence[TrackedFrame], steps: int, save: Checkpoints, stats: MappingStats
    ) -> MappingStats:
        """Optimize all tiles together; counts and losses with those of before."""
        views = [
            self._joint_view(k.frame_index, k.T_map_camera, k.information, fixed=not number)
            for number, k in enumerate(self._keyframes)
        ]
        for f in supporting:
            T_map_camera = self._keyframes[f.keyframe_index].T_map_camera @ f.T_keyframe_camera
            views.append(self._joint_view(f.frame_index, T_map_camera, f.information))
        training = JointTraining(
            views,
            self.log.camera,
            self.config.mapping,
            depth=self._depth,
            seed=self._seed,
            threads=self._threads,
        )
        pruned = training.run(self._whole, steps, save, f"{self.name}.final")
        self._poses |= training.poses
        known, frames = training.losses, [keyframe.frame_index for keyframe in self._keyframes]
        losses = [known[frame] for frame in frames if frame in known]  # a budget may leave steps out
        loss_after = float(np.mean(losses)) if losses else stats.loss_after
        return replace(stats, pruned=stats.pruned + pruned, loss_after=loss_after)

    def _joint_view(
        self, frame_index: int, T_map_tracked: Array, information: Array, *, fixed: bool = False
    ) -> JointView:
        """A view, whose images are read when they are looked at; what moves is known by its pose before refinement."""
        read = partial(self._posed, frame_index, T_map_tracked)
        return JointView(frame_index, self._poses[frame_index], information, fixed, read)

    def _posed(self, frame_index: int, T_map_tracked: Array, T_map_camera: Array | None = None) -> PosedRgbd:
        """A frame at a pose; what moves in it is known by that before refinement.

        Args:
            frame_index: of the frame.
            T_map_tracked: [4, 4], before refinement.
            T_map_camera: [4, 4], as refined so far; None: not.
        """
        frame = self.log.frame(frame_index)
        mask = self._still_pixels(frame, T_map_tracked)
        return PosedRgbd(
            frame.color,
            masked_depth(frame.depth, mask),
            T_map_tracked if T_map_camera is None else T_map_camera,
            mask,
            frame.depth_sigma,
            self.exposures.at(frame_index),
            T_camera_moment=frame.T_camera_moment,
        )

    def _still_pixels(self, frame: RgbdFrame, T_map_tracked: Array) -> Mask | None:
        """Pixels [H, W] of a frame that show nothing that moves; None: all. Found once for a pose."""
        return self._sights.free.usable(frame.usable_depth, T_map_tracked, frame.mask, index=frame.index)

    def _pose(self, keyframe: int) -> Array:
        """T_map_camera of a keyframe, as refined so far."""
        return self._poses[self._keyframes[keyframe].frame_index]

    def _with_images(self, do: Callable[..., Result], index: int, *, seeds: bool = False) -> Result:
        """Hand a keyframe to the mapper; if it seeds, with the depth of what is too far to be measured."""
        do = partial(do, far_m=self._sights.far_m(index)) if seeds else do
        keyframe = self._keyframes[index]
        posed = self._posed(keyframe.frame_index, keyframe.T_map_camera, self._pose(index))
        return do(index, posed, information=keyframe.information)

    def _support(self, mapper: Mapper, frame: TrackedFrame) -> None:
        """Add a frame to the views of the final optimization."""
        k, T_keyframe_camera = frame.keyframe_index, frame.T_keyframe_camera
        T_map_tracked = self._keyframes[k].T_map_camera @ T_keyframe_camera
        posed = self._posed(frame.frame_index, T_map_tracked, self._pose(k) @ T_keyframe_camera)
        mapper.add_view(k, posed, information=frame.information)

    def _registered(
        self, frames: Sequence[TrackedFrame], T_map_keyframe: Array, views: frozenset[int]
    ) -> list[TrackedFrame]:
        """The frames with those that did not make the map registered to it, where that says more than tracking.

        T_map_keyframe: [k, 4, 4]. views: indices of the frames that made the map.
        """
        if not self.config.model.enabled:
            return list(frames)
        model = ModelTracker(
            self._whole.gaussians,
            self._depth,
            self.log.camera,
            self.config.model,
            registration=self.config.tracking.registration,
            threads=self._threads,
        )
        others = [frame for frame in frames if frame.frame_index not in views]
        registered = model.registration_of(others, T_map_keyframe, self.log)
        return self._checkpoints.each(f"{self.name}.model", frames, registered)
