"""Features of surfaces as if the camera faced them: they match where two views look at a surface from the side.

SIFT follows turns about the line of sight, sizes, and tilts of some 30 degrees. Depth says how a surface lies: where
many pixels share a normal, the image is turned until the camera looks along that normal, which makes of the surface
what a camera in front of it would see but for its size, and features are found there (as Koeser and Koch 2007, and Wu
et al. 2008, did with patches).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import masks
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.image_sampling import sampled
from duagc.pipeline.geometry.projection import back_project
from duagc.pipeline.registration.descriptors import DIMENSIONS, matches_of, squared_distances
from duagc.pipeline.registration.features import Features
from duagc.pipeline.registration.keypoints import (
    NO_KEYPOINTS,
    Keypoints,
    brightened,
    nearest_pixel,
    strongest_keypoints,
)
from duagc.pipeline.registration.pyramid import RgbdPyramid

COARSE_LEVEL = 2  # of the pyramid, whose normals count
SAME_NORMAL = np.cos(np.radians(20))
FACED = np.cos(np.radians(25))  # surfaces that the camera sees less from the side are left as they are
FARTHEST = np.tan(np.radians(80))  # from the middle of a turned image
LEAST_SHARE = 0.04  # of the coarse pixels that share a normal
TRIED = 100  # normals, evenly spread, of which the one that most voters share is taken
VOTERS = 2000  # normals, evenly spread
ROUNDS = 3  # of taking the mean of those that share it
OUTSIDE = 2  # percent of the pixels on either side that a turned image does without
MOST_PX = 150_000  # of a turned image: three times as many find no more loop closures
SAME_POINT = 0.02
"""Matches whose points are nearer to each other than this, at one meter, in both views, count once."""


@dataclass(frozen=True)
class _Facing:
    """Coarse pixels that share a normal.

    Attributes:
        normal: [3], unit vector toward the camera.
        members: bool [h, w], of the coarse image.
    """

    normal: Array
    members: NDArray[np.bool_]


def extract_rectified(gray: NDArray[np.uint8], pyramid: RgbdPyramid, most: int, planes: int) -> Features:
    """The strongest features of the surfaces of a view that it sees from the side, as if the camera faced them.

    Args:
        gray: uint8 [h, w], of the whole image.
        pyramid: of the view.
        most: number of features kept.
        planes: most directions that the camera is turned to.
    """
    fine = pyramid.levels[0]
    known = fine.inverse_depth > 0 if fine.mask is None else (fine.inverse_depth > 0) & fine.mask
    bright = brightened(gray, known)
    found = [_features_of(bright, pyramid, facing, most) for facing in _facings(pyramid, planes)]
    descriptors = np.concatenate([np.zeros((0, DIMENSIONS), np.uint8), *(k.descriptors for k in found)])
    pixels = np.concatenate([np.zeros((0, 2)), *(k.pixels for k in found)])
    response = np.concatenate([np.zeros(0), *(k.responses for k in found)])
    order = np.lexsort((pixels[:, 0], pixels[:, 1], -response))[:most]
    u, v = pixels[order].T
    depth_m = 1 / fine.inverse_depth[
        nearest_pixel(v, fine.camera.height), nearest_pixel(u, fine.camera.width)
    ].astype(np.float64)
    points = back_project(fine.camera, u, v, depth_m)
    return Features(descriptors[order], points.astype(np.float32))


def _facings(pyramid: RgbdPyramid, most: int) -> list[_Facing]:
    """Normals that many pixels share, the most common first, but for surfaces that the camera faces anyway."""
    coarse = pyramid.levels[min(COARSE_LEVEL, len(pyramid.levels) - 1)]
    normals = coarse.normals.astype(np.float64)
    rays = coarse.camera.rays()
    rays /= np.sqrt(_dot(rays, rays))[..., None]
    left = _dot(normals, normals) > 0.5
    least, out = LEAST_SHARE * left.size, list[_Facing]()
    while len(out) < most and left.sum() > least:
        among = normals[left]
        tried, voters = (among[:: -(-len(among) // most)] for most in (TRIED, VOTERS))
        votes = [int((_dot(voters, one) > SAME_NORMAL).sum()) for one in tried]
        normal = tried[int(np.argmax(votes))]
        for _ in range(ROUNDS):
            normal = among[_dot(among, normal) > SAME_NORMAL].sum(axis=0)
            normal /= np.sqrt(_dot(normal, normal))
        members = left & (_dot(normals, normal) > SAME_NORMAL)
        if members.sum() < least:
            break
        left &= ~members
        if np.median(-_dot(rays[members], normal)) < FACED:
            out.append(_Facing(normal, members))
    return out


def _features_of(gray: NDArray[np.uint8], pyramid: RgbdPyramid, facing: _Facing, most: int) -> Keypoints:
    """What is found where the camera faces a surface, at the pixels of the image."""
    fine, view = pyramid.levels[0], _TurnedView.of(facing, pyramid)
    if view is None:
        return NO_KEYPOINTS
    halvings = fine.camera.height // facing.members.shape[0]

    def usable(u: Array, v: Array, size: Array) -> masks.Mask:
        inside = (u >= 1) & (v >= 1) & (u <= fine.camera.width - 2) & (v <= fine.camera.height - 2)
        row, column = nearest_pixel(v, fine.camera.height), nearest_pixel(u, fine.camera.width)
        coarse = tuple(
            np.minimum(at // halvings, end - 1)
            for at, end in zip((row, column), facing.members.shape, strict=True)
        )
        good = inside & facing.members[coarse] & (fine.inverse_depth[row, column] > 0)
        return good if fine.mask is None else good & (masks.distance_px(fine.mask)[row, column] > size)

    return strongest_keypoints(
        view.image(gray), most, usable, lambda pixels: np.stack(view.pixels(pixels), 1)
    )


@dataclass(frozen=True)
class _TurnedView:
    """A camera at the same place that looks along a normal.

    Attributes:
        camera: of the image that it is turned from.
        R_turned_camera: [3, 3].
        focal_px: of the turned camera.
        corner_px: [2], where its image begins, from the middle.
        size_px: width and height.
    """

    camera: PinholeCamera
    R_turned_camera: Array
    focal_px: float
    corner_px: Array
    size_px: tuple[int, int]

    @staticmethod
    def of(facing: _Facing, pyramid: RgbdPyramid) -> _TurnedView | None:
        """The one that shows the surface as large as it is; None if it is seen too much from the side."""
        coarse = pyramid.levels[min(COARSE_LEVEL, len(pyramid.levels) - 1)].camera
        camera = pyramid.levels[0].camera
        z = -facing.normal
        level = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 0.0, 1.0])
        x = level - _dot(level, z) * z
        x /= np.sqrt(_dot(x, x))
        R = np.stack([x, np.cross(z, x), z])
        rays = coarse.rays()[facing.members]
        turned = np.stack([_dot(rays, axis) for axis in R], axis=-1)
        seen = turned[:, 2] > 0
        uv = turned[seen, :2] / turned[seen, 2:]
        uv = uv[np.sqrt(_dot(uv, uv)) < FARTHEST]
        if len(uv) < 0.5 * len(rays):
            return None
        first, last = np.percentile(uv, [OUTSIDE, 100 - OUTSIDE], axis=0)
        extent = np.maximum(last - first, 1e-6)
        focal_px = min(camera.fx, float(np.sqrt(MOST_PX / (extent[0] * extent[1]))))
        width, height = (int(size) + 1 for size in extent * focal_px)
        return _TurnedView(camera, R, focal_px, first * focal_px, (width, height))

    def pixels(self, points: Array) -> tuple[Array, Array]:
        """Where pixels (u, v) [..., 2] of the turned image are in the other one; (-1, -1): behind it."""
        uv = (points + self.corner_px) / self.focal_px
        R = self.R_turned_camera
        x, y, z = (uv[..., 0] * R[0, k] + uv[..., 1] * R[1, k] + R[2, k] for k in range(3))
        front = z > 1e-6
        z = np.where(front, z, 1.0)
        c = self.camera
        u, v = c.fx * (x / z) + c.cx, c.fy * (y / z) + c.cy
        return np.where(front, u, -1.0), np.where(front, v, -1.0)

    def image(self, gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """What it sees, [height, width]."""
        width, height = self.size_px
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
        u, v = self.pixels(grid)
        return sampled(gray, u, v)


def matched_points(
    first: tuple[Features, Features], second: tuple[Features, Features], ratio: float
) -> tuple[Array, Array]:
    """Points [n, 3] of matched features of two views, each in its own frame; every pair of points once.

    Features are matched kind by kind, since both kinds of one point would stand in the way of the ratio test.

    Args:
        first: features of the first view, as it is and rectified.
        second: the same of the second view.
        ratio: of the ratio test.
    """
    points = [np.zeros((0, 3))], [np.zeros((0, 3))]
    squared = squared_distances(*(np.concatenate([f.descriptors for f in view]) for view in (first, second)))
    for ours, rows in zip(first, np.split(squared, [len(first[0])]), strict=True):
        for theirs, kind in zip(second, np.split(rows, [len(second[0])], axis=1), strict=True):
            pairs = matches_of(kind, ratio)
            points[0].append(ours.points[pairs[:, 0]].astype(np.float64))
            points[1].append(theirs.points[pairs[:, 1]].astype(np.float64))
    a, b = (np.concatenate(parts) for parts in points)
    again = np.tril(_at_one_place(a) & _at_one_place(b), -1).any(axis=1)
    return a[~again], b[~again]


def _at_one_place(points: Array) -> NDArray[np.bool_]:
    """Whether points [n, 3] are one, [n, n]."""
    apart = points[:, None] - points[None]
    limit_m = SAME_POINT * np.maximum(1.0, points[:, 2])
    return np.asarray(np.sqrt(_dot(apart, apart)) < limit_m[:, None])


def _dot(a: Array, b: Array) -> Array:
    """Products of vectors [..., k], term by term: the same on every processor."""
    return np.asarray(sum(a[..., k] * b[..., k] for k in range(a.shape[-1])))
