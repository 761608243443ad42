"""Image metrics agree with their definitions."""

import numpy as np
import pytest

from duagc.pipeline.evaluation.image_metrics import depth_error, ms_ssim, psnr, ssim
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
    assert ssim(x, y) == pytest.approx(np.mean(values), abs=1e-9)
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
