"""The paths of a robot's components: poses optimized together, and what is rejected by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from duagc.pipeline.base.checkpoints import Checkpoints
from duagc.pipeline.base.component_names import component_name
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend.bundle import Images
from duagc.pipeline.frontend.components import Component
from duagc.pipeline.frontend.frame_images import pyramid_of
from duagc.pipeline.frontend.kept_pyramids import KeptPyramids
from duagc.pipeline.frontend.pose_optimization import OptimizedPath, PathOptimization
from duagc.pipeline.frontend.rejected_parts import separated
from duagc.pipeline.frontend.submaps import TrackedLog
from duagc.pipeline.frontend.tracked import TrackedFrame, tracked_path
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import RgbdLog
from duagc.pipeline.registration import RgbdPyramid


@dataclass(frozen=True)
class ComponentPath:
    """The path of a component, optimized.

    Attributes:
        component: whose it is.
        log: as it was tracked, in submaps.
        optimized: its poses.
    """

    component: Component
    log: TrackedLog
    optimized: OptimizedPath

    @property
    def tracked_frames(self) -> list[TrackedFrame]:
        """Every frame of the log as it was tracked; lost where it is in no submap of the component."""
        return self.component.frames(self.log)


def optimized_paths(
    log: RgbdLog,
    components: Sequence[Component],
    tracked: TrackedLog,
    config: FrontendConfig,
    *,
    seed: int,
    checkpoints: Checkpoints,
) -> list[ComponentPath]:
    """Optimize the paths of all components, and then those of their rejected parts.

    Args:
        log: of the robot.
        components: of its submaps.
        tracked: the log as it was tracked.
        config: of the front end.
        seed: of the random streams.
        checkpoints: of the stage.
    """
    left, done = list(components), []
    while left:
        component = left.pop(0)
        log.move_depth(*trajectories_of(tracked))  # those of another component say nothing of these frames
        optimized = _optimized(log, component, tracked, config, seed=seed, checkpoints=checkpoints)
        now = separated(tracked, component, optimized.rejected, config.submaps)
        tracked = now.log
        left += now.others
        done.append((now.own, replace(optimized, frames=now.frames(optimized.frames))))
    return [ComponentPath(component, tracked, optimized) for component, optimized in done]


def _optimized(
    log: RgbdLog,
    component: Component,
    tracked: TrackedLog,
    config: FrontendConfig,
    *,
    seed: int,
    checkpoints: Checkpoints,
) -> OptimizedPath:
    number = component.numbers[0]
    part = f"{log.robot if number == 1 else component_name(log.robot, number)}.poses"

    def optimize() -> OptimizedPath:
        optimization = PathOptimization(images_of(log), config, seed, log.robot, checkpoints, part)
        return optimization.run(component.keyframes, component.frames(tracked), component.pairs)

    return checkpoints.done(part, optimize)  # the images that it kept are gone now


def trajectories_of(tracked: TrackedLog) -> list[Trajectory]:
    """T_submap_camera of the frames that have a pose, by submap.

    Args:
        tracked: the log as it was tracked.
    """
    out = []
    for submap in tracked.submaps:
        frames = [f for f, n in zip(tracked.frames, tracked.submap_of, strict=True) if n == submap.number]
        out.append(tracked_path(frames, np.array([k.T_map_keyframe for k in submap.keyframes])))
    return out


def images_of(log: RgbdLog) -> Images:
    """Reads the images of a frame, by its index and the number of pyramid levels, as long as no depth is moved.

    Args:
        log: of the robot.
    """

    def images(frame_index: int, levels: int) -> RgbdPyramid:
        return pyramid_of(log.frame(frame_index), log.camera, levels)

    return KeptPyramids(images)
