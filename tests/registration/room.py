"""A textured room with a box in it, rendered exactly by intersecting rays with planes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 79.5, 59.5)
ROOM = (np.array([-1.5, -1.2, -2.0]), np.array([1.8, 1.2, 2.0]))
BOX = (np.array([-0.3, 0.2, 1.0]), np.array([0.5, 1.2, 1.6]))

Image = NDArray[np.float32]


def render(
    T_world_camera: NDArray[np.float64],
    noise: np.random.Generator | None = None,
    camera: PinholeCamera = CAMERA,
    texture_seed: int = 0,
    depth_sigma_m: float = 0.004,
    gray_sigma: float = 0.02,
) -> tuple[Image, Image]:
    """Gray image [h, w] in 0..1 and depth [h, w] in meters; independent pixel noise if a generator is given."""
    origin, rays = T_world_camera[:3, 3], camera.rays() @ T_world_camera[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        # inside the room the nearest far side is hit; the box is hit if the last entry comes before the first exit
        sides = (ROOM[0] - origin) / rays, (ROOM[1] - origin) / rays
        depth = np.maximum(*sides).min(axis=-1)
        sides = (BOX[0] - origin) / rays, (BOX[1] - origin) / rays
        enter, leave = np.minimum(*sides).max(axis=-1), np.maximum(*sides).min(axis=-1)
    depth = np.where((enter < leave) & (enter > 0) & (enter < depth), enter, depth)
    gray = texture(origin + rays * depth[..., None], texture_seed)
    if noise is not None:
        depth = depth + depth_sigma_m * noise.standard_normal(depth.shape)
        gray = gray + gray_sigma * noise.standard_normal(gray.shape)
    return gray.astype(np.float32), depth.astype(np.float32)


def texture(points_world: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """A smooth solid texture, mean 0.5, of waves 0.4 to 1.6 m long."""
    draw = np.random.default_rng(seed)
    gray = np.full(points_world.shape[:-1], 0.5)
    for _ in range(12):
        direction = draw.standard_normal(3)
        wave = direction / np.linalg.norm(direction) * draw.uniform(4.0, 16.0)
        gray += 0.06 * np.sin(points_world @ wave + draw.uniform(0, 2 * np.pi))
    return gray


def pose(
    x: float = 0.0, y: float = 0.0, z: float = -0.8, yaw: float = 0.0, pitch: float = 0.0
) -> NDArray[np.float64]:
    """T_world_camera [4, 4]: position in meters, yaw about the camera's y and pitch about its x in radians."""
    T = se3.exp(np.array([0, 0, 0, 0, yaw, 0])) @ se3.exp(np.array([0, 0, 0, pitch, 0, 0]))
    T[:3, 3] = x, y, z
    return T
