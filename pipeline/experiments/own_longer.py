"""Own maps trained as long as the refined ones, without the team.

The comparison separates what the refined map owes to the team from what it owes to more training.
"""

from __future__ import annotations

import numpy as np

from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.evaluation.central_map import camera_of, images_of
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.finetune import finetune_map, num_steps
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
    frames = [f for f in robot.frames if f.status != "lost"]
    config = run.config.fusion.finetune
    poses = np.array([f.T_map_camera for f in frames])
    own = robot.own_map
    keyframes = len(robot.keyframes)
    views = images_of(run, robot, source, poses)
    steps = sum(num_steps(config, len(views), 1, keyframes))
    # `finetune_map` makes more of it for a long log, as `num_steps` did
    most = -(-steps * config.keyframes // max(keyframes, config.keyframes))
    context = MapContext(
        camera_of(robot, source),
        FusionConfig(finetune=config.model_copy(update={"steps_per_view": steps, "steps_max": most})),
        run.config.matching,
        own.depth,
        threads=threads,
        seed=run.config.seed,
    )
    return finetune_map(own.gaussians, views, context, keyframes=keyframes)
