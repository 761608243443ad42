"""Depth of another sensor as a depth image of the color camera. Arrays in, arrays out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.inverse_depth import inverse_or_zero
from duagc.pipeline.kernels.drawn_depth import registered_depth

Image = NDArray[np.float32]
MOST_SAMPLES = 64_000_000  # of a depth image that is registered; each takes twelve bytes


def sample_steps(depth_camera: PinholeCamera, camera: PinholeCamera) -> int:
    """Samples per pixel of the depth camera, along either axis, that leave no gaps in the other camera.

    Args:
        depth_camera: that measured the depth.
        camera: into whose pixels it is moved.
    """
    growth = max(camera.fx / depth_camera.fx, camera.fy / depth_camera.fy)
    return max(1, int(np.ceil(1.5 * growth)))


def register_depth(
    depth_m: Image, depth_camera: PinholeCamera, T_camera_depth: Array, camera: PinholeCamera
) -> Image:
    """The depth image of one camera as another one would see it.

    Inverse depth is interpolated between the pixels of one surface (exact on planes), dense enough to leave no gaps,
    never across a step; every point falls on one pixel, where the nearest surface wins. What the depth camera did not
    see stays 0.

    Args:
        depth_m: [h, w], meters along z of the depth camera, 0 = unknown.
        depth_camera: that measured it.
        T_camera_depth: [4, 4], pose of the depth camera in the other one.
        camera: the other one.

    Returns:
        float32 [camera.height, camera.width], meters along z of `camera`, 0 = unknown.
    """
    inverse = inverse_or_zero(depth_m).astype(np.float64)
    steps = sample_steps(depth_camera, camera)
    return registered_depth(inverse, depth_camera, T_camera_depth, camera, steps=steps)
