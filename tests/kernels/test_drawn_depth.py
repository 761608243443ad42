"""Depth drawn from another place: the compiled passes compute what numpy defines, on every instruction set."""

import numpy as np
import pytest
from scipy.spatial import Delaunay

from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import available_isas, drawn_depth, drawn_depth_definition
from tests.kernels.depth_surfaces import SIZES, camera_of, surfaces

ISAS = available_isas()
MOTIONS = {
    "none": np.zeros(6),
    "usual": np.array([0.03, -0.01, 0.02, 0.01, -0.02, 0.015]),
    "ahead": np.array([0.0, 0.0, -1.2, 0.0, 0.0, 0.0]),
    "turned away": np.array([0.1, 0.0, 0.0, 0.0, 2.5, 0.0]),
    "far off": np.array([1e9, 0.0, 0.0, 0.0, 0.3, 0.0]),
}


def points_of(camera: PinholeCamera, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners in and around an image, inverse depths, and triangles of neighbors and of any points."""
    rng = np.random.default_rng(count)
    size = np.array([camera.width, camera.height])
    corners = rng.uniform(-0.3 * size - 2, 1.3 * size + 2, (count, 2))
    corners[: count // 3] = np.rint(corners[: count // 3])  # sides that pass through pixels
    mixed = rng.integers(0, count, (count // 4, 3))  # of equal corners and of hidden ones as well
    triangles = np.concatenate([Delaunay(corners).simplices, mixed, mixed[:, [0, 2, 1]]]).astype(np.int64)
    return corners, rng.uniform(0.2, 3.0, count), triangles


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("count", [4, 60, 700])
def test_triangles_are_those_of_the_definition(size: str, count: int, isa: str) -> None:
    camera = camera_of(*SIZES[size])
    corners, inverse, triangles = points_of(camera, count)
    found = drawn_depth.drawn_triangles(corners, inverse, triangles, camera, isa=isa)
    wanted = drawn_depth_definition.drawn_triangles(corners, inverse, triangles, camera)
    for ours, theirs in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(ours.view(np.int64), theirs.view(np.int64))
    assert count < 60 or (found[0] > 0).any()


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("steps", [1, 2, 3])
def test_registered_depth_is_that_of_the_definition(size: str, motion: str, steps: int, isa: str) -> None:
    depth_camera, camera = camera_of(*SIZES[size]), camera_of(50, 31)
    inverse, T = surfaces(depth_camera), se3.exp(MOTIONS[motion])
    found = drawn_depth.registered_depth(inverse, depth_camera, T, camera, steps=steps, isa=isa)
    wanted = drawn_depth_definition.registered_depth(inverse, depth_camera, T, camera, steps=steps)
    np.testing.assert_array_equal(found.view(np.int32), wanted.view(np.int32))
    assert size in ("one pixel", "one row", "one column") or motion != "usual" or (found > 0).mean() > 0.2


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("baseline_m", [0.0, 0.03, -0.4])
@pytest.mark.parametrize("size", [name for name, (_, height) in SIZES.items() if height > 1])
def test_displaced_depth_is_that_of_the_definition(size: str, baseline_m: float, isa: str) -> None:
    depth_camera = camera_of(*SIZES[size])
    inverse = surfaces(depth_camera)
    depth = np.where(inverse > 0, 1 / np.where(inverse > 0, inverse, 1), 0)
    for camera in (camera_of(50, 31), depth_camera):
        found = drawn_depth.displaced_depth(depth, depth_camera, camera, baseline_m, isa=isa)
        wanted = drawn_depth_definition.displaced_depth(depth, depth_camera, camera, baseline_m)
        np.testing.assert_array_equal(found.view(np.int64), wanted.view(np.int64))
    assert size == "one column" or baseline_m < 0 or (found > 0).mean() > 0.2


def test_what_is_no_triangle_or_no_image_is_refused() -> None:
    camera = camera_of(40, 30)
    corners, inverse = np.zeros((3, 2)), np.ones(3)
    for triangle in ([[0, 1, 3]], [[0, 1, -1]]):
        with pytest.raises(ValueError, match="none of 3"):
            drawn_depth.drawn_triangles(corners, inverse, np.array(triangle), camera)
    with pytest.raises(ValueError, match=r"expected \[m, 2\], \[m\], \[t, 3\]"):
        drawn_depth.drawn_triangles(corners, inverse[:2], np.array([[0, 1, 1]]), camera)
    for corner, depth in ((np.nan, 1.0), (0.0, 0.0)):
        with pytest.raises(ValueError, match="that no point before a camera has"):
            drawn_depth.drawn_triangles(corners + corner, inverse * depth, np.array([[0, 1, 2]]), camera)
    with pytest.raises(ValueError, match="expected that of PinholeCamera"):
        drawn_depth.registered_depth(np.ones((30, 39)), camera, np.eye(4), camera, steps=1)
    with pytest.raises(ValueError, match=r"expected that of PinholeCamera.*, two rows or more"):
        drawn_depth.displaced_depth(np.ones((30, 39)), camera, camera, 0.1)
