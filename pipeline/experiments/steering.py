"""Recordings of a robot whose next leg is chosen by the map that it has, among legs that are drawn at random.

The first robot of the team is steered. After every leg its own log is mapped, and its map says where to go: to the
view of the largest gain in information, to where it has drawn least, or nothing (then it goes at random). The other
robots walk as always; their held-out views, which have nothing to do with the choice, show what its map is worth.
The policy knows the robot's estimates alone: a leg is a known motion from its estimated pose.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from duagc.converters.simulate.settings import SimulationSettings, camera_of
from duagc.converters.simulate.simulated_scenes import set_up
from duagc.converters.simulate.team import simulate
from duagc.converters.simulate.trajectories.legs import FIRST_FRAMES, LEG_FRAMES, LegPlanner
from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.experiments.rule import Policy
from duagc.pipeline.frontend.stage import run_frontend
from duagc.pipeline.frontend.view_gain import ViewGain
from duagc.pipeline.geometry import se3
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs.folder import RobotRun

CANDIDATES = 12
"""Legs that a policy chooses among."""
DRAWN = 0.5
"""Opacity from which on a pixel shows the map."""


def simulate_steered(
    folder: Path, settings: SimulationSettings, policy: Policy, overrides: Sequence[str]
) -> None:
    """Make the recording of a team whose first robot is steered.

    Args:
        folder: of the recording, made here.
        settings: of the simulator, for the whole team; all frames are recorded.
        policy: chooses the legs.
        overrides: settings of the run, `a.b=value`, by which the robot maps.

    Raises:
        DuagError: there is no room for legs, or the robot finds no frame to begin a map with.
    """
    config = load_config(RunConfig, None, list(overrides))
    camera, frames = camera_of(settings.size), settings.frames
    with tempfile.TemporaryDirectory(prefix="duagc-steered-") as name:
        cache = Path(name)
        (cache / "scene").mkdir()
        scene = set_up(settings.scene, "", settings.seed, cache / "scene", as_meshes=settings.needs_triangles)
        usual = scene.wander(settings.robots, frames, settings.overlap, camera)
        path = usual[0][frames // 2 :][:FIRST_FRAMES]
        planner = LegPlanner(scene, LEG_FRAMES)
        while len(path) < frames:
            rng = random_streams.generator(settings.seed, "steering", frames=len(path))
            legs = planner.draw(path[-1], CANDIDATES, rng)
            chosen = 0
            if policy != "random":
                robot = _mapped(cache / str(len(path)), settings, config, path)
                gain = ViewGain(
                    robot.own_map.gaussians, robot.own_map.depth, camera, config.frontend.mapping, threads=1
                )
                chosen = _chosen(policy, robot, gain, views_after(robot, path, legs))
            path = np.concatenate([path, legs[chosen]])
    simulate(folder, **vars(settings), paths=[path[:frames], *usual[1:]])


def _mapped(folder: Path, settings: SimulationSettings, config: RunConfig, path: Array) -> RobotRun:
    """What the robot knows at the end of its path."""
    alone = vars(settings) | {"robots": 1, "frames": len(path)}
    simulate(folder / "recording", **alone, paths=[path])
    recording = Recording(folder / "recording")
    name = recording.robots[0]
    run_frontend(recording.log(name), folder / "frontend.mcap", config.frontend, seed=config.seed)
    return RobotRun(name, folder)


def views_after(robot: RobotRun, path: Array, legs: Sequence[Array]) -> list[Array]:
    """T_map_camera [4, 4] at the end of every leg, from the last pose that was estimated.

    Args:
        robot: with its frames.
        path: [n, 4, 4], T_world_camera of these frames; its motion since the last estimate is known.
        legs: [m, 4, 4] each, from the end of the path.
    """
    last = next(frame for frame in reversed(robot.frames) if frame.status != "lost")
    T_camera_world = se3.inverse(path[last.frame_index])
    return [last.T_map_camera @ T_camera_world @ leg[-1] for leg in legs]


def _chosen(policy: Policy, robot: RobotRun, gain: ViewGain, views: Sequence[Array]) -> int:
    if policy == "unseen":
        return int(np.argmax([unseen(gain, T_map_camera) for T_map_camera in views]))
    seen = [keyframe.T_map_camera for keyframe in robot.keyframes]
    return gain.chosen(seen, views, 1, least=policy == "least")[0]


def unseen(gain: ViewGain, T_map_camera: Array) -> float:
    """Share of the pixels of a half-size view that show nothing of a map.

    Args:
        gain: with the map.
        T_map_camera: [4, 4] of the view.
    """
    drawn = Rasterizer(threads=gain.threads).forward(
        gain.gaussians, gain.camera.halved(), se3.inverse(T_map_camera), depth_kind=gain.depth
    )
    return float(np.mean(drawn.alpha < DRAWN))
