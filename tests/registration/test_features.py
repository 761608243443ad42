"""Features of the same place are found in bright images and in dark ones."""

import cv2
import numpy as np
import pytest

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.registration import RgbdPyramid
from duagc.pipeline.registration.descriptors import matches
from duagc.pipeline.registration.features import extract, extract_from_pyramid, has_few_depths
from duagc.pipeline.registration.keypoints import brightened

CAMERA = PinholeCamera(160, 120, 150.0, 150.0, 79.5, 59.5)
DEPTH = np.full((120, 160), 2.0, np.float32)


def blobs() -> np.ndarray:
    """A gray image [h, w] of spots of all sizes, 0..255."""
    rng = np.random.default_rng(4)
    v, u = np.mgrid[:120, :160]
    image = np.full((120, 160), 128.0)
    for _ in range(150):
        at_u, at_v, size, height = rng.uniform([0, 0, 2, -70], [160, 120, 6, 70])
        image += height * np.exp(-((u - at_u) ** 2 + (v - at_v) ** 2) / (2 * size**2))
    return np.clip(image, 0, 255)


def test_a_dark_image_has_the_features_of_a_bright_one() -> None:
    noise = np.random.default_rng(1).normal(0, 1.0, (120, 160, 3))
    bright = np.repeat(blobs()[..., None], 3, axis=2)
    seen = [np.clip(np.rint(share * bright + noise), 0, 255).astype(np.uint8) for share in (1, 1 / 8)]
    ours, theirs = (extract(color, DEPTH, CAMERA, 200) for color in seen)
    pairs = matches(ours.descriptors, theirs.descriptors, 0.8)
    same = np.linalg.norm(ours.points[pairs[:, 0]] - theirs.points[pairs[:, 1]], axis=1) < 0.03
    assert np.count_nonzero(same) > 0.25 * len(ours)


def test_only_dark_images_are_brightened() -> None:
    bright, usable = np.rint(blobs()).astype(np.uint8), np.ones((120, 160), bool)
    assert brightened(bright, usable) is bright
    for factor, share in ((2, 0.3), (4, 0.16), (8, 0.08)):
        dark = np.rint(share * blobs()).astype(np.uint8)
        np.testing.assert_array_equal(brightened(dark, usable), np.minimum(dark.astype(int) * factor, 255))
    assert not brightened(np.zeros((12, 16), np.uint8), np.ones((12, 16), bool)).any()


@pytest.mark.parametrize("masked", [False, True])
def test_strong_texture_that_is_not_usable_costs_no_features(masked: bool) -> None:
    """Leaves beyond the range of the depth camera, or the robot itself."""
    top, leaves = np.s_[:40], np.random.default_rng(2).uniform(0, 255, (40, 160))
    color = np.repeat(np.rint(0.9 * blobs())[..., None], 3, axis=2).astype(np.uint8)
    with_leaves, depth, mask = color.copy(), DEPTH.copy(), np.ones(DEPTH.shape, bool)
    with_leaves[top] = np.rint(cv2.GaussianBlur(leaves, (0, 0), 1.0))[..., None]
    if masked:
        mask[top] = False
    else:
        depth[top] = 0
    usual, found = (len(extract(image, depth, CAMERA, 20, mask=mask)) for image in (color, with_leaves))
    assert found == usual == 20


def test_a_bright_window_leaves_a_dark_room_its_features() -> None:
    color = np.repeat(np.rint(0.1 * blobs())[..., None], 3, axis=2).astype(np.uint8)
    depth = DEPTH.copy()
    color[:20], depth[:20] = 235, 0
    mask = depth > 0
    assert len(extract(color, depth, CAMERA, 100)) > 20
    assert len(extract(color, DEPTH, CAMERA, 100, mask=mask)) > 20


@pytest.mark.parametrize(
    ("width", "height", "level"),
    [
        (640, 480, 1),
        (848, 480, 1),
        (424, 240, 0),
        (1280, 720, 2),
        (752, 480, 1),
        (480, 640, 1),
        (240, 180, 0),
        (160, 120, 0),
        (960, 540, 1),
        (1920, 1080, 2),
        (1226, 370, 1),
        (480, 360, 0),
    ],
)
def test_features_come_from_an_image_that_shows_enough(width: int, height: int, level: int) -> None:
    gray = cv2.resize(blobs().astype(np.float32) / 255, (width, height), interpolation=cv2.INTER_CUBIC)
    camera = PinholeCamera(width, height, width, width, width / 2 - 0.5, height / 2 - 0.5)
    pyramid = RgbdPyramid.build(np.clip(gray, 0, 1), np.full((height, width), 2.0, np.float32), camera, 4)
    found = extract_from_pyramid(pyramid, 400, 100)
    alone = RgbdPyramid(pyramid.levels[level : level + 1])
    np.testing.assert_array_equal(found.points, extract_from_pyramid(alone, 1000, 100).points)
    assert len(found) > 20


@pytest.mark.parametrize(("rows", "few"), [(40, True), (80, False)])
def test_features_without_depth_are_kept_beside_those_with_depth(rows: int, few: bool) -> None:
    color = np.repeat(np.rint(blobs())[..., None], 3, axis=2).astype(np.uint8)
    depth, mask = DEPTH.copy(), np.ones(DEPTH.shape, bool)
    depth[rows:], mask[:, :20] = 0, False
    pyramid = RgbdPyramid.build(color, depth, CAMERA, 3, mask=mask)
    assert has_few_depths(pyramid) == few
    found = extract_from_pyramid(pyramid, 400, 100)
    assert found.bearings.few_depths == few
    assert found.bearings.pixel_width == pytest.approx(1 / CAMERA.fx)
    assert len(found) > 10
    assert len(found.bearings.rays) > 10
    points = found.points / found.points[:, 2:]
    for rays, inside in ((points, np.s_[:rows]), (found.bearings.rays, np.s_[rows:])):
        u, v = CAMERA.project(rays.astype(np.float64)).T
        seen = np.zeros(DEPTH.shape, bool)
        seen[inside] = True
        assert seen[np.rint(v).astype(int), np.rint(u).astype(int)].all()
        assert (u > 20).all()


def test_an_image_without_any_depth_is_followed_otherwise() -> None:
    color = np.repeat(np.rint(blobs())[..., None], 3, axis=2).astype(np.uint8)
    assert not has_few_depths(RgbdPyramid.build(color, np.zeros_like(DEPTH), CAMERA, 3))
