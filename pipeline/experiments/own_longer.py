"""Own maps trained as long as the refined ones, without the team.

The comparison separates what the refined map owes to the team from what it owes to more training.
"""

from __future__ import annotations

import numpy as np

from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.finetune import finetune_map, num_steps
from duagc.pipeline.fusion.stage import training_views
from duagc.pipeline.recording import Recording, open_rgbd
from duagc.pipeline.runs.folder import RobotRun, RunFolder
from duagc.pipeline.runs.robot_data import AgentInput
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
    log = source.log(robot.robot)
    files = AgentInput(
        robot.robot,
        log,
        robot.folder / "frontend.mcap",
        robot.folder / "information.mcap",
        run.config.thickness_floor_m,
    )
    frames = [f for f in robot.frames if f.status != "lost"]
    config = run.config.fusion.finetune
    poses = np.array([f.T_map_camera for f in frames])
    own = robot.own_map
    with open_rgbd(log) as camera_log:
        camera = camera_log.camera
    keyframes = len(robot.keyframes)
    num_support = config.at_most(config.support_views, keyframes)
    views = training_views(files, frames, poses, num_support=num_support, moving=run.config.frontend.moving)
    steps = sum(num_steps(config, len(views), 1, keyframes))
    context = MapContext(
        camera,
        FusionConfig(finetune=config.model_copy(update={"steps_per_view": steps, "steps_max": steps})),
        run.config.matching,
        own.depth,
        threads=threads,
        seed=run.config.seed,
    )
    return finetune_map(own.gaussians, views, context, keyframes=keyframes)
