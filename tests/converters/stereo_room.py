"""A textured room with a box, seen exactly by cameras with any lens: what stereo and LiDAR fixtures are made of."""

from functools import cache

import cv2
import numpy as np

from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from tests.converters.box_room import look

LOW, HIGH = np.array([-4.0, -3.0, -2.5]), np.array([4.0, 3.0, 2.5])
BOX = np.array([1.2, -0.2, -2.5]), np.array([2.0, 0.9, 0.1])
TEXELS_PER_M = 96


def cast(origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far along rays [..., 3] a surface is met, in lengths of the ray, and the axis across that surface [...]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        out = np.maximum((LOW - origin) / rays, (HIGH - origin) / rays)
        sides = (BOX[0] - origin) / rays, (BOX[1] - origin) / rays
    enter, leave = np.minimum(*sides), np.maximum(*sides)
    at_box = (enter.max(axis=-1) < leave.min(axis=-1)) & (enter.max(axis=-1) > 0)
    reach = np.where(at_box, enter.max(axis=-1), out.min(axis=-1))
    return reach, np.where(at_box, enter.argmax(axis=-1) + 3, out.argmin(axis=-1))


@cache
def _texture() -> np.ndarray:
    """Gray bitmap of noise at several scales, 8 m on a side."""
    draw, size = np.random.default_rng(3), 8 * TEXELS_PER_M
    image = np.zeros((size, size), np.float32)
    for coarse, weight in ((1, 0.5), (2, 1.0), (4, 1.5), (12, 2.0), (40, 2.0)):
        noise = draw.standard_normal((size // coarse, size // coarse)).astype(np.float32)
        image += weight * cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 22 * image, 5, 250).astype(np.float32)


def rays_of(camera: PinholeCamera, distortion: tuple[float, ...] = ()) -> np.ndarray:
    """Ray [h, w, 3] with z = 1 of every pixel of a camera with this distortion."""
    if not distortion:
        return camera.rays()
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    points = np.stack([u, v], -1).reshape(-1, 1, 2)
    flat = cv2.undistortPoints(points, camera.matrix(), np.array(distortion), None, None, None, criteria)
    return np.concatenate([flat[:, 0], np.ones((len(flat), 1))], axis=1).reshape(
        camera.height, camera.width, 3
    )


def render(
    camera: PinholeCamera, T_world_camera: np.ndarray, distortion: tuple[float, ...] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Color uint8 [h, w, 3] and exact z-depth [h, w] in meters."""
    rays = rays_of(camera, distortion) @ T_world_camera[:3, :3].T
    depth, side = cast(T_world_camera[:3, 3], rays)
    hit = T_world_camera[:3, 3] + rays * depth[..., None]
    axis = side % 3
    a, b = (np.take_along_axis(hit, ((axis + k) % 3)[..., None], -1)[..., 0] for k in (1, 2))
    x, y = ((c + 4 + 0.7 * side) % 8 * TEXELS_PER_M for c in (a, b))
    gray = cv2.remap(_texture(), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    tint = 0.75 + 0.05 * side[..., None] * np.array([1.0, 0.5, 0.2])
    return np.clip(np.rint(gray[..., None] * tint), 0, 255).astype(np.uint8), depth


def path(frames: int, start: float = 0.0, step: float = 0.03) -> list[np.ndarray]:
    """Poses on an arc before the box, looking past it."""
    angles = start + step * np.arange(frames)
    places = [[-2.2 + 0.3 * np.sin(3 * a), -1.5 + 2.2 * a, -0.4 + 0.4 * a] for a in angles]
    return [look(place, [3.0, 0.6 + 0.5 * a, -1.0]) for place, a in zip(places, angles, strict=True)]


def sweep(
    T_world_lidar: np.ndarray,
    rings: int = 16,
    columns: int = 900,
    sigma_m: float = 0.0,
    seed: int = 0,
    part: tuple[float, float] = (180.0, -180.0),
) -> np.ndarray:
    """Points [n, 3] in the frame of a spinning LiDAR (x forward, z up): rings over 30 degrees, columns of a turn.

    part: of the turn, degrees, from the first column to the last, which is left out.
    """
    elevation = np.radians(np.linspace(-15, 15, rings))[None, :]
    count = round(columns * (part[0] - part[1]) / 360)
    azimuth = np.radians(np.linspace(*part, count, endpoint=False))[:, None]
    rays = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation) + 0 * azimuth,
        ],
        axis=-1,
    )
    reach, _ = cast(T_world_lidar[:3, 3], rays @ T_world_lidar[:3, :3].T)
    noise = sigma_m * np.random.default_rng(seed).standard_normal(reach.shape)
    return (rays * (reach + noise)[..., None]).reshape(-1, 3)


def right_of(T_world_left: np.ndarray, T_right_left: np.ndarray) -> np.ndarray:
    """T_world_right of a rig."""
    return T_world_left @ se3.inverse(T_right_left)
