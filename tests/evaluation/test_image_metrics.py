"""Image metrics agree with their definitions."""

import numpy as np
import pytest

from duagc.pipeline.evaluation.image_metrics import (
    SsimReference,
    counted_windows,
    depth_error,
    ms_ssim,
    psnr,
    ssim,
)
from duagc.pipeline.kernels import Render


def test_psnr_of_a_known_error() -> None:
    image = np.full((4, 5, 3), 0.5)
    assert psnr(image + 0.1, image) == pytest.approx(20.0)
    assert psnr(image, image) == np.inf
    assert psnr(image + 7.0, np.ones_like(image)) == np.inf  # clipped to the range first
    mask = np.zeros((4, 5), bool)
    mask[0, 0] = True
    noisy = image + 0.1
    noisy[0, 0] += 0.9
    assert psnr(np.minimum(noisy, 1.0), image, mask) == pytest.approx(-20 * np.log10(0.5))


def test_ssim_agrees_with_its_definition_window_by_window() -> None:
    r = np.random.default_rng(0)
    x = r.uniform(0, 1, (14, 13, 3))
    y = np.clip(x + r.normal(0, 0.1, x.shape), 0, 1)
    k = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    w = np.outer(k, k)
    w /= w.sum()
    values = []
    for i in range(4):
        for j in range(3):
            for c in range(3):
                p, q = x[i : i + 11, j : j + 11, c], y[i : i + 11, j : j + 11, c]
                mp, mq = (w * p).sum(), (w * q).sum()
                vp, vq, cov = (
                    (w * (p - mp) ** 2).sum(),
                    (w * (q - mq) ** 2).sum(),
                    (w * (p - mp) * (q - mq)).sum(),
                )
                top = (2 * mp * mq + 1e-4) * (2 * cov + 9e-4)
                values.append(top / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    assert ssim(x, y) == pytest.approx(np.mean(values), abs=3e-7)  # in float32
    assert ssim(x, x) == pytest.approx(1.0, abs=1e-12)


def test_ms_ssim_is_another_number_and_needs_room() -> None:
    r = np.random.default_rng(0)
    x = np.clip(np.cumsum(r.normal(0, 0.02, (176, 180, 3)), axis=0) + 0.5, 0, 1)
    y = np.clip(x + r.normal(0, 0.05, x.shape), 0, 1)
    assert ms_ssim(x, x) == pytest.approx(1.0, abs=1e-9)
    assert ssim(x, y) < ms_ssim(x, y) < 1.0
    assert ms_ssim(x, y, weights=(1.0,)) == pytest.approx(ssim(x, y), abs=1e-12)
    with pytest.raises(ValueError, match="needs 176 pixels"):
        ms_ssim(x[:175], y[:175])


def test_depth_error_counts_what_is_covered() -> None:
    alpha = np.array([[1.0, 0.5, 0.2, 1.0]], np.float32)
    depth = np.array([[2.0, 1.0, 1.0, 0.0]], np.float32)
    drawn = Render(
        np.zeros((1, 4, 3), np.float32), alpha * (np.array([[2.1, 1.2, 5.0, 3.0]], np.float32)), alpha
    )
    error, completeness = depth_error(drawn, depth)
    assert error == pytest.approx(0.15, abs=1e-6)
    assert completeness == pytest.approx(2 / 3)
    assert np.isnan(depth_error(drawn, np.zeros_like(depth))[0])


def test_windows_that_touch_a_masked_pixel_are_left_out() -> None:
    """The mean over the others is that of the image without what is masked, whatever is there."""
    r = np.random.default_rng(1)
    x = r.uniform(0, 1, (40, 50, 3))
    y = np.clip(x + r.normal(0, 0.1, x.shape), 0, 1)
    mask = np.ones((40, 50), bool)
    mask[:7], mask[:, -9:] = False, False
    other = np.where(mask[..., None], x, r.uniform(0, 1, x.shape))
    assert ssim(x, y, mask) == pytest.approx(ssim(x[7:, :-9], y[7:, :-9]), abs=1e-12)
    assert ssim(other, y, mask) == ssim(x, y, mask)
    assert ssim(x, y, np.ones_like(mask)) == ssim(x, y)
    mask[20, 25] = False
    assert np.count_nonzero(counted_windows(mask)) == 23 * 31 - 11 * 11
    with pytest.raises(ValueError, match="no 11x11 window"):
        ssim(x, y, np.zeros_like(mask))


def test_masked_scales_count_pixels_all_parts_of_which_count() -> None:
    r = np.random.default_rng(2)
    x = np.clip(np.cumsum(r.normal(0, 0.02, (192, 208, 3)), axis=0) + 0.5, 0, 1)
    y = np.clip(x + r.normal(0, 0.05, x.shape), 0, 1)
    mask = np.ones((192, 208), bool)
    mask[:16], mask[:, :16] = False, False
    cut = np.s_[16:, 16:]
    assert ms_ssim(x, y, mask=mask) == pytest.approx(ms_ssim(x[cut], y[cut]), abs=1e-12)


def test_both_numbers_at_once_are_those_of_the_two_functions() -> None:
    r = np.random.default_rng(6)
    y = np.repeat(np.repeat(r.uniform(0, 1, (48, 60, 3)), 4, axis=0), 4, axis=1)
    x = np.clip(y + r.normal(0, 0.1, y.shape), 0, 1)
    assert SsimReference(y).both(x) == (ssim(x, y), ms_ssim(x, y))
    assert ssim(x, y) < 0.95 * ms_ssim(x, y)
