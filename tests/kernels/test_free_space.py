"""Where points are as a view saw it: the compiled pass computes what numpy defines, which follows the pinhole model."""

import numpy as np
import pytest

from duagc.pipeline.geometry import projection, se3
from duagc.pipeline.kernels import available_isas, free_space_definition
from duagc.pipeline.kernels.free_space import free_space
from duagc.pipeline.kernels.free_space_definition import FREE, HIDDEN, ON_SURFACE, UNKNOWN
from tests.kernels.depth_surfaces import SIZES, camera_of, surfaces

CAMERA = camera_of(40, 30)
MOTIONS = {
    "none": np.zeros(6),
    "usual": np.array([0.03, -0.01, 0.02, 0.01, -0.02, 0.015]),
    "back": np.array([0.0, 0.0, 2.5, 0.0, 0.0, 0.0]),
    "turned away": np.array([0.1, 0.0, 0.0, 0.0, 2.5, 0.0]),
}
GATES = {"gate_m": 0.15, "gate_relative": 0.1, "gate_inverse": 0.0}


def wall(z: float) -> np.ndarray:
    return np.full((CAMERA.height, CAMERA.width), z)


def points_of(depth_m: np.ndarray) -> np.ndarray:
    v, u = np.nonzero(depth_m)
    return projection.back_project(CAMERA, u, v, depth_m[v, u])


@pytest.mark.parametrize("isa", available_isas())
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("gate_inverse", [0.0, 0.02, 1.5])
def test_places_are_those_of_the_definition(gate_inverse: float, size: str, motion: str, isa: str) -> None:
    camera, T = camera_of(*SIZES[size]), se3.exp(MOTIONS[motion])
    nearest = projection.largest_of_3x3(surfaces(camera, holes=0.6).astype(np.float32))
    v, u = np.nonzero(nearest)
    share = np.random.default_rng(3).uniform(0.5, 1.5, len(v))
    points = projection.back_project(camera, u, v, share / nearest[v, u])
    strange = [[0, 0, 0.05], [0, 0, -1], [np.nan, 0, 1], [0, 0, np.nan], [1e300, 0, 1], [0, -np.inf, 1]]
    points = np.concatenate([points, strange])
    gates = GATES | {"gate_inverse": gate_inverse}
    found = free_space(points, T, nearest, camera, **gates, isa=isa)
    with np.errstate(invalid="ignore", over="ignore"):
        wanted = free_space_definition.free_space(points, T, nearest, camera, **gates)
    np.testing.assert_array_equal(found, wanted)
    if size == "wide" and motion == "usual" and gate_inverse < 1:
        assert set(wanted) == {FREE, ON_SURFACE, HIDDEN, UNKNOWN}


@pytest.mark.parametrize("z", [0.25, 0.4, 0.8, 2.0])
def test_what_stands_before_a_surface_is_in_free_space_however_near_it_is(z: float) -> None:
    """A hand at 60 % of the distance, as a wall is seen from 25 cm or from 2 m."""
    nearest = projection.largest_of_3x3(1 / wall(z))
    for share, expected in ((0.6, FREE), (1.0, ON_SURFACE), (1.4, HIDDEN)):
        assert (free_space(points_of(wall(share * z)), np.eye(4), nearest, CAMERA, **GATES) == expected).all()


def test_a_gate_of_the_inverse_depth_grows_with_the_square_of_the_depth() -> None:
    gates = GATES | {"gate_inverse": 0.02}
    for z, nearest_m, farthest_m in ((2.0, 1.8, 2.2), (10.0, 8.34, 12.49), (60.0, 27.27, np.inf)):
        nearest = projection.largest_of_3x3(1 / wall(z))
        for depth, expected in (
            (nearest_m - 0.1, FREE),
            (nearest_m + 0.1, ON_SURFACE),
            (min(farthest_m - 0.1, 900), ON_SURFACE),
        ):
            assert (free_space(points_of(wall(depth)), np.eye(4), nearest, CAMERA, **gates) == expected).all()
        if np.isfinite(farthest_m):
            assert (
                free_space(points_of(wall(farthest_m + 0.1)), np.eye(4), nearest, CAMERA, **gates) == HIDDEN
            ).all()


def test_points_before_a_wall_are_in_free_space_and_those_behind_it_hidden() -> None:
    depth = wall(2.0)
    depth[:, :10] = 0  # not measured: nothing can be said there
    nearest = projection.largest_of_3x3(np.where(depth > 0, 0.5, 0))
    T = se3.exp(np.array([0.3, -0.2, 0.5, 0.1, -0.3, 0.2]))
    points = points_of(wall(2.0))
    unknown = (nearest == 0).ravel()
    assert np.count_nonzero(unknown) == 9 * CAMERA.height
    for factor, where in ((0.5, FREE), (0.95, ON_SURFACE), (1.05, ON_SURFACE), (1.5, HIDDEN)):
        elsewhere = se3.transform(T, factor * points)
        found = free_space(elsewhere, se3.inverse(T), nearest, CAMERA, **GATES)
        np.testing.assert_array_equal(found, np.where(unknown, UNKNOWN, where))


def test_no_points_are_nowhere() -> None:
    assert not len(free_space(np.zeros((0, 3)), np.eye(4), wall(1.0), CAMERA, **GATES))


def test_points_and_images_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"points have shape \(4, 2\), expected \(n, 3\)"):
        free_space(np.zeros((4, 2)), np.eye(4), wall(1.0), CAMERA, **GATES)
    with pytest.raises(ValueError, match=r"nearest has shape \(30, 39\), expected \(30, 40\)"):
        free_space(np.zeros((4, 3)), np.eye(4), wall(1.0)[:, :39], CAMERA, **GATES)
