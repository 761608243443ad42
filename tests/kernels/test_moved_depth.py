"""The compiled search for points of a depth image computes what numpy defines, on every instruction set."""

import numpy as np
import pytest

from duagc.pipeline.geometry import se3
from duagc.pipeline.kernels import available_isas, moved_depth, moved_depth_definition
from tests.kernels.depth_surfaces import SIZES, camera_of, surfaces

ISAS = available_isas()
MOTIONS = {
    "none": np.zeros(6),
    "usual": np.array([0.03, -0.01, 0.02, 0.01, -0.02, 0.015]),
    "ahead": np.array([0.0, 0.0, 1.2, 0.0, 0.0, 0.0]),
    "turned away": np.array([0.1, 0.0, 0.0, 0.0, 2.5, 0.0]),
    "farther than integers": np.array([1e9, 0.0, 0.0, 0.0, 0.3, 0.0]),
}


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("size", SIZES)
def test_points_are_those_of_the_definition(size: str, motion: str, isa: str) -> None:
    camera, T = camera_of(*SIZES[size]), se3.exp(MOTIONS[motion])
    inverse = surfaces(camera).astype(np.float32)
    nearest = np.where(np.random.default_rng(1).random(inverse.shape) < 0.3, 0, inverse.max()).astype(
        np.float32
    )
    found = moved_depth.found_points(inverse, nearest, camera, T, middle=0.5, isa=isa)
    wanted = moved_depth_definition.found_points(inverse, nearest, camera, T, middle=0.5)
    for ours, theirs in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(ours.view(np.int32), theirs.view(np.int32))


def test_what_does_not_move_is_found_where_it_is() -> None:
    camera = camera_of(64, 48)
    inverse = surfaces(camera).astype(np.float32)
    found, u, v = moved_depth.found_points(inverse, inverse, camera, np.eye(4), middle=0.5)
    known = inverse > 0
    assert (found[known] > 0).mean() > 0.99
    np.testing.assert_allclose(found[known & (found > 0)], inverse[known & (found > 0)], rtol=1e-4)
    rows, columns = np.nonzero(known & (found > 0))
    np.testing.assert_allclose(u[rows, columns], columns, atol=1e-3)
    np.testing.assert_allclose(v[rows, columns], rows, atol=1e-3)


def test_an_image_without_depth_has_no_points() -> None:
    camera = camera_of(40, 30)
    nothing = np.zeros((30, 40), np.float32)
    assert not moved_depth.found_points(nothing, nothing, camera, se3.exp(MOTIONS["usual"]), middle=1.0)[
        0
    ].any()


def test_images_of_another_size_and_no_start_are_refused() -> None:
    camera = camera_of(40, 30)
    image = np.ones((30, 40), np.float32)
    with pytest.raises(ValueError, match=r"nearest is float32 \(30, 39\), expected float32 \(30, 40\)"):
        moved_depth.found_points(image, image[:, :39], camera, np.eye(4), middle=1.0)
    with pytest.raises(ValueError, match=r"inverse_depth is float64 \(30, 40\)"):
        moved_depth.found_points(image.astype(float), image, camera, np.eye(4), middle=1.0)
    for middle in (0.0, float("nan")):
        with pytest.raises(ValueError, match="expected more than 0"):
            moved_depth.found_points(image, image, camera, np.eye(4), middle=middle)
