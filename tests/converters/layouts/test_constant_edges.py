"""Text over the images is found, and no edge of the scene, where the camera stands still or drives straight."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from duagc.converters.layouts.found_regions import FoundRegions
from duagc.pipeline.geometry.masks import Mask

HEIGHT, WIDTH, IMAGES = 120, 160, 16
Image = NDArray[np.uint8]
WALL = np.random.default_rng(0).integers(0, 255, (30, 60, 3)).astype(np.uint8)


def wall(k: int) -> Image:
    """A wall of tiles that a camera pans along."""
    tiles = cv2.resize(WALL, (480, 240), interpolation=cv2.INTER_NEAREST)
    return np.ascontiguousarray(tiles[5 * k % 90 :, 17 * k % 300 :][:HEIGHT, :WIDTH])


def depth(k: int) -> NDArray[np.uint16]:
    """Millimeters of a room that a camera turns in."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return (2000 + 600 * np.sin(0.05 * u + 0.4 * k) + 300 * np.cos(0.07 * v + 0.3 * k)).astype(np.uint16)


def with_text(image: Image, k: int) -> Image:
    out = image.copy()
    for tone, thickness in ((0, 3), (255, 1)):
        cv2.putText(out, f"CAM 1 {k:02d}", (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (tone,) * 3, thickness)
    return out


def drawn(images: list[Image], depths: list[NDArray[np.uint16]], valid: Mask | None = None) -> Mask | None:
    """Pixels that are found to be drawn; None: nothing is found."""
    regions = FoundRegions()
    for k, (image, of_image) in enumerate(zip(images, depths, strict=True)):
        regions.add(8 * k, k * 10**9, cv2.imencode(".jpg", image)[1].tobytes(), of_image)
    shown = regions.result(valid).get("drawn")
    return None if shown is None else ~shown


def test_text_is_found_and_little_else() -> None:
    depths = [depth(k) for k in range(IMAGES)]
    found = drawn([with_text(wall(k), k) for k in range(IMAGES)], depths)
    assert found is not None
    text = np.any(with_text(np.full((HEIGHT, WIDTH, 3), 128, np.uint8), 0) != 128, axis=2)
    steady = text.copy()
    steady[:, 65:] = False  # before the number, which changes
    assert not (steady & ~found).any()
    rows, columns = np.nonzero(found)
    assert rows.max() < 32
    assert columns.max() < 120
    assert drawn([wall(k) for k in range(IMAGES)], depths) is None


def test_dirt_on_a_lens_is_found() -> None:
    images = [wall(k) for k in range(IMAGES)]
    for image in images:
        cv2.circle(image, (80, 60), 6, (10, 10, 10), -1)
    found = drawn(images, [depth(k) for k in range(IMAGES)])
    assert found is not None
    assert found[54:67, 74:87].all()
    assert np.count_nonzero(found) < 900


def test_a_camera_that_stands_still_has_no_text() -> None:
    rng = np.random.default_rng(0)
    images = [
        np.clip(wall(0) + rng.normal(0, 4, (HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8)
        for _ in range(IMAGES)
    ]
    assert drawn(images, [depth(0)] * IMAGES) is None
    walkers = [depth(k) for k in range(IMAGES)]  # in another part of the image
    assert drawn(images, walkers) is None


def test_edges_of_a_corridor_that_a_robot_drives_along_are_no_text() -> None:
    """They stay where they are, and so does their depth; the rest of the images changes."""
    images, depths = [wall(k) for k in range(IMAGES)], [depth(k) for k in range(IMAGES)]
    for image, of_image in zip(images, depths, strict=True):
        cv2.line(image, (0, 118), (80, 70), (255, 255, 255), 3)
        of_image[60:, :90] = 3000
    assert drawn(images, depths) is None


def test_the_outline_of_a_mask_is_no_text() -> None:
    """What lies around it is black, and stays."""
    valid = np.zeros((HEIGHT, WIDTH), bool)
    cv2.circle(mask := valid.astype(np.uint8), (80, 60), 58, 1, -1)
    valid = mask.astype(bool)
    images = [np.where(valid[..., None], wall(k), 0).astype(np.uint8) for k in range(IMAGES)]
    depths = [np.where(valid, depth(k), 0).astype(np.uint16) for k in range(IMAGES)]
    assert drawn(images, depths, valid) is None
    assert drawn(images, depths) is None  # found to be black
