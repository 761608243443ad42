"""PSNR with the exposure of a view fitted on one half and scored on the other."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.evaluation import views
from duagc.pipeline.evaluation.exposure import FittedPsnr, fit_exposure, fitted_psnr
from duagc.pipeline.evaluation.image_metrics import psnr
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.views import ComparedImage
from duagc.pipeline.geometry.exposure import Exposure
from duagc.pipeline.kernels import Render

SHAPE = (40, 60)


def drawn(color: np.ndarray, alpha: float = 1.0) -> Render:
    full = np.full(color.shape[:2], alpha, np.float32)
    return Render(color.astype(np.float32), 2 * full, full)


def texture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 0.7, (*SHAPE, 3))


def scored(color: np.ndarray, image: np.ndarray, valid: np.ndarray | None = None) -> FittedPsnr:
    found = fitted_psnr(drawn(color), image, valid)
    assert isinstance(found, FittedPsnr)
    return found


def test_a_gain_and_an_offset_of_each_channel_cost_nothing() -> None:
    color = texture()
    image = color * np.array([0.8, 1.0, 1.3]) + np.array([0.02, -0.05, 0.0])
    found = scored(color, image)
    assert min(found.left, found.right, found.both) > 60  # what is left is the pull of the gain toward one
    assert psnr(color, image) < 25


def test_a_half_is_scored_in_the_exposure_of_the_other_one() -> None:
    color = texture()
    image = color.copy()
    image[:, :30] *= 1.2  # no exposure of the right half explains the left one, and the other way round
    found = scored(color, image)
    assert found.left == pytest.approx(psnr(color[:, :30], image[:, :30]), abs=0.01)
    assert found.right == pytest.approx(psnr(1.2 * color[:, 30:], image[:, 30:]), abs=0.01)
    together = -10 * np.log10(0.5 * (10 ** (-found.left / 10) + 10 ** (-found.right / 10)))
    assert found.both == pytest.approx(together, abs=1e-9)


def test_what_the_map_does_not_show_stays_black_in_every_exposure() -> None:
    """Little alpha takes little of the offset, and does not take part in the fit."""
    color, alpha = texture(), np.ones(SHAPE, np.float32)
    alpha[::2, ::3], alpha[1::2, ::3] = 0.0, 0.4
    offset = np.array([0.2, 0.1, 0.15])
    image = np.clip(color * alpha[..., None] + offset * alpha[..., None], 0, 1)
    render = replace(drawn(color * alpha[..., None]), alpha=alpha)
    whole = alpha >= 1
    found = fitted_psnr(render, image)
    assert isinstance(found, FittedPsnr)
    assert whole.mean() > 0.6
    assert min(found.left, found.right) > 45


def test_pixels_scored_never_change_their_own_exposure() -> None:
    color, r = texture(), np.random.default_rng(1)
    image = 0.9 * color
    first = scored(color, image)
    image[:, 30:] = r.uniform(0, 1, (40, 30, 3))
    assert scored(color, image).right < 20
    left_only = scored(color, np.concatenate([0.9 * color[:, :30], 0.9 * color[:, 30:]], axis=1))
    assert left_only == first


def test_a_moving_object_does_not_spoil_the_fit() -> None:
    color = texture()
    image = 0.8 * color
    image[10:20, 5:20] = 0.95
    gain, offset = fit_exposure(color[..., 0].ravel(), image[..., 0].ravel())
    assert gain == pytest.approx(0.8, abs=0.02)
    assert offset == pytest.approx(0.0, abs=0.01)


def test_clipped_colors_do_not_bend_the_gain() -> None:
    color = texture()
    image = np.minimum(1.6 * color, 1.0)
    gain, _ = fit_exposure(color[..., 0].ravel(), image[..., 0].ravel())
    assert gain == pytest.approx(1.6, abs=0.01)


def test_a_render_of_one_color_keeps_its_gain() -> None:
    gain, offset = fit_exposure(np.full(500, 0.4), np.full(500, 0.5))
    assert (gain, offset) == (pytest.approx(1.0), pytest.approx(0.1))


def test_pixels_that_are_not_valid_are_neither_fitted_nor_scored() -> None:
    color = texture()
    image = 0.9 * color
    valid = np.ones(SHAPE, bool)
    valid[:, :6] = valid[:5] = False
    image[~valid] = 0.0
    assert scored(color, image, valid).both > 60
    assert scored(color, image).both < 20


def test_what_cannot_be_fitted_is_absent() -> None:
    color = texture()
    for found in (
        fitted_psnr(drawn(color, alpha=0.3), color),
        fitted_psnr(drawn(color), np.ones_like(color)),
        fitted_psnr(drawn(color), color, np.arange(60)[None].repeat(40, axis=0) >= 30),
    ):
        assert isinstance(found, Absent)
        assert "100 pixels" in found.reason


def test_a_view_has_both_scores_under_their_own_names() -> None:
    color = np.rint(texture() * 255)
    image = np.rint(0.7 * color).astype(np.uint8)
    score = views.score_view(
        drawn(color / 255), ComparedImage(image), np.zeros(SHAPE, np.float32), Absent("none")
    )
    assert score.psnr_db == pytest.approx(psnr(color / 255, image / 255.0), abs=1e-5)
    values = (score.psnr_exposure_db, score.psnr_exposure_left_db, score.psnr_exposure_right_db)
    assert all(isinstance(value, float) and value > 45 for value in values)
    assert score.psnr_db < 20


def test_an_interpolated_exposure_changes_only_the_score_of_its_name() -> None:
    color = np.rint(texture() * 255)
    image = np.rint(0.7 * color).astype(np.uint8)
    exposure = Exposure(np.full(3, 0.7), np.zeros(3), np.ones(3))
    depth, absent = np.zeros(SHAPE, np.float32), Absent("none")
    plain = views.score_view(drawn(color / 255), ComparedImage(image), depth, absent)
    known = views.score_view(drawn(color / 255), ComparedImage(image), depth, absent, exposure=exposure)
    assert plain.psnr_interpolated_db == plain.psnr_db == known.psnr_db
    assert isinstance(known.psnr_interpolated_db, float)
    assert known.psnr_interpolated_db > 45
    assert known.ssim == plain.ssim


def test_a_view_as_its_camera_moved_changes_only_the_score_of_its_name() -> None:
    color = np.rint(texture() * 255)
    image = np.rint(0.7 * color).astype(np.uint8)
    exposure = Exposure(np.full(3, 0.7), np.zeros(3), np.ones(3))
    wrong, depth, absent = drawn(np.zeros_like(color)), np.zeros(SHAPE, np.float32), Absent("none")
    still = views.score_view(wrong, ComparedImage(image), depth, absent, exposure=exposure)
    moved = views.score_view(
        wrong, ComparedImage(image), depth, absent, exposure=exposure, moved=drawn(color / 255)
    )
    assert still.psnr_moved_db == still.psnr_interpolated_db
    assert isinstance(moved.psnr_moved_db, float)
    assert moved.psnr_moved_db > 45
    assert replace(moved, psnr_moved_db=still.psnr_moved_db) == still
