"""One map trained on the images of all robots, to compare with: what a server has that gets every map and every image.

It begins with the own maps of all robots of a component, laid together where the consensus put them, doubles and all,
and takes as many steps as the final maps of these robots together, on the images that each of them trains on.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.finetune import finetune_map, num_steps
from duagc.pipeline.fusion.stage import training_views
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.recording import Recording, open_rgbd
from duagc.pipeline.runs.folder import RobotRun, RunFolder
from duagc.pipeline.runs.robot_data import AgentInput
from duagc.pipeline.splat.gaussians import Gaussians


def central_maps(run: RunFolder, source: Recording, threads: int) -> dict[str, Gaussians]:
    """The map of every component of at least two robots, in its world frame, by robot.

    Args:
        run: a run that is fused.
        source: its recording.
        threads: of the rasterizer; changes no bit of the result.

    Raises:
        DuagError: robots of a component have different cameras, or maps of different kinds.
    """
    found = dict[str, Gaussians]()
    for name, robot in run.robots.items():
        team = [run.robots[r] for r in robot.component if run.robots[r].component == robot.component]
        if len(team) > 1 and name not in found:
            found |= dict.fromkeys((r.robot for r in team), _trained(run, team, source, threads))
    return found


def _trained(run: RunFolder, team: Sequence[RobotRun], source: Recording, threads: int) -> Gaussians:
    config, steps, views = run.config.fusion.finetune, 0, list[PosedRgbd]()
    cameras = [camera_of(robot, source) for robot in team]
    depth = team[0].own_map.depth
    if any(camera != cameras[0] for camera in cameras) or any(r.own_map.depth != depth for r in team):
        raise DuagError(
            f"{run.path}: robots have different cameras or kinds of maps, "
            "expected the same of all for evaluation.central_map"
        )
    maps = []
    for robot in team:
        images = images_of(run, robot, source, robot.trajectory.poses)
        steps += sum(num_steps(config, len(images), 1, len(robot.keyframes)))
        views += images
        T_map_keyframe = np.array([k.T_map_camera for k in robot.keyframes])
        maps.append(robot.own_map.gaussians.moved(T_map_keyframe, robot.corrected.T_world_keyframe))
    schedule = config.model_copy(update={"steps_per_view": steps, "steps_max": steps})
    context = MapContext(
        cameras[0],
        FusionConfig(finetune=schedule),
        run.config.matching,
        depth,
        threads=threads,
        seed=run.config.seed,
    )
    return finetune_map(Gaussians.concatenate(maps), views, context)


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
    return training_views(files, frames, poses, num_support=num_support, moving=run.config.frontend.moving)
