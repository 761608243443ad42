"""Projection, visibility and overlap follow the pinhole model."""

import numpy as np
import pytest

from duagc.pipeline.geometry import projection, se3
from duagc.pipeline.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(40, 30, 35.0, 33.0, 19.2, 14.7)


def wall(z: float) -> np.ndarray:
    return np.full((CAMERA.height, CAMERA.width), z, dtype=np.float32)


def points_of(depth_m: np.ndarray) -> np.ndarray:
    v, u = np.nonzero(depth_m)
    return projection.back_project(CAMERA, u, v, depth_m[v, u].astype(np.float64))


def test_projection_undoes_back_projection() -> None:
    rng = np.random.default_rng(0)
    u, v, z = rng.uniform(0, 39, 100), rng.uniform(0, 29, 100), rng.uniform(0.1, 9, 100)
    points = projection.back_project(CAMERA, u, v, z)
    np.testing.assert_allclose(CAMERA.project(points), np.stack([u, v], axis=1), atol=1e-12)
    np.testing.assert_array_equal(points[:, 2], z)


def test_visible_points_are_before_the_camera_and_inside_the_image() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform((-3, -3, -3), 3, (500, 3))
    index, u, v = projection.visible(CAMERA, points)
    assert 0 < len(index) < len(points)
    pixels = CAMERA.project(points[index])
    np.testing.assert_array_equal(np.rint(pixels), np.stack([u, v], axis=1))
    others = np.setdiff1d(np.arange(len(points)), index)
    front = others[points[others, 2] > projection.NEAR_M]
    far_u, far_v = np.rint(CAMERA.project(points[front])).T
    assert not projection.inside(far_u, far_v, (CAMERA.height, CAMERA.width)).any()
    within, u, v = projection.visible(CAMERA, points, margin_px=3)
    assert set(within) < set(index)
    assert u.min() >= 3
    assert u.max() < 37
    assert v.min() >= 3
    assert v.max() < 27


def test_nothing_is_visible_of_no_points() -> None:
    assert all(len(part) == 0 for part in projection.visible(CAMERA, np.zeros((0, 3))))
    assert projection.overlap(np.zeros((0, 3)), CAMERA, depth_m=wall(1)) == 0.0


def test_overlap_counts_what_is_inside_and_on_the_surface() -> None:
    points = points_of(wall(2.0))
    for measured, expected in ((2.0, 1.0), (2.15, 1.0), (2.3, 0.0), (1.7, 0.0), (0.0, 0.0)):
        inverse = np.where(wall(measured) > 0, 1 / np.maximum(wall(measured), 1e-6), 0)
        assert projection.overlap(points, CAMERA, depth_m=wall(measured)) == expected
        assert projection.overlap(points, CAMERA, inverse_depth=inverse) == expected
    shift = se3.transform(
        se3.from_rotation_translation(np.eye(3), [CAMERA.width / 2 / CAMERA.fx * 2.0, 0, 0]), points
    )
    assert projection.overlap(shift, CAMERA, depth_m=wall(2.0)) == pytest.approx(0.5, abs=0.03)
    with pytest.raises(TypeError):
        projection.overlap(points, CAMERA)


def test_of_the_image_of_a_nearer_camera_all_is_covered() -> None:
    """Of a wall at 4 m a camera that stands at 1 m sees a sixteenth, and nothing else."""
    points = points_of(wall(4.0)) - [0, 0, 3.0]
    normals, near = np.tile([0.0, 0.0, -1.0], (len(points), 1)), 1 / wall(1.0)
    assert projection.overlap(points, CAMERA, inverse_depth=near) == pytest.approx(1 / 16, rel=0.15)
    assert projection.covered(points, CAMERA, near, normals) == 1.0
    half = near.copy()
    half[:, CAMERA.width * 3 // 5 :] = 1 / 1.5
    assert projection.covered(points, CAMERA, half, normals) == pytest.approx(0.6)
    assert projection.covered(points, CAMERA, near, -normals) == 0.0
    assert projection.covered(points, CAMERA, np.zeros_like(near), normals) == 0.0


def test_the_largest_of_3x3_is_that_of_the_neighborhood() -> None:
    image = np.random.default_rng(2).uniform(0, 1, (7, 9))
    found = projection.largest_of_3x3(image)
    for row in range(7):
        for column in range(9):
            block = image[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
            assert found[row, column] == block.max()


def test_a_surface_is_seen_from_behind_where_its_normal_points_along_the_ray() -> None:
    points = points_of(wall(2.0))
    facing = np.broadcast_to([0.0, 0.0, -1.0], points.shape)
    assert not projection.from_behind(points, facing).any()
    assert projection.from_behind(points, -facing).all()
    # a floor 1 m below, 30 m away, whose normal is off by 3 degrees: still seen from above; by 15 degrees not
    floor = np.array([0.0, 1.0, 30.0])
    for degrees, behind in ((0, False), (3, False), (15, True)):
        turn = np.radians(degrees)
        assert projection.from_behind(floor, np.array([0.0, -np.cos(turn), np.sin(turn)])) == behind
