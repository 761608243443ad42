"""Training maps of a finished run once more, as long as its final maps were: images, settings and steps of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.finetune import num_steps
from duagc.pipeline.fusion.own_images import training_images
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.recording import Recording, open_rgbd
from duagc.pipeline.runs.folder import RobotRun, RunFolder
from duagc.pipeline.runs.robot_data import AgentInput
from duagc.pipeline.splat.training_frames import blur_distance_m


def context_of(run: RunFolder, camera: PinholeCamera, depth: DepthKind, threads: int) -> MapContext:
    """Camera and settings, as of the fusion of a run.

    Args:
        run: whose settings are used.
        camera: of the images.
        depth: of a Gaussian at a pixel.
        threads: of the rasterizer; changes no bit.
    """
    config = run.config
    return MapContext(camera, config.fusion, config.matching, depth, threads=threads, seed=config.seed)


def steps_of_final_map(run: RunFolder, robot: RobotRun, images: Sequence[PosedRgbd]) -> int:
    """Steps that the final map of a robot with peers took, on own images and on views of peers.

    Args:
        run: of the robot.
        robot: the robot.
        images: that its final map is trained on.
    """
    config, depth = run.config.fusion.finetune, robot.own_map.depth
    return sum(num_steps(config, len(images), 1, len(robot.keyframes), depth=depth))


def camera_of(robot: RobotRun, source: Recording) -> PinholeCamera:
    """The camera of a robot.

    Args:
        robot: of a run.
        source: its recording.
    """
    with open_rgbd(source.log(robot.robot)) as log:
        return log.camera


def images_of(run: RunFolder, robot: RobotRun, source: Recording, poses: Array) -> Sequence[PosedRgbd]:
    """The images that a robot's final map is trained on.

    Args:
        run: of the robot.
        robot: the robot.
        source: its recording.
        poses: [n, 4, 4], of all frames that were not lost, in order, in the frame of the map.
    """
    files = AgentInput(
        robot.robot,
        source.log(robot.robot),
        robot.folder / "frontend.mcap",
        robot.folder / "information.mcap",
        run.config.thickness_floor_m,
    )
    frames = [f for f in robot.frames if f.status != "lost"]
    config = run.config.fusion.finetune
    num_support = config.at_most(config.support_views, len(robot.keyframes))
    T_map_keyframe, own = np.array([k.T_map_camera for k in robot.keyframes]), robot.own_map
    seen_m = blur_distance_m(own.gaussians, T_map_keyframe, own.depth)
    images = training_images(files, frames, num_support=num_support, seen_m=seen_m)
    return images.views(poses, run.config.frontend.moving)
