"""Views that registration laid onto each other must look alike where both have texture."""

import cv2
import numpy as np
import pytest

from duagc.pipeline.base import random_streams
from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.config.registration import GeometricVerificationConfig, RegistrationConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.registration import Reference, RgbdPyramid
from duagc.pipeline.registration.features import extract
from duagc.pipeline.registration.geometric_verification import VerificationView, verify
from duagc.pipeline.registration.image_agreement import textured_parts

MIN_ALIKE = LoopClosureConfig().min_alike
CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 159.5, 119.5)
POSTER = np.s_[70:170, 110:210]


def wall(seed: int, contrast: float = 0.2) -> np.ndarray:
    """Gray values [h, w] of a wall, another one for each seed."""
    noise = np.random.default_rng(seed).standard_normal((240, 320)).astype(np.float32)
    smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), 4))
    return np.clip(0.5 + contrast * smooth / smooth.std(), 0, 1).astype(np.float32)


def view(gray: np.ndarray) -> RgbdPyramid:
    return RgbdPyramid.build(gray, np.full(gray.shape, 2.0, np.float32), CAMERA)


def share(gray: np.ndarray, other: np.ndarray) -> float:
    return textured_parts(Reference.sample(view(gray)), view(other), np.eye(4)).share_alike


def test_a_place_looks_like_itself_in_any_light() -> None:
    noise = 0.02 * np.random.default_rng(9).standard_normal((240, 320)).astype(np.float32)
    assert share(wall(1), wall(1)) == 1.0
    assert share(wall(1), 0.4 * wall(1) + 0.3 + noise) > 0.95


def test_a_poster_on_another_wall_is_another_place() -> None:
    one, other = wall(1), wall(2)
    one[POSTER] = other[POSTER] = wall(3)[POSTER]
    assert share(one, other) < MIN_ALIKE


def test_parts_are_known_by_their_places_on_the_surface() -> None:
    one, other = wall(1), wall(2)
    one[POSTER] = other[POSTER] = wall(3)[POSTER]
    T = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    shifted = np.roll(other, -13, axis=1)  # 0.1 m at 2 m
    parts = textured_parts(Reference.sample(view(one)), view(shifted), T)
    pixels = CAMERA.project(parts.centers)
    np.testing.assert_allclose(parts.centers[:, 2], 2.0, atol=1e-6)
    inside = (np.abs(pixels - [160, 120]) < 35).all(axis=1)
    outside = (np.abs(pixels - [160, 120]) > 75).any(axis=1)
    assert parts.alike[inside].all()
    assert parts.alike[outside].mean() < 0.2


def test_views_of_a_poster_on_another_wall_are_verified_as_unlike() -> None:
    one, other = wall(1, contrast=0.05), wall(2, contrast=0.05)
    one[POSTER] = other[POSTER] = wall(3)[POSTER]

    def alike(first: np.ndarray, second: np.ndarray) -> float:
        rng = random_streams.generator(0, "ransac")
        settings = GeometricVerificationConfig(), RegistrationConfig()
        found = verify(seen(first), seen(second), settings[0], registration=settings[1], rng=rng)
        assert found.failure is None
        return found.alike

    def seen(gray: np.ndarray) -> VerificationView:
        pyramid = view(gray)
        color = np.repeat((255 * gray).astype(np.uint8)[..., None], 3, axis=2)
        features = extract(color, np.full(gray.shape, 2.0, np.float32), CAMERA, 400)
        return VerificationView(features, Reference.sample(pyramid), lambda: pyramid)

    assert alike(one, one) == 1.0
    assert alike(one, other) < MIN_ALIKE


def test_a_place_where_less_than_half_changed_looks_like_itself() -> None:
    changed = wall(1)
    changed[:, :100] = wall(2)[:, :100]
    assert MIN_ALIKE < share(wall(1), changed) < 0.8


def test_without_texture_nothing_is_decided() -> None:
    assert share(wall(1, contrast=0.001), wall(2, contrast=0.001)) == 1.0
    away = se3.exp(np.array([50.0, 0, 0, 0, 0, 0]))
    assert textured_parts(Reference.sample(view(wall(1))), view(wall(1)), away).share_alike == 1.0


@pytest.mark.parametrize("textured_first", [True, False])
def test_texture_that_one_view_alone_shows_is_a_difference(textured_first: bool) -> None:
    views = (wall(1), wall(2, contrast=0.001))
    assert share(*views if textured_first else views[::-1]) < 0.1


def test_without_depth_gray_values_are_compared() -> None:
    reference = Reference.sample(view(wall(1)))
    assert textured_parts(reference, view(wall(1)).without_depth(), np.eye(4)).share_alike == 1.0


def test_a_reference_may_have_more_levels_than_the_other_view() -> None:
    more = RgbdPyramid.build(wall(1), np.full(wall(1).shape, 2.0, np.float32), CAMERA, 4)
    reference = Reference.from_pyramid(more, (4, 2, 1, 1))
    assert textured_parts(reference, view(wall(1)), np.eye(4)).share_alike == 1.0
    assert textured_parts(reference, view(wall(2)), np.eye(4)).share_alike < 0.1
