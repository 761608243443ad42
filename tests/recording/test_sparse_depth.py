"""Depth of single pixels becomes that of surfaces; depth that shows surfaces stays as it is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import open_rgbd
from duagc.pipeline.recording.sparse_depth import MOST_POINTS, between_pixels, is_sparse
from tests.fixtures.box_room import look, render

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 159.5, 119.5)
POSE = look([0.5, 0.2, 0.2], [4.0, 3.0, -0.5])
COLOR, DEPTH = render(CAMERA, POSE)
SHAPE = DEPTH.shape


def lattice(every: int) -> np.ndarray:
    """Every so many pixels of every so many rows, as of an image so many times smaller that nobody filled."""
    kept = np.zeros(SHAPE, bool)
    kept[every // 2 :: every, every // 2 :: every] = True
    return kept


def rows(every: int) -> np.ndarray:
    """As the beams of a LiDAR."""
    kept = np.zeros(SHAPE, bool)
    kept[every // 2 :: every] = True
    return kept


def drawn(share: float) -> np.ndarray:
    return np.random.default_rng(0).random(SHAPE) < share


SPARSE = [lattice(3), lattice(4), rows(3), rows(12), drawn(0.05), drawn(0.2)]


@pytest.mark.parametrize("kept", SPARSE)
def test_depth_of_single_pixels_is_that_of_surfaces(kept: np.ndarray) -> None:
    sparse = np.where(kept, DEPTH, 0).astype(np.float32)
    assert is_sparse(sparse)
    found = between_pixels(sparse, CAMERA)
    known = found > 0
    assert known.mean() > 0.85
    error = np.abs(found - DEPTH)[known] / DEPTH[known]
    assert np.median(error) < 1e-4, "exact on planes"
    assert (error > 0.02).mean() < 0.01
    np.testing.assert_array_equal(found[kept], sparse[kept], "what was measured stays")
    assert not is_sparse(found)


@pytest.mark.parametrize(
    "kept", [np.ones(SHAPE, bool), lattice(2), rows(2), ~drawn(0.3), np.zeros(SHAPE, bool)]
)
def test_depth_that_shows_surfaces_is_not_sparse(kept: np.ndarray) -> None:
    """Neither is that of which single pixels are missing: a registration fills those."""
    assert not is_sparse(np.where(kept, DEPTH, 0).astype(np.float32))


def test_of_very_many_pixels_some_say_where_surfaces_are() -> None:
    large = PinholeCamera(960, 720, 780.0, 780.0, 479.5, 359.5)
    _, depth = render(large, POSE)
    kept = np.zeros(depth.shape, bool)
    kept[1::4, 1::4] = True
    assert np.count_nonzero(kept) > 2 * MOST_POINTS
    found = between_pixels(np.where(kept, depth, 0).astype(np.float32), large)
    known = found > 0
    assert known.mean() > 0.95
    assert np.median(np.abs(found - depth)[known] / depth[known]) < 1e-4
    assert (found[kept] > 0).all()


@pytest.mark.parametrize("narrow", [lambda depth: np.where(lattice(4), depth, 0), lambda depth: depth])
def test_a_log_of_such_depth_is_read_with_surfaces(
    tmp_path: Path, narrow: Callable[[np.ndarray], np.ndarray]
) -> None:
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.0005) as robot:
        for k in range(6):
            color, depth = render(CAMERA, POSE @ se3.exp(np.array([0.02 * k, 0, 0, 0, 0, 0])))
            raw = np.rint(narrow(depth) / 0.0005).astype(np.uint16)
            robot.add_frame(k * 33_000_000, cv2.imencode(".png", color)[1].tobytes(), "png", raw)
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        found = log.frame(0).depth
    known = found > 0
    assert known.mean() > 0.85
    assert np.median(np.abs(found - DEPTH)[known]) < 1e-3
