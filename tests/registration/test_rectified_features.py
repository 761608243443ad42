"""Rectified features: a wall seen from the left matches the same wall seen from the right."""

import numpy as np
import pytest

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.registration import RgbdPyramid
from duagc.pipeline.registration.features import Features, extract, gray_of
from duagc.pipeline.registration.rectified_features import extract_rectified, matched_points
from tests.exchange.conftest import CAMERA, HALF_M, view

MOST, PLANES = 400, 3


def looking(from_m: tuple[float, float, float], turn_rad: float) -> Array:
    """T_world_camera of a camera that looks along z, turned about the vertical."""
    return se3.from_rotation_translation(so3.exp([0.0, turn_rad, 0.0]), list(from_m))


LEFT, RIGHT = looking((-1.5, 0.1, 1.4), 0.95), looking((1.5, -0.1, 1.4), -0.95)
"""Both see the wall z = 2.4 m, 54 degrees from the side."""


def both_kinds(T_world_camera: Array, usable: np.ndarray | None = None) -> tuple[Features, Features]:
    color, depth_m = view(T_world_camera)
    pyramid = RgbdPyramid.build(color, depth_m, CAMERA, mask=usable)
    plain = extract(color, depth_m, CAMERA, MOST, mask=usable)
    return plain, extract_rectified(gray_of(color), pyramid, MOST, PLANES)


def true_matches(first: tuple[Features, Features], second: tuple[Features, Features]) -> tuple[int, int]:
    """Matches between the views from the left and from the right, and how many of them are 3 cm apart at most."""
    ours, theirs = matched_points(first, second, 0.8)
    moved = se3.transform(se3.inverse(LEFT) @ RIGHT, theirs)
    return len(ours), int((np.linalg.norm(ours - moved, axis=1) < 0.03).sum())


def test_a_wall_seen_from_both_sides_has_features_in_common() -> None:
    (plain_left, left), (plain_right, right) = both_kinds(LEFT), both_kinds(RIGHT)
    none = Features(np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.float32))
    _, plain = true_matches((plain_left, none), (plain_right, none))
    found, true = true_matches((plain_left, left), (plain_right, right))
    assert plain < 12  # what a loop closure needs
    assert true > 40
    assert true > 0.6 * found


def test_points_lie_where_the_surface_is() -> None:
    _, left = both_kinds(LEFT)
    walls = np.abs(se3.transform(LEFT, left.points.astype(float))) / HALF_M
    assert len(left) > 100
    assert np.abs(walls.max(axis=1) - 1).max() < 5e-3  # depth is that of the nearest pixel


def test_a_pair_of_points_counts_once() -> None:
    left = both_kinds(LEFT)
    apart = [
        np.linalg.norm(points[:, None] - points[None], axis=-1) + np.eye(len(points))
        for points in matched_points(left, left, 0.8)
    ]
    assert np.maximum(*apart).min() >= 0.02


def test_what_the_camera_faces_is_left_as_it_is() -> None:
    assert len(both_kinds(looking((0.0, 0.0, 1.2), 0.0))[1]) == 0


@pytest.mark.parametrize("planes", [0, PLANES])
def test_without_depth_or_planes_there_are_none(planes: int) -> None:
    color, depth_m = view(LEFT)
    known = depth_m if planes == 0 else 0 * depth_m
    pyramid = RgbdPyramid.build(color, known, CAMERA)
    assert len(extract_rectified(gray_of(color), pyramid, MOST, planes)) == 0


def test_pixels_that_may_not_be_used_have_none() -> None:
    usable = np.ones((CAMERA.height, CAMERA.width), dtype=bool)
    usable[:, :120] = False
    _, features = both_kinds(LEFT, usable)
    assert len(features) > 20
    assert CAMERA.project(features.points.astype(float))[:, 0].min() >= 120
