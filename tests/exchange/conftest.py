"""A tiny world to meet in: a textured box room, seen by robots whose map frames nobody knows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.messages import GaussianInformation
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.runs.keyframe_images import Images
from duagc.pipeline.runs.robot_data import RobotData, SessionResult
from duagc.pipeline.splat.gaussians import Gaussians
from tests.exchange.meeting import NAMES, Team, meet

MakeRobot = Callable[..., tuple[RobotData, Array]]
CAMERA = PinholeCamera(240, 180, 200.0, 200.0, 119.5, 89.5)
HALF_M = np.array([2.0, 1.3, 2.4])  # half the edges of the room


@lru_cache(maxsize=1)
def textures() -> Array:
    """Color of the six walls, [6, 256, 256, 3], smooth noise with edges."""
    rng = random_streams.generator(0, "textures")
    walls = np.zeros((6, 256, 256, 3))
    for cells, weight in ((8, 0.3), (32, 0.4), (128, 0.3)):
        coarse = rng.random((6, cells, cells, 3))
        walls += weight * np.repeat(np.repeat(coarse, 256 // cells, axis=1), 256 // cells, axis=2)
    return walls


def view(
    T_world_camera: Array, camera: PinholeCamera = CAMERA
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Color and depth of the room from inside."""
    rays = camera.rays() @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    with np.errstate(divide="ignore"):
        reach = (np.sign(rays) * HALF_M - origin) / rays
    axis = np.argmin(reach, axis=-1)
    depth = np.take_along_axis(reach, axis[..., None], axis=-1)[..., 0]
    hit = origin + depth[..., None] * rays
    wall = 2 * axis + (np.take_along_axis(rays, axis[..., None], axis=-1)[..., 0] > 0)
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    uv = np.take_along_axis(hit / HALF_M, others, axis=-1)
    texel = np.clip(((uv + 1) * 128).astype(int), 0, 255)
    color = textures()[wall, texel[..., 0], texel[..., 1]]
    return np.rint(255 * color).astype(np.uint8), depth.astype(np.float32)


def path(first_turn_rad: float, keyframes: int) -> Array:
    """T_world_camera [k, 4, 4]: looking outwards, turning about the vertical while moving a little."""
    poses = []
    for k in range(keyframes):
        angle = first_turn_rad + 0.3 * k
        R = so3.exp([0.0, angle, 0.0]) @ so3.exp([0.05 * np.sin(k), 0.0, 0.0])
        poses.append(se3.from_rotation_translation(R, [0.3 * np.cos(angle), 0.1, 0.3 * np.sin(angle)]))
    return np.array(poses)


def robot(
    name: str, first_turn_rad: float, keyframes: int = 5, gaussians: int = 300
) -> tuple[RobotData, Array]:
    """A robot's data, and the truth: T_world_camera of its keyframes."""
    rng = random_streams.generator(0, "boxworld", robot=name)
    truth = path(first_turn_rad, keyframes)
    steps, T_map = [], [np.eye(4)]
    for k in range(1, keyframes):
        noise = np.concatenate([rng.normal(0, 0.004, 3), rng.normal(0, 0.002, 3)])
        T = se3.inverse(truth[k - 1]) @ truth[k] @ se3.exp(noise)
        information = np.diag([1 / 0.004**2] * 3 + [1 / 0.002**2] * 3)
        steps.append(RelativePose(k - 1, k, T, information))
        T_map.append(T_map[-1] @ T)
    poses = np.array(T_map)
    images = [Images(*view(T)) for T in truth]
    anchors = rng.integers(0, keyframes, gaussians)
    v, u = rng.integers(5, CAMERA.height - 5, gaussians), rng.integers(5, CAMERA.width - 5, gaussians)
    depth = np.array([images[a][1][y, x] for a, y, x in zip(anchors, v, u, strict=True)])
    color = np.array([images[a][0][y, x] for a, y, x in zip(anchors, v, u, strict=True)]) / 255
    points = CAMERA.rays()[v, u] * depth[:, None]
    means = (poses[anchors, :3, :3] @ points[..., None])[..., 0] + poses[anchors, :3, 3]
    maps = Gaussians(
        np.arange(gaussians) + 10,
        anchors.astype(np.int32),
        means,
        rng.normal(size=(gaussians, 4)),
        np.log(rng.uniform(0.01, 0.04, (gaussians, 3))),
        color,
        rng.normal(size=gaussians),
    )
    return RobotData(
        name, CAMERA, poses, steps, steps, images.__getitem__, maps, information_of(name, maps, rng)
    ), truth


def information_of(name: str, maps: Gaussians, rng: np.random.Generator) -> GaussianInformation:
    """Random positive semidefinite information, zero for a tenth of the Gaussians."""
    n = len(maps)
    root = rng.normal(size=(n, 9, 9)) * np.array([100.0] * 3 + [10.0] * 6)[:, None]
    full = root @ np.swapaxes(root, 1, 2)
    full[::10] = 0.0
    rows, columns = np.triu_indices(9)
    return GaussianInformation(
        0,
        name,
        "gauss_newton",
        "all",
        maps.ids,
        full[:, rows, columns].astype(np.float32),
        rng.uniform(0, 1e4, (n, 3)).astype(np.float32),
        rng.uniform(0, 10, n).astype(np.float32),
        np.full(n, 3, np.uint32),
        0.02,
        "0.0012 + 0.0019 (z - 0.4)^2",
        rng.uniform(0.001, 0.02, n).astype(np.float32),
        9.0,
        25.0,
        12.0,
    )


@pytest.fixture(scope="session")
def make_robot() -> MakeRobot:
    """Gives `robot`: name, first viewing direction (rad), number of keyframes and of Gaussians."""
    return robot


@pytest.fixture(scope="session")
def team(make_robot: MakeRobot) -> Team:
    """Three robots; the map of the last was made with another depth."""
    robots = {name: make_robot(name, 0.6 * i, keyframes=4) for i, name in enumerate(NAMES)}
    data, T_true = robots["charlie"]
    camera = replace(data.camera, cx=data.camera.cx + 0.01)
    return robots | {"charlie": (replace(data, depth="ray_plane", camera=camera), T_true)}


@pytest.fixture(scope="session")
def undisturbed(team: Team, tmp_path_factory: pytest.TempPathFactory) -> dict[str, SessionResult]:
    return meet(team, 2, tmp_path_factory.mktemp("undisturbed"))
