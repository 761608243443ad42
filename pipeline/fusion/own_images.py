"""A robot's own files as its fusion begins with them: what needs nothing of the session, and can be read before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.shelf import SHELF, ShelvedList
from duagc.pipeline.config.fusion import FinetuneConfig
from duagc.pipeline.config.registration import MovingConfig
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.messages import Odometry
from duagc.pipeline.recording import open_rgbd, read_exposures, read_log
from duagc.pipeline.registration.moving import FreeSpace
from duagc.pipeline.runs.robot_data import AgentInput, RobotData, load
from duagc.pipeline.splat.training_frames import blur_distance_m, training_frames
from duagc.schemas import topics


@dataclass(frozen=True)
class OwnImages:
    """Images that a robot's final map is trained on.

    Attributes:
        camera: of all of them.
        images: keyframes first, each posed in the robot's own map.
        places: of each in the frames that have a pose.
        keyframes: how many there are.
    """

    camera: PinholeCamera
    images: Sequence[PosedRgbd]
    places: Sequence[int]
    keyframes: int

    def views(self, T_world_camera: Array, moving: MovingConfig) -> Sequence[PosedRgbd]:
        """The images at poses that came later, without what moved.

        Args:
            T_world_camera: [n, 4, 4], of all frames that have a pose, in order, in the frame of the views.
            moving: as the front end looked for what moves.
        """
        at = zip(self.images, self.places, strict=True)
        views = [replace(image, T_world_camera=T_world_camera[place]) for image, place in at]
        free = FreeSpace(self.camera, moving)
        for view in views[: self.keyframes]:
            free.add(view.depth_m, view.T_world_camera)
        return ShelvedList(replace(v, mask=free.usable(v.depth_m, v.T_world_camera, v.mask)) for v in views)


@dataclass(frozen=True)
class OwnFiles:
    """What a robot's fusion reads of its own.

    Attributes:
        source: the files.
        config: how many frames between keyframes take part.
        own: the robot's own results.
        frames: that have a pose, in order.
    """

    source: AgentInput
    config: FinetuneConfig
    own: RobotData
    frames: Sequence[Odometry]

    @staticmethod
    def read(source: AgentInput, config: FinetuneConfig) -> OwnFiles:
        """All but the images.

        Args:
            source: the files.
            config: how many frames between keyframes take part.
        Raises:
            DuagError: a file lacks what it should hold, or two files do not belong together.
        """
        return OwnFiles(source, config, SHELF.put(load(source)), _placed_frames(source))

    @cached_property
    def images(self) -> OwnImages:
        """Those that the final map is trained on; read when they are asked for."""
        own, config = self.own, self.config
        num_support = config.at_most(config.support_views, own.keyframes)
        seen_m = blur_distance_m(own.gaussians, own.T_map_keyframe, own.depth)
        return training_images(self.source, self.frames, num_support=num_support, seen_m=seen_m)


_read_ahead: dict[Path, OwnFiles] = {}


def read_ahead(source: AgentInput, config: FinetuneConfig) -> None:
    """Read what the fusion of a robot needs, before the session has ended; this process keeps it.

    Args:
        source: the robot's own files.
        config: how many frames between keyframes take part.
    Raises:
        DuagError: a file lacks what it should hold, or two files do not belong together.
    """
    files = OwnFiles.read(source, config)
    _ = files.images
    _read_ahead[source.frontend] = files


def take_read_ahead(source: AgentInput, config: FinetuneConfig) -> OwnFiles:
    """What this process has read of a robot, or reads now; it is kept no longer.

    Args:
        source: the robot's own files.
        config: as of `read_ahead`.
    Raises:
        DuagError: a file lacks what it should hold, or two files do not belong together.
    """
    known = _read_ahead.pop(source.frontend, None)
    return OwnFiles.read(source, config) if known is None else known


def training_images(
    source: AgentInput, frames: Sequence[Odometry], *, num_support: int, seen_m: float | None
) -> OwnImages:
    """The robot's keyframes and, of equal parts of its path, a frame between them; none held out.

    Args:
        source: the robot's own files.
        frames: that have a pose, in order.
        num_support: most frames between keyframes.
        seen_m: of `training_frames`, which takes the others.
    """
    topic = topics.KEYFRAME.of(source.robot)
    keyframes = {record.message().frame_index for record in read_log(source.frontend, (topic,))}
    first = [k for k, f in enumerate(frames) if f.frame_index in keyframes]
    others = [k for k, f in enumerate(frames) if f.frame_index not in keyframes and not f.held_out]
    count = min(num_support, len(others))
    stamps = np.array([frame.stamp_ns for frame in frames], dtype=np.int64)
    path = Trajectory(stamps, np.array([frame.T_map_camera for frame in frames]))
    places = [*first, *training_frames(path, others, count, seen_m)]
    exposures = read_exposures(source.frontend, source.robot)
    with open_rgbd(source.log) as log:
        log.move_depth_by(source.frontend, path)

        def posed(k: int) -> PosedRgbd:
            frame, T_map_camera = log.frame(frames[k].frame_index), frames[k].T_map_camera
            exposure, depth_m = exposures.at(frame.index), frame.usable_depth
            found = PosedRgbd(frame.color, depth_m, T_map_camera, frame.mask, frame.depth_sigma, exposure)
            return replace(found, T_camera_moment=frame.T_camera_moment)

        return OwnImages(log.camera, ShelvedList(map(posed, places)), places, len(first))


def _placed_frames(source: AgentInput) -> list[Odometry]:
    """Every frame that the front end gave a pose, in order."""
    topic = topics.ODOMETRY.of(source.robot)
    frames = [record.message() for record in read_log(source.frontend, (topic,))]
    placed = [f for f in frames if f.status != "lost"]
    if not placed:
        raise DuagError(f"{source.frontend}: {topic} has no tracked frame")
    return placed
