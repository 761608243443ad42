"""Depth images in which single pixels are known, and no surface: interpolated between them.

Such are the points of a LiDAR drawn into an image, and depth that was registered to a much finer image without filling.
The known pixels are taken for the sweep of a LiDAR in the place of the camera.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.inverse_depth import inverse_or_zero
from duagc.pipeline.geometry.projection import back_project
from duagc.pipeline.geometry.scattered_holes import holes_are_scattered, without_scattered_holes
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.recording.lidar import lidar_depth

Image = NDArray[np.float32]

AROUND_PX = 9  # side of the square around a known pixel in which others are counted
MOST_AROUND = 0.4  # share of them that is known, in the median, up to which depth may be sparse
MOST_POINTS = 20_000  # between which surfaces are drawn: of more, some


def is_sparse(depth_m: Image) -> bool:
    """Whether so few pixels are known that `without_scattered_holes` leaves most surfaces open.

    Args:
        depth_m: [h, w], meters, 0 = unknown.
    """
    import cv2

    known = depth_m > 0
    if not known.any():
        return False
    around = cv2.boxFilter(
        known.astype(np.float32), -1, (AROUND_PX, AROUND_PX), borderType=cv2.BORDER_CONSTANT
    )
    if np.median(around[known]) > MOST_AROUND:
        return False
    return holes_are_scattered(without_scattered_holes(inverse_or_zero(depth_m), None))


def between_pixels(depth_m: Image, camera: PinholeCamera) -> Image:
    """Depth [h, w] that is known between known pixels of one surface, too.

    Args:
        depth_m: [h, w], meters along z, 0 = unknown.
        camera: of the image.
    """
    v, u = np.nonzero(depth_m > 0)
    some = np.array(evenly_spaced(len(v), min(len(v), MOST_POINTS)), dtype=np.int64)
    points = back_project(camera, u[some], v[some], depth_m[v[some], u[some]].astype(np.float64))
    surfaces, _ = lidar_depth(points, np.eye(4), camera, 0.0)
    return np.where(depth_m > 0, depth_m, surfaces)
