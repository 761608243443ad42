"""The front-end stage: from one robot's sensor log to its odometry, keyframes and Gaussian map.

Passes over the log: all frames are tracked; the keyframe poses are optimized together, with loop closures; the map is
made at these poses; the other frames are registered to it where that helps. Frames are anchored to keyframes.
The stage is offline in this sense; times in the log are those of the recording all the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import SupportsIndex

import numpy as np

from duagc.pipeline.base import determinism
from duagc.pipeline.base.checkpoints import Checkpoints
from duagc.pipeline.base.component_names import component_name, submap_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.lap_times import LapTimes
from duagc.pipeline.base.unmapped import NothingToMapError, Unmapped
from duagc.pipeline.base.worker_reports import KEYFRAMES
from duagc.pipeline.config.base import Config
from duagc.pipeline.config.frontend import FrontendConfig, TrackingConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.frontend.color_blocks import BlocksOfLog
from duagc.pipeline.frontend.component_paths import ComponentPath, images_of, optimized_paths
from duagc.pipeline.frontend.depth_quality import depth_noise_m, median_depth_m
from duagc.pipeline.frontend.exposure import ExposureEstimation
from duagc.pipeline.frontend.failure import FrameIntervals, FrozenImageDetector, OcclusionDetector, Reason
from duagc.pipeline.frontend.log_tracking import LogTracking
from duagc.pipeline.frontend.lost_frames import registered_again
from duagc.pipeline.frontend.output import (
    BuiltMap,
    Maps,
    exposure_messages,
    factor_messages,
    keyframe_messages,
    odometry_message,
    submap_messages,
    write_log,
)
from duagc.pipeline.frontend.pose_optimization import OptimizedPath
from duagc.pipeline.frontend.relocalization import Relocalizer
from duagc.pipeline.frontend.submap_joining import join_submaps
from duagc.pipeline.frontend.submaps import TrackedLog
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe, tracked_path
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.frontend.view_poses import moved_factors
from duagc.pipeline.geometry.exposure import ExposureTrack
from duagc.pipeline.messages import Keyframe
from duagc.pipeline.recording import RgbdLog, open_rgbd
from duagc.pipeline.recording.depth_motion import CurveKind
from duagc.pipeline.recording.moved_depth import DELAY_KEY
from duagc.pipeline.recording.shutter import FOUND_KEY
from duagc.pipeline.registration.reference import sampled_grid
from duagc.pipeline.splat.gaussians import Gaussians


def run_frontend(
    log_path: Path,
    out_path: Path,
    config: FrontendConfig,
    *,
    seed: int = 0,
    threads: SupportsIndex = 1,
    progress: bool = False,
    checkpoints: Checkpoints | None = None,
) -> dict[str, float]:
    """Track and map one robot's log.

    Args:
        log_path: sensor log of the robot.
        out_path: frontend.mcap to write.
        config: of the stage.
        seed: of the run, for the mapping.
        threads: of the rasterizer; changes no bit of the result.
        progress: whether it is shown on standard error.
        checkpoints: of this stage and robot, from which it goes on, and to which it saves; they change no bit.

    Returns:
        Wall times in seconds of tracking, pose optimization, mapping, final optimization of the map and writing.

    Raises:
        DuagError: the log is broken or empty.
        NothingToMapError: none of its frames begins a map.
    """
    determinism.configure_opencv()
    clock, save = LapTimes(), checkpoints or Checkpoints()
    with open_rgbd(log_path) as log:
        motion = log.motion_prior()
        save.consist_of(
            clock,
            once=(TrackedKeyframe,),
            allowed=_state_classes(),
            known={"config": config, "motion": motion},
        )
        if len(log) == 0:
            raise DuagError(f"{log_path}: has no image, expected at least one")
        blocks = BlocksOfLog(log, config.exposure.width_px)
        tracking = LogTracking(
            log, config, motion, save, blocks, seed=seed, threads=threads, progress=progress
        )
        tracked = tracking.run()
        if not tracked.submaps[0].keyframes:
            raise NothingToMapError(log_path, _unmapped(log, tracked, config.tracking))
        noise_m, depth_m = depth_noise_m(tracked.frames), median_depth_m(tracked)
        depth = config.mapping.depth_kind(noise_m, depth_m)
        keyframes = sum(len(submap.keyframes) for submap in tracked.submaps)
        save.tell(KEYFRAMES[depth], keyframes, keyframes)
        of_maps = config.model_copy(update={"mapping": config.mapping.for_depth(depth_m)})
        clock.lap("tracking_s")
        components = save.done(
            "joined",
            lambda: join_submaps(tracked.submaps, images_of(log), config, seed=seed, robot=log.robot),
        )
        paths = optimized_paths(log, components, tracked, config, seed=seed, checkpoints=save)
        for name, at in _named(log.robot, paths):
            stage = _ComponentStage(
                log=log,
                name=name,
                config=of_maps,
                seed=seed,
                threads=threads,
                progress=progress,
                noise_m=noise_m,
                depth=depth,
                clock=clock,
                checkpoints=save,
                blocks=blocks,
            )
            stage.run(paths[at], out_path if name == log.robot else component_path(out_path, name))
    return clock.laps


def component_path(frontend: Path, name: str) -> Path:
    """The log of a component that did not join the others of its robot: next to that of the robot.

    Args:
        frontend: log of the robot.
        name: of the component.
    """
    return frontend.with_name(f"{frontend.stem}.{submap_of(name)}{frontend.suffix}")


def _named(robot: str, paths: Sequence[ComponentPath]) -> list[tuple[str, int]]:
    """Names of components and their places: the one with most frames has the robot's name, others their number too."""
    posed = [sum(frame.status is not Status.LOST for frame in path.tracked_frames) for path in paths]
    largest = int(np.argmax(posed))  # the first of equals
    others = [
        (component_name(robot, path.component.numbers[0]), at)
        for at, path in enumerate(paths)
        if at != largest
    ]
    return [(robot, largest), *others]


def _unmapped(log: RgbdLog, tracked: TrackedLog, config: TrackingConfig) -> Unmapped:
    """What is known of a log that no map begins with."""
    frames, camera = tracked.frames, log.camera
    counts = Counter(frame.reason.value for frame in frames)
    reasons = tuple(sorted(counts, key=lambda reason: (-counts[reason], reason)))
    size, least = f"{camera.width} x {camera.height}", config.registration.min_samples
    rows, columns = sampled_grid(camera.width, camera.height, config.strides[0])
    if (places := len(rows) * len(columns)) < least:
        found = (
            f"found images of {size} pixels, in which registration has {places} samples, expected larger ones: "
            f"{least} samples or more, one every {config.strides[0]} pixels"
        )
    else:
        found = (
            f"found no frame of {size} pixels to begin a map with ({', '.join(reasons)}), "
            "expected one with depth in enough of them"
        )
    hidden = sum(frame.reason is Reason.NO_PIXEL for frame in frames)
    duration_s = 1e-9 * (frames[-1].stamp_ns - frames[0].stamp_ns)
    return Unmapped(len(frames), hidden, duration_s, reasons, found)


def _state_classes() -> tuple[type, ...]:
    """What the state of the front end has besides data classes."""
    from scipy.sparse import csc_array

    return (Config, Tracker, Relocalizer, FrameIntervals, FrozenImageDetector, OcclusionDetector, csc_array)


@dataclass(frozen=True, kw_only=True)
class _ComponentStage:
    """From the path of a component to its log.

    Attributes:
        log: of the robot.
        name: of the component: that of the robot, or with a number.
        config: of the stage.
        seed: of the run.
        threads: of the rasterizer.
        progress: whether it is shown.
        noise_m: noise of the depth images.
        depth: of the Gaussians, as it is drawn.
        clock: of the stage.
        checkpoints: of the stage.
        blocks: of its frames.
    """

    log: RgbdLog
    name: str
    config: FrontendConfig
    seed: int
    threads: SupportsIndex
    progress: bool
    noise_m: float | None
    depth: DepthKind
    clock: LapTimes
    checkpoints: Checkpoints
    blocks: BlocksOfLog

    def run(self, path: ComponentPath, out_path: Path) -> None:
        """Map, and write the log.

        Args:
            path: of the component.
            out_path: of its log.
        """
        log, solution = self.log, path.optimized.solution
        frames = self._placed(path)
        tracked = tracked_path(frames, solution.T_map_keyframe)
        log.move_depth(tracked, kind=(kind := CurveKind.of(tracked, log.gyro)))
        exposures = self._exposures(path.optimized, frames)
        self.clock.lap("refinement_s")
        keyframes = keyframe_messages(self.name, path.optimized.keyframes, solution)
        built = self._map(keyframes, frames, exposures)
        self._write(built, path, exposures, out_path, notes=self._notes(built.shutter_s, kind))
        self.clock.lap("writing_s")

    def _placed(self, path: ComponentPath) -> list[TrackedFrame]:
        """Frames at the optimized poses; registered again where depth and rows are moved by these."""
        optimized = path.optimized
        self.log.move_depth(tracked_path(optimized.frames, optimized.solution.T_map_keyframe))
        if not self.log.needs_motion:
            return optimized.frames
        return self.checkpoints.done(
            f"{self.name}.poses.found",
            lambda: registered_again(
                optimized.frames,
                path.tracked_frames,
                optimized.keyframes,
                images_of(self.log),
                config=self.config,
            ),
        )

    def _exposures(self, optimized: OptimizedPath, frames: Sequence[TrackedFrame]) -> ExposureTrack:
        """Exposures of all frames."""
        part = f"{self.name}.exposures"
        estimation = ExposureEstimation(self.blocks.of, self.config.exposure, self.checkpoints, part)
        exposures = self.checkpoints.done(
            part,
            lambda: estimation.run(
                [keyframe.frame_index for keyframe in optimized.keyframes],
                optimized.solution.T_map_keyframe,
                [(factor.i, factor.j) for factor in optimized.factors],
                frames,
            ),
        )
        self.blocks.forget(frame.frame_index for frame in frames)
        return exposures

    def _notes(self, shutter_s: float, kind: CurveKind) -> dict[str, str]:
        """What the metadata of the log say of its images."""
        log = self.log
        notes = {
            "color_without_depth": str(len(log.pairing.color_alone)),
            "depth_without_color": str(len(log.pairing.depth_alone)),
            "depth_noise_m": "unknown" if self.noise_m is None else f"{self.noise_m:.6f}",
        }
        if log.depth_delay_ns:
            notes[DELAY_KEY] = str(log.depth_delay_ns)
        if log.readout.rolls and not log.states_readout:
            notes |= log.readout.notes()
        if shutter_s > 0:
            notes[FOUND_KEY] = repr(shutter_s)
        if log.needs_motion or shutter_s > 0:
            notes |= kind.notes()
        return notes

    def _write(
        self,
        built: BuiltMap,
        path: ComponentPath,
        exposures: ExposureTrack,
        out_path: Path,
        *,
        notes: dict[str, str],
    ) -> None:
        optimized = path.optimized
        refined = replace(optimized.solution, T_map_keyframe=built.T_map_keyframe)
        moved = moved_factors(optimized.factors, optimized.solution, built.T_map_keyframe)
        odometry = [odometry_message(self.name, frame, refined.T_map_keyframe) for frame in built.frames]
        write_log(
            out_path,
            self.name,
            odometry,
            keyframes=keyframe_messages(self.name, optimized.keyframes, refined),
            factors=factor_messages(self.name, optimized.keyframes, moved, refined),
            exposures=exposure_messages(self.name, exposures, odometry),
            updates=built.updates,
            submaps=submap_messages(self.name, path.component, path.log),
            maps=built.maps,
            notes=notes,
        )

    def _map(
        self, keyframes: Sequence[Keyframe], frames: list[TrackedFrame], exposures: ExposureTrack
    ) -> BuiltMap:
        """Build the map, if the configuration asks for one."""
        if not self.config.mapping_enabled:
            self.clock.lap("mapping_s")
            maps = Maps(Gaussians.empty(), None, self.depth)
            return BuiltMap([], maps, frames, np.array([k.T_map_camera for k in keyframes]))
        from duagc.pipeline.frontend.map_building import MapBuilder

        builder = MapBuilder(
            self.log,
            self.config,
            name=self.name,
            exposures=exposures,
            depth=self.depth,
            seed=self.seed,
            threads=self.threads,
            progress=self.progress,
            checkpoints=self.checkpoints,
        )
        return builder.build(keyframes, frames, self.clock)
