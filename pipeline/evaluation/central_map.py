"""One map trained on the images of all robots, to compare with: what a server has that gets every map and every image.

It begins with the own maps of all robots of a component, laid together where the consensus put them, doubles and all,
and takes as many steps as the final maps of these robots together, on the images that each of them trains on.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.evaluation.longer_training import camera_of, context_of, images_of, steps_of_final_map
from duagc.pipeline.fusion.finetune import finetune_map
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs.folder import RobotRun, RunFolder
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
    steps, views, cameras, maps = 0, list[PosedRgbd](), list[PinholeCamera](), list[Gaussians]()
    for robot in team:
        cameras.append(camera_of(robot, source))
        images = images_of(run, robot, source, robot.trajectory.poses)
        steps += steps_of_final_map(run, robot, images)
        views += images
        T_map_keyframe = np.array([k.T_map_camera for k in robot.keyframes])
        maps.append(robot.own_map.gaussians.moved(T_map_keyframe, robot.corrected.T_world_keyframe))
    depth = team[0].own_map.depth
    if any(camera != cameras[0] for camera in cameras) or any(r.own_map.depth != depth for r in team):
        raise DuagError(
            f"{run.path}: robots have different cameras or kinds of maps, "
            "expected the same of all for evaluation.central_map"
        )
    context = context_of(run, cameras[0], depth, threads)
    return finetune_map(Gaussians.concatenate(maps), views, context, steps=(steps, 0))
