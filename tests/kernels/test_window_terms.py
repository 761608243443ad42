"""Windows of SSIM: the compiled passes compute what numpy defines, to the bit, and refuse what has no window."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.kernels import available_isas, window_terms_definition
from duagc.pipeline.kernels.window_terms import window_means, window_terms
from duagc.pipeline.kernels.window_terms_definition import SeenWindows

SIZES = {
    "one window": (11, 11, 3),
    "one row": (11, 40, 3),
    "gray": (24, 33, 1),
    "one strip": (14, 180, 3),
    "strips": (19, 400, 3),
    "many channels": (16, 120, 5),
}


def images_of(size: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    r = np.random.default_rng(7)
    seen = r.uniform(0, 1, SIZES[size]).astype(np.float32)
    drawn = np.clip(seen + r.normal(0, 0.2, seen.shape), 0, 1).astype(np.float32)
    drawn[:5, :5] = seen[:5, :5]
    height, width, channels = seen.shape
    weight = r.integers(0, 2, (height - 10, width - 10, channels)).astype(np.float32)
    return drawn, seen, weight


@pytest.mark.parametrize("isa", available_isas())
@pytest.mark.parametrize("size", SIZES)
def test_means_and_sums_are_those_of_the_definition(size: str, isa: str) -> None:
    drawn, seen, weight = images_of(size)
    mean = window_means(seen, isa=isa)
    np.testing.assert_array_equal(mean, window_terms_definition.window_means(seen))
    variance = window_means(seen * seen, isa=isa) - mean * mean
    for of_windows in (None, weight):
        windows = SeenWindows(seen, mean, variance, of_windows)
        found = window_terms(drawn, windows, isa=isa)
        assert found == window_terms_definition.window_terms(drawn, windows)
    assert found[0] != found[1]


def test_a_window_is_that_of_a_gaussian() -> None:
    distance = np.arange(-5, 6)
    row = np.exp(-(distance**2) / (2 * 1.5**2))
    row /= row.sum()
    one = np.zeros((21, 21, 1), np.float32)
    one[10, 10] = 1.0
    np.testing.assert_allclose(window_means(one)[..., 0], np.outer(row, row), rtol=3e-7)


def test_equal_images_agree_to_the_bit() -> None:
    _, seen, _ = images_of("strips")
    mean = window_means(seen)
    variance = window_means(seen * seen) - mean * mean
    assert window_terms(seen, SeenWindows(seen, mean, variance)) == (mean.size, mean.size)


def test_what_has_no_window_or_another_shape_is_refused() -> None:
    drawn, seen, weight = images_of("gray")
    mean = window_means(seen)
    for image in (seen[:10], seen[:, :10], seen[..., 0], seen[..., :0]):
        with pytest.raises(ValueError, match="no window of 11x11"):
            window_means(image)
        with pytest.raises(ValueError, match="no window of 11x11"):
            window_terms(image, SeenWindows(image, mean, mean))
    windows = SeenWindows(seen, mean, mean, weight)
    with pytest.raises(ValueError, match="drawn has shape"):
        window_terms(drawn[1:], windows)
    for name in ("mean", "variance", "weight"):
        with pytest.raises(ValueError, match=f"{name} has shape"):
            window_terms(drawn, replace(windows, **{name: mean[1:]}))
