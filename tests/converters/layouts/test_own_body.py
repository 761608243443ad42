"""What moves with the camera is found by its depth, and is no floor that it moves along."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from duagc.converters.layouts.found_regions import FoundRegions
from duagc.converters.layouts.own_body import LEAST_IMAGES, MOST_IMAGES, OwnBody, percentiles
from duagc.converters.writer import RecordingWriter
from duagc.pipeline.geometry.camera import PinholeCamera
from tests.converters.layouts.test_validity import valid_of

HEIGHT, WIDTH = 60, 80
BODY = np.zeros((HEIGHT, WIDTH), bool)
BODY[48:, 10:70] = True
BODY[52:56, 30:40] = False  # a hole in its depth


def scene(k: int) -> NDArray[np.float64]:
    """Millimeters of a room that a camera turns in."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return 2000 + 600 * np.sin(0.05 * u + 0.4 * k) + 300 * np.cos(0.07 * v + 0.3 * k)


def floor(k: int) -> NDArray[np.float64]:
    """The same above a floor 0.8 m below a camera that moves along it."""
    v = np.arange(HEIGHT)[:, None]
    along = 800 * 60 / np.maximum(v - 30, 1)
    return np.minimum(scene(k), along)


def hall(k: int) -> NDArray[np.float64]:
    """What a camera sees that drives 0.3 m above the floor of a hall: the floor's depth grows toward its horizon."""
    v = np.arange(HEIGHT)[:, None]
    return np.minimum(5 * scene(k), 300 * 60 / np.maximum(v - 32, 1))


def found(images: list[NDArray[np.float64]], seed: int = 0) -> NDArray[np.bool_] | None:
    body, rng = OwnBody(), np.random.default_rng(seed)
    for image in images:
        noise = 1 + 0.004 * rng.standard_normal(image.shape)
        body.add(np.where(rng.random(image.shape) < 0.02, 0, image * noise).astype(np.uint16))
    return body.result()


def with_body(image: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(BODY, 400, np.where(np.roll(BODY, -3, axis=0), 0, image))  # a shadow around it


def test_the_body_is_found_and_little_else() -> None:
    shows = found([with_body(scene(k)) for k in range(20)])
    assert shows is not None
    assert not shows[BODY].any()
    assert not shows[52:56, 30:40].any()
    assert np.count_nonzero(~shows) < 1.5 * np.count_nonzero(BODY)


def test_a_body_that_slopes_away_is_found() -> None:
    sloping = np.where(BODY, 300 + 10 * (HEIGHT - np.arange(HEIGHT)[:, None]), 0)
    shows = found([np.where(BODY, sloping, scene(k)) for k in range(20)])
    assert shows is not None
    assert not shows[BODY].any()


def test_of_a_long_log_some_images_are_kept() -> None:
    body = OwnBody()
    for k in range(5 * MOST_IMAGES):
        body.add(with_body(scene(k)).astype(np.uint16))
    assert len(body._images) < MOST_IMAGES
    assert all(
        np.array_equal(a, with_body(scene(8 * k)).astype(np.uint16)) for k, a in enumerate(body._images)
    )
    assert body.result() is not None


def test_it_is_found_next_to_the_rim_of_an_undistorted_image() -> None:
    rim = np.ones((HEIGHT, WIDTH), bool)
    rim[2:-2, 3:-3] = False
    shows = found([np.where(rim, 0, with_body(scene(k))) for k in range(20)])
    assert shows is not None
    assert not shows[BODY & ~rim].any()
    assert np.count_nonzero(~shows) < 1.5 * np.count_nonzero(BODY)


@pytest.mark.parametrize(
    "images",
    [
        [scene(k) for k in range(20)],
        [floor(k) for k in range(20)],
        [hall(k) for k in range(20)],
        [with_body(scene(3)) for _ in range(20)],  # a camera that stands still
        [with_body(scene(k)) for k in range(LEAST_IMAGES - 1)],
        [np.where(np.roll(BODY, -20, axis=0), 400, scene(k)) for k in range(20)],  # not at the border
        [np.where(BODY, 400 + 20 * (k % 5), scene(k)) for k in range(20)],  # an arm that moves
        [np.zeros((HEIGHT, WIDTH)) for _ in range(20)],
        [],
    ],
    ids=["room", "floor", "hall", "still", "few", "inside", "arm", "no depth", "no image"],
)
def test_nothing_else_is_taken_for_it(images: list[NDArray[np.float64]]) -> None:
    assert found(images) is None


def test_a_recording_leaves_it_out_and_says_so(tmp_path: Path) -> None:
    camera = PinholeCamera(WIDTH, HEIGHT, 70.0, 70.0, 39.5, 29.5)
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", camera, 0.001) as robot:
        png = cv2.imencode(".png", np.full((HEIGHT, WIDTH, 3), 90, np.uint8))[1].tobytes()
        for k in range(80):
            robot.add_frame(k * 10**7, png, "png", with_body(scene(k)).astype(np.uint16))
    description = json.loads((tmp_path / "rec" / "recording.json").read_text())
    valid = valid_of(tmp_path / "rec", "alpha")
    assert valid is not None
    assert not valid[BODY].any()
    assert description["robots"]["alpha"]["body_share"] == pytest.approx(float(np.mean(~valid)))
    assert "keep their depth while the camera moves" in description["warnings"][0]


@pytest.mark.filterwarnings("ignore:All-NaN slice")
def test_percentiles_are_those_of_every_pixel_alone() -> None:
    rng = np.random.default_rng(0)
    depth = rng.integers(1, 9000, (31, 12, 16)).astype(np.float32)
    depth[rng.random(depth.shape) < rng.random((12, 16))] = np.nan
    depth[:, 0, :3] = np.nan
    depth[1:, 1, 0] = np.nan
    expected = np.nanpercentile(depth, [10, 50, 90], axis=0).astype(depth.dtype)  # NumPy 2.5 computes float64
    np.testing.assert_array_equal(percentiles(depth), expected, strict=True)


CABIN = np.zeros((HEIGHT, WIDTH), bool)
CABIN[:6] = CABIN[36:] = CABIN[:, :16] = CABIN[:, 66:] = True


def driven(k: int) -> NDArray[np.float64]:
    """What a vehicle sees beyond its cabin: a road, whose depth stays, and above it the scene."""
    v = np.arange(HEIGHT)[:, None]
    return np.where(v > 28, 1500 * 60 / np.maximum(v - 20, 1), 5 * scene(k))


def shown_by(
    images: list[NDArray[np.float64]], colors: list[NDArray[np.uint8]]
) -> dict[str, NDArray[np.bool_]]:
    regions, rng = FoundRegions(), np.random.default_rng(0)
    for k, (image, color) in enumerate(zip(images, colors, strict=True)):
        depth = (image * (1 + 0.004 * rng.standard_normal(image.shape))).astype(np.uint16)
        regions.add(3 * k + 1, 10**9 * k, cv2.imencode(".png", color)[1].tobytes(), depth)
    return regions.result(None)


def test_a_cabin_that_fills_most_of_the_view_is_found_in_front_of_a_road() -> None:
    rng = np.random.default_rng(1)
    still = rng.integers(30, 220, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    coarse = [rng.integers(30, 220, (6, 8, 3), dtype=np.uint8) for _ in range(24)]
    passing = [cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR) for image in coarse]
    images = [np.where(CABIN, 600.0, driven(k)) for k in range(24)]
    assert CABIN.mean() > 0.6
    shows = shown_by(images, [np.where(CABIN[..., None], still, image) for image in passing])["body"]
    assert not shows[CABIN].any()
    assert np.count_nonzero(~shows) < 1.25 * np.count_nonzero(CABIN)
    # a wall that a robot drives along keeps its depth, too, but its color passes
    assert "body" not in shown_by(images, passing)
    # and a camera that stands still sees nothing else change
    assert "body" not in shown_by(images[:1] * 24, passing[:1] * 24)
