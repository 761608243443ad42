"""Own maps trained as long as the refined ones, without the team.

The comparison separates what the refined map owes to the team from what it owes to more training.
"""

from __future__ import annotations

import numpy as np

from duagc.pipeline.evaluation.longer_training import camera_of, context_of, images_of, steps_of_final_map
from duagc.pipeline.fusion.finetune import finetune_map
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs.folder import RobotRun, RunFolder
from duagc.pipeline.splat.gaussians import Gaussians


def own_longer(run: RunFolder, source: Recording, threads: int) -> dict[str, Gaussians]:
    """The own map of every robot that has a refined one, trained again with as many steps, on own images alone.

    Args:
        run: a finished run.
        source: its recording.
        threads: of the rasterizer; changes no bit of the result.

    Returns:
        Maps by robot, each in the map frame of its robot.
    """
    return {
        name: _trained(run, robot, source, threads)
        for name, robot in run.robots.items()
        if robot.refined_map is not None
    }


def _trained(run: RunFolder, robot: RobotRun, source: Recording, threads: int) -> Gaussians:
    poses = np.array([f.T_map_camera for f in robot.frames if f.status != "lost"])
    views = images_of(run, robot, source, poses)
    context = context_of(run, camera_of(robot, source), robot.own_map.depth, threads)
    steps = steps_of_final_map(run, robot, views)
    return finetune_map(
        robot.own_map.gaussians, views, context, keyframes=len(robot.keyframes), steps=(steps, 0)
    )
