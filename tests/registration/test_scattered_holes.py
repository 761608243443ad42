"""Holes of single pixels are filled between what surrounds them, exactly on planes; nothing else changes."""

from __future__ import annotations

import numpy as np
import pytest

from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.scattered_holes import without_scattered_holes
from duagc.pipeline.registration import Reference, RgbdPyramid, register
from tests.fixtures.room import CAMERA, pose, render

SIZE = 96, 128
START, END = pose(yaw=0.3), pose(x=0.06, y=-0.03, z=-0.75, yaw=0.34, pitch=-0.02)
STRIDES = (2, 1, 1)


def plane(nearer: float = 0.0) -> np.ndarray:
    """Inverse depth of a slanted plane, 1/m."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    return (0.4 + nearer + 1e-3 * u - 5e-4 * v).astype(np.float32)


def scattered(share: float, seed: int = 0) -> np.ndarray:
    """Which pixels are missing."""
    return np.random.default_rng(seed).random(SIZE) < share


def grid() -> np.ndarray:
    """All but every second pixel of every second row, as depth of half the size that nobody filled."""
    missing = np.ones(SIZE, dtype=bool)
    missing[::2, ::2] = False
    return missing


@pytest.mark.parametrize(
    ("missing", "left"),
    [(scattered(0.1), 0.002), (scattered(0.3), 0.005), (scattered(0.6), 0.05), (grid(), 0.0)],
)
def test_planes_are_filled_exactly(missing: np.ndarray, left: float) -> None:
    holes = np.where(missing, np.float32(0), plane())
    filled = without_scattered_holes(holes, None)
    known = filled > 0
    np.testing.assert_allclose(filled[known], plane()[known], rtol=2e-6)
    np.testing.assert_array_equal(filled[~missing], holes[~missing])
    assert (~known[1:-1, 1:-1]).mean() <= left


def test_large_holes_and_dense_depth_stay_as_they_are() -> None:
    dense, large = plane(), plane()
    large[20:70, 30:90] = 0
    large[::20, ::20] = 0  # a few pixels more
    for image in (dense, large, np.zeros(SIZE, np.float32)):
        assert without_scattered_holes(image, None) is image


def test_large_holes_among_scattered_ones_are_not_closed() -> None:
    holes = np.where(scattered(0.3), np.float32(0), plane())
    holes[20:70, 30:90] = 0
    filled = without_scattered_holes(holes, None)
    assert not filled[24:66, 34:86].any()


def test_surfaces_are_not_bridged() -> None:
    """Behind an edge from 2.5 to 1.25 m nothing lies between."""
    image = np.where(np.arange(SIZE[1]) < 64, plane(), plane(nearer=0.4))
    image = np.where(scattered(0.3), np.float32(0), image).astype(np.float32)
    filled = without_scattered_holes(image, None)
    error = np.minimum(np.abs(filled - plane()), np.abs(filled - plane(nearer=0.4)))
    assert error[filled > 0].max() < 1e-5


def test_masked_pixels_stay_unknown() -> None:
    mask = np.ones(SIZE, dtype=bool)
    mask[:, ::9] = False
    holes = np.where(scattered(0.3) | ~mask, np.float32(0), plane())
    assert not without_scattered_holes(holes, mask)[~mask].any()


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_frames_with_scattered_holes_are_registered(share: float) -> None:
    pyramids = []
    for seed, T in enumerate((START, END)):
        image, depth = render(T)
        depth = np.where(np.random.default_rng(seed).random(depth.shape) < share, 0, depth)
        pyramids.append(RgbdPyramid.build(image, depth.astype(np.float32), CAMERA))
    result = register(Reference.from_pyramid(pyramids[0], STRIDES), pyramids[1], np.eye(4))
    assert result.ok
    moved_m, turned_rad = se3.distance(se3.inverse(START) @ END, result.T_reference_target)
    assert moved_m < 1e-3
    assert turned_rad < 6e-4
    assert result.overlap > 0.8
