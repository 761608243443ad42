"""Sweeps of a LiDAR as depth images of a camera next to it, with the standard deviation of every pixel.

Neighboring beams that meet one surface are joined to triangles, as the LiDAR sees them. Drawn from the camera with a
z-buffer they say two things: which points the camera cannot see, because a nearer surface hides them, and how deep the
surface is between the points. Pixels that a visible point falls on have exactly its depth; between the points the
depth is interpolated, and less certain the more it changes there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.inverse_depth import inverse_or_zero
from duagc.pipeline.geometry.projection import inside
from duagc.pipeline.kernels.drawn_depth import drawn_triangles
from duagc.pipeline.kernels.drawn_depth_definition import Indices, largest

Image = NDArray[np.float32]
NEAREST_M = 0.05
LONGEST_SIDE = 0.06  # of a triangle as the LiDAR sees it, in focal lengths: rings may be 3 degrees apart
SAME_SURFACE = 0.05  # relative step of range between neighboring beams that is always one surface
LEAST_SLOPE_RAD = np.radians(
    10.0
)  # else: the angle between the beam and the surface; at less there is an edge
HIDDEN = 0.03  # relative depth behind the nearest surface from which a point is hidden
SIGMA_OF_CHANGE = 0.25  # of an interpolated depth, as a share of the change of depth over its triangle


def lidar_depth(
    points_lidar: Array, T_camera_lidar: Array, camera: PinholeCamera, range_sigma_m: float
) -> tuple[Image, Image]:
    """Depth of a sweep as the camera would see it, and its standard deviation.

    Args:
        points_lidar: [n, 3], meters, of one sweep, all as of one time.
        T_camera_lidar: [4, 4], pose of the LiDAR in the camera.
        camera: that sees them.
        range_sigma_m: standard deviation of a range.

    Returns:
        Depth along z and sigma, float32 [camera.height, camera.width], meters; both 0 where nothing is known.
    """
    points, rays = _before(points_lidar, T_camera_lidar, camera)
    pixels, inverse = camera.project(points), 1 / points[:, 2]
    triangles = _surfaces(rays)
    between, change = (image.ravel() for image in drawn_triangles(pixels, inverse, triangles, camera))

    u, v = np.rint(pixels).astype(np.int64).T
    seen = inside(u, v, (camera.height, camera.width))
    pixel = np.where(seen, v * camera.width + u, 0)
    behind_m = np.where(between[pixel] > 0, points[:, 2] - 1 / np.maximum(between[pixel], 1e-9), 0)
    visible = np.flatnonzero(seen & (behind_m <= HIDDEN * points[:, 2] + 3 * range_sigma_m))
    hit = visible[largest(pixel[visible], inverse[visible])]

    known = between > 0
    depth = inverse_or_zero(between)
    sigma = np.where(known, np.hypot(range_sigma_m, SIGMA_OF_CHANGE * change), 0)
    depth[pixel[hit]], sigma[pixel[hit]] = points[hit, 2], range_sigma_m
    shape = camera.height, camera.width
    return depth.reshape(shape).astype(np.float32), sigma.reshape(shape).astype(np.float32)


def _before(points_lidar: Array, T_camera_lidar: Array, camera: PinholeCamera) -> tuple[Array, Array]:
    """Points [m, 3] in and near the view, camera frame, and the same from the LiDAR's place, in the camera's axes."""
    points = se3.transform(T_camera_lidar, points_lidar)
    rays = points - T_camera_lidar[:3, 3]
    front = (points[:, 2] > NEAREST_M) & (rays[:, 2] > NEAREST_M)
    points, rays = points[front], rays[front]
    pixels, size = camera.project(points), np.array([camera.width, camera.height])
    margin = LONGEST_SIDE * camera.fx  # around the image, for triangles that reach into it
    near = ((pixels > -margin) & (pixels < size + margin)).all(axis=1)
    return points[near], rays[near]


def _surfaces(rays: Array) -> Indices:
    """Triangles [t, 3] of neighboring beams that meet one surface."""
    from scipy.spatial import Delaunay, QhullError

    beams, ranges = rays[:, :2] / rays[:, 2:], np.linalg.norm(rays, axis=1)
    try:
        triangles = (
            Delaunay(beams).simplices.astype(np.int64) if len(beams) >= 3 else np.zeros((0, 3), np.int64)
        )
    except QhullError:  # all on one line
        triangles = np.zeros((0, 3), np.int64)
    sound = np.ones(len(triangles), bool)
    for side in ((0, 1), (1, 2), (2, 0)):
        a, b = triangles[:, side].T
        near, far = np.minimum(ranges[a], ranges[b]), np.maximum(ranges[a], ranges[b])
        across_m = (
            np.linalg.norm(np.cross(rays[a], rays[b]), axis=1) / far
        )  # of the nearer point from the other's beam
        along_m = far - (rays[a] * rays[b]).sum(axis=1) / far
        smooth = (far <= (1 + SAME_SURFACE) * near) | (np.arctan2(across_m, along_m) >= LEAST_SLOPE_RAD)
        sound &= smooth & (np.linalg.norm(beams[a] - beams[b], axis=1) <= LONGEST_SIDE)
    return triangles[sound]
