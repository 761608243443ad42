"""A box room rendered exactly, for fixtures in the datasets' own files."""

from pathlib import Path

import cv2
import numpy as np

from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera

HALF_M = np.array([4.0, 3.0, 2.5])


def render(
    camera: PinholeCamera, T_world_camera: np.ndarray, distortion: tuple[float, ...] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Color uint8 [H, W, 3] and exact z-depth (m) [H, W] as a camera with this distortion sees the room."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    points = np.stack([u, v], -1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    flat = cv2.undistortPoints(points, K, np.array(distortion or np.zeros(5)), None, None, None, criteria)[
        :, 0
    ]
    rays = np.c_[flat, np.ones(len(flat))] @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    with np.errstate(divide="ignore"):
        reach = np.where(rays > 0, (HALF_M - origin) / rays, (-HALF_M - origin) / rays)
    z = reach.min(axis=1)
    hit = origin + z[:, None] * rays
    shade = (np.floor(hit * 4).sum(axis=1) % 2) * 90 + 60 + 20 * reach.argmin(axis=1)
    color = np.stack([shade, shade * 0.8 + hit[:, 0] * 10, shade * 0.6 + hit[:, 2] * 20], axis=-1)
    shape = camera.height, camera.width
    return np.clip(color, 0, 255).astype(np.uint8).reshape(*shape, 3), z.reshape(shape)


def look(place: list[float], target: list[float]) -> np.ndarray:
    """T_world_camera [4, 4] at a place, looking at a target; world z is up."""
    z = np.subtract(target, place).astype(float)
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return se3.from_rotation_translation(np.stack([x, np.cross(z, x), z], axis=1), place)


def path(frames: int, start: float = 0.0) -> list[np.ndarray]:
    """Poses on a rising arc, looking at a corner."""
    angles = start + 0.1 * np.arange(frames)
    places = [[1.5 * np.cos(a), 1.5 * np.sin(a), 0.2 + 2 * (a - start)] for a in angles]
    return [look(place, [4.0, 3.0, -0.5]) for place in places]


def save(path: Path, image: np.ndarray) -> None:
    """Write an RGB or 16-bit image by the extension of its name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = image[..., ::-1] if image.ndim == 3 else image
    quality = [cv2.IMWRITE_JPEG_QUALITY, 95] if path.suffix.lower() in (".jpg", ".jpeg") else []
    assert cv2.imwrite(str(path), np.ascontiguousarray(pixels), quality)
