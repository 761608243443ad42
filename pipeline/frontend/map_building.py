"""The map of a component, grown at the poses of its keyframes and optimized with other frames too.

All images are brought to one exposure, that of the map. Some frames between keyframes, never held-out ones, support its
final optimization; the others are registered to the finished map where depth is not exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np

from duagc.pipeline.base import progress as progress_bar
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS, Checkpoints
from duagc.pipeline.base.lap_times import LapTimes
from duagc.pipeline.config.frontend import FrontendConfig, is_held_out
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.mapping import Mapper, MappingStats
from duagc.pipeline.frontend.model_registration import ModelTracker
from duagc.pipeline.frontend.output import BuiltMap, Maps
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.frontend.view_poses import moved_frames
from duagc.pipeline.geometry.exposure import ExposureTrack
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.messages import Keyframe, MapUpdate
from duagc.pipeline.recording import RgbdLog
from duagc.pipeline.registration.moving import FreeSpace

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
        noise_m: float | None,
        seed: int,
        threads: int = 1,
        progress: bool = False,
        checkpoints: Checkpoints = NO_CHECKPOINTS,
    ) -> None:
        """Begin with an empty map.

        Args:
            log: of the robot.
            config: of the front end.
            name: of the component.
            exposures: of its frames.
            noise_m: of the depth images; None: unknown.
            seed: of the run.
            threads: of the rasterizer; changes no bit.
            progress: whether it is shown.
            checkpoints: of the stage.
        """
        self._checkpoints = checkpoints
        self.log, self.config, self.name, self.exposures = log, config, name, exposures
        self._threads, self._progress = threads, progress
        self._mapper = Mapper(log.camera, config.mapping, seed, threads=threads, depth_noise_m=noise_m)
        self._free = FreeSpace(log.camera, config.moving)

    def build(
        self, keyframes: Sequence[Keyframe], frames: Sequence[TrackedFrame], clock: LapTimes
    ) -> BuiltMap:
        """Grow the map, optimize it, and register the other frames to it.

        Args:
            keyframes: with their optimized poses.
            frames: every frame of the log.
            clock: its laps get the times of the parts.
        """
        for keyframe in keyframes:
            self._free.add(self.log.frame(keyframe.frame_index).usable_depth, keyframe.T_map_camera)
        save = self._checkpoints
        updates, state = save.done(f"{self.name}.mapping", lambda: self._grown(keyframes))
        self._restore(keyframes, state)
        unrefined = self._mapper.gaussians
        clock.lap("mapping_s")
        supporting = supporting_frames(frames, keyframes, self.config)
        for frame in supporting:
            self._support(frame, keyframes[frame.keyframe_index])
        part = f"{self.name}.final"
        log_s = 1e-9 * (frames[-1].stamp_ns - frames[0].stamp_ns)
        wanted, steps = self._mapper.budget.final_steps(
            len(keyframes), len(keyframes) + len(supporting), log_s
        )
        self._left_out(wanted - steps, wanted, "of the final optimization", "final_megapixels_s")
        stats, state = save.done(
            part, lambda: (self._mapper.finalize(save, part, log_s=log_s), self._mapper.state())
        )
        self._mapper.go_on(state)
        updates.append(self._update(keyframes[-1], stats))
        clock.lap("final_refinement_s")
        maps = Maps(self._mapper.gaussians, unrefined, self._mapper.depth)
        before, after = np.array([k.T_map_camera for k in keyframes]), self._mapper.keyframe_poses
        views = {keyframe.frame_index: T for keyframe, T in zip(keyframes, after, strict=True)}
        views |= {f.frame_index: T for f, T in zip(supporting, self._mapper.support_poses, strict=True)}
        if not np.array_equal(before, after):
            frames = moved_frames(frames, before, after, views)
        registered = self._registered(frames, after, frozenset(views))
        clock.lap("model_s")
        return BuiltMap(updates, maps, registered, after)

    def _grown(self, keyframes: Sequence[Keyframe]) -> tuple[list[MapUpdate], Any]:
        """Add all keyframes to the map; the messages about it, and the state of the map."""
        part = f"{self.name}.mapping"
        updates: list[MapUpdate] = []
        done, state = 0, None
        if (saved := self._checkpoints.resume(part)) is not None:
            done, (updates, state) = saved
        self._restore(keyframes[:done], state)
        left = keyframes[done:]
        steps = self._mapper.budget.keyframe_steps([keyframe.stamp_ns for keyframe in keyframes])
        wanted = self.config.mapping.iterations * len(keyframes)
        self._left_out(wanted - sum(steps), wanted, "at keyframes", "keyframe_megapixels_s")
        for keyframe in progress_bar.track(left, f"mapping {self.name}") if self._progress else left:
            add = partial(self._mapper.add_keyframe, iterations=steps[keyframe.keyframe_index])
            stats = self._with_images(add, keyframe)
            updates.append(self._update(keyframe, stats))
            self._checkpoints.at(
                part,
                len(updates),
                len(keyframes),
                lambda: (updates, self._mapper.state()),
                shown=lambda: self._mapper.gaussians,
            )
        return updates, self._mapper.state()

    def _left_out(self, steps: int, wanted: int, which: str, setting: str) -> None:
        """Say what a budget leaves out."""
        if steps:
            self._checkpoints.say(
                f"warning: {self.name}: {steps} of {wanted} training steps {which} are left out "
                f"by frontend.mapping.{setting}"
            )

    def _restore(self, keyframes: Sequence[Keyframe], state: Any) -> None:
        """Bring the mapper to a state, with images of the log."""
        for keyframe in keyframes[len(self._mapper.keyframe_poses) :]:
            self._with_images(self._mapper.put_back, keyframe)
        if state is not None:
            self._mapper.go_on(state)

    def _with_images(self, do: Callable[..., Result], keyframe: Keyframe) -> Result:
        """Hand a keyframe to the mapper."""
        frame = self.log.frame(keyframe.frame_index)
        return do(
            keyframe.keyframe_index,
            frame.color,
            frame.depth,
            keyframe.T_map_camera,
            mask=self._free.usable(frame.usable_depth, keyframe.T_map_camera, frame.mask),
            depth_sigma_m=frame.depth_sigma,
            exposure=self.exposures.at(frame.index),
            information=keyframe.information,
        )

    def _support(self, supporting: TrackedFrame, keyframe: Keyframe) -> None:
        """Add a frame to the views of the final optimization."""
        frame = self.log.frame(supporting.frame_index)
        T_map_camera = keyframe.T_map_camera @ supporting.T_keyframe_camera
        self._mapper.add_view(
            supporting.keyframe_index,
            frame.color,
            frame.depth,
            supporting.T_keyframe_camera,
            mask=self._free.usable(frame.usable_depth, T_map_camera, frame.mask),
            depth_sigma_m=frame.depth_sigma,
            exposure=self.exposures.at(frame.index),
            information=supporting.information,
        )

    def _registered(
        self, frames: Sequence[TrackedFrame], T_map_keyframe: Array, views: frozenset[int]
    ) -> list[TrackedFrame]:
        """The frames with those that did not make the map registered to it, where that says more than tracking.

        T_map_keyframe: [k, 4, 4]. views: indices of the frames that made the map.
        """
        if not self.config.model.enabled:
            return list(frames)
        model = ModelTracker(
            self._mapper.gaussians,
            self._mapper.depth,
            self.log.camera,
            self.config.model,
            registration=self.config.tracking.registration,
            threads=self._threads,
        )
        reasons = {Reason.NO_DEPTH} if self._mapper.exact_depth else {Reason.NO_DEPTH, Reason.NONE}

        def registered(frame: TrackedFrame) -> TrackedFrame:
            if frame.status is not Status.LOST and frame.reason in reasons and frame.frame_index not in views:
                images = self.log.frame(frame.frame_index)
                return model.register(frame, images, T_map_keyframe[frame.keyframe_index])
            return frame

        return self._checkpoints.each(f"{self.name}.model", frames, registered)

    def _update(self, keyframe: Keyframe, stats: MappingStats) -> MapUpdate:
        """The message about a step of mapping."""
        return MapUpdate(
            stamp_ns=keyframe.stamp_ns,
            robot=self.name,
            keyframe_index=keyframe.keyframe_index,
            inserted=stats.inserted,
            pruned=stats.pruned,
            total=stats.total,
            loss_before=stats.loss_before,
            loss_after=stats.loss_after,
        )


def supporting_frames(
    frames: Sequence[TrackedFrame], keyframes: Sequence[Keyframe], config: FrontendConfig
) -> list[TrackedFrame]:
    """Frames for the final optimization of the map: tracked, no keyframes, not held out; evenly spread over the log.

    Args:
        frames: of the log.
        keyframes: of the map.
        config: of the front end.
    """
    taken = {keyframe.frame_index for keyframe in keyframes}
    candidates = [
        frame
        for frame in frames
        if frame.status is not Status.LOST
        and frame.reason is Reason.NONE  # its depth and its color belong together
        and frame.frame_index not in taken
        and not is_held_out(frame.frame_index)
    ]
    count = min(config.mapping.support_views, len(candidates))
    return [candidates[k] for k in evenly_spaced(len(candidates), count)]
