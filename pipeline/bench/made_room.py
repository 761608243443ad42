"""A room made of flat Gaussians, and a view of it."""

from __future__ import annotations

import numpy as np

from duagc.pipeline.geometry import so3
from duagc.pipeline.splat.gaussians import Gaussians

ROOM_M = np.array([6.0, 3.0, 5.0])  # x, y down, z
SPACING_PER_SCALE, FLATNESS = 0.62, 0.13


def make_room(n: int, seed: int = 0) -> Gaussians:
    """n flat Gaussians on the walls, floor and ceiling of a room, seen from the origin near one of its corners.

    Args:
        n: number of Gaussians.
        seed: of places, sizes and colors.
    """
    rng = np.random.default_rng(seed)
    areas = np.array([ROOM_M[1] * ROOM_M[2], ROOM_M[0] * ROOM_M[2], ROOM_M[0] * ROOM_M[1]]).repeat(2)
    face = rng.choice(6, n, p=areas / areas.sum())
    axis, side = face // 2, face % 2
    points = rng.random((n, 3)) * ROOM_M
    points[np.arange(n), axis] = side * ROOM_M[axis]
    spacing = np.sqrt(areas.sum() / n)
    log_scales = np.log(spacing * SPACING_PER_SCALE) + rng.normal(0, 0.45, (n, 3))
    log_scales[np.arange(n), axis] += np.log(FLATNESS)
    angle = rng.uniform(0, np.pi, n)
    turn = so3.exp(angle[:, None] * np.eye(3)[axis])  # about the normal
    return Gaussians(
        ids=np.arange(n),
        anchors=np.zeros(n, dtype=np.int32),
        means=points - np.array([0.5, 1.3, 0.4]),
        quats_wxyz=so3.to_quat_wxyz(turn).astype(np.float32),
        log_scales=log_scales,
        colors=np.clip(0.5 + 0.3 * np.sin(2 * points) + rng.normal(0, 0.08, (n, 3)), 0, 1),
        opacity_logits=rng.normal(1.0, 1.6, n).astype(np.float32),
    )


def view_of_room() -> np.ndarray:
    """T_camera_map [4, 4]: from the origin toward the far corner."""
    forward = np.array([3.7, 0.4, 3.6])
    z = forward / np.linalg.norm(forward)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z])
    return T
