"""Features of the same place are found in bright images and in dark ones."""

import numpy as np

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.registration.features import brightened, extract, matches

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
    bright = np.rint(blobs()).astype(np.uint8)
    assert brightened(bright) is bright
    for factor, share in ((2, 0.3), (4, 0.16), (8, 0.08)):
        dark = np.rint(share * blobs()).astype(np.uint8)
        np.testing.assert_array_equal(brightened(dark), np.minimum(dark.astype(int) * factor, 255))
    assert not brightened(np.zeros((12, 16), np.uint8)).any()
