"""Masks: what is left of them in smaller images and windows, and that filled images hold nothing of what is masked."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from duagc.pipeline.geometry import masks


def mask_of(seed: int, shape: tuple[int, int] = (9, 14), share: float = 0.3) -> masks.Mask:
    return np.random.default_rng(seed).random(shape) > share


@given(st.integers(0, 1000))
@settings(deadline=None, max_examples=30)
def test_a_coarse_pixel_may_be_used_if_all_its_parts_may(seed: int) -> None:
    mask = mask_of(seed)
    half = masks.halved(mask)
    assert half.shape == (4, 7)
    for v in range(4):
        for u in range(7):
            assert half[v, u] == mask[2 * v : 2 * v + 2, 2 * u : 2 * u + 2].all()


@given(st.integers(0, 1000), st.integers(0, 3))
@settings(deadline=None, max_examples=30)
def test_a_whole_window_holds_usable_pixels_only(seed: int, reach: int) -> None:
    mask = mask_of(seed, share=0.1)
    whole = masks.whole_windows(mask, reach)
    for v in range(mask.shape[0]):
        for u in range(mask.shape[1]):
            window = mask[max(v - reach, 0) : v + reach + 1, max(u - reach, 0) : u + reach + 1]
            assert whole[v, u] == window.all()


@given(st.integers(0, 1000), st.floats(0.05, 0.95))
@settings(deadline=None, max_examples=50)
def test_a_filled_image_depends_on_usable_pixels_alone(seed: int, share: float) -> None:
    mask = mask_of(seed, share=share)
    rng = np.random.default_rng(seed + 1)
    color = rng.integers(0, 256, (*mask.shape, 3), dtype=np.uint8)
    other = np.where(mask[..., None], color, rng.integers(0, 256, color.shape, dtype=np.uint8))
    filled = masks.filled(color, mask)
    assert np.array_equal(filled, masks.filled(other, mask))
    assert np.array_equal(filled[mask], color[mask])
    if mask.any():
        present = {tuple(c) for c in color[mask].tolist()}
        assert all(tuple(c) in present for c in filled.reshape(-1, 3).tolist())
    else:
        assert not filled.any()


def test_the_color_is_that_of_a_pixel_next_to_it() -> None:
    color = np.zeros((4, 6, 3), np.uint8)
    color[:, :3], color[:, 3:] = 10, 200
    mask = np.ones((4, 6), bool)
    mask[:, :2] = mask[:, 4:] = False
    filled = masks.filled(color, mask)
    assert (filled[:, :3] == 10).all()
    assert (filled[:, 3:] == 200).all()


def test_no_usable_pixel_is_much_nearer_than_the_one_that_fills() -> None:
    v, u = np.mgrid[:24, :32]
    color = np.stack([v, u, 0 * v], axis=2).astype(np.uint8)  # says where it is
    for seed in range(20):
        mask = mask_of(seed, share=0.1 + 0.04 * seed, shape=(24, 32))
        if mask.any():
            found = masks.filled(color, mask).astype(int)
            away = np.hypot(found[..., 0] - v, found[..., 1] - u)
            # OpenCV's 5x5 steps miss the Euclidean distance by some percent
            np.testing.assert_array_less(away, 1.1 * masks.distance_px(~mask) + 0.5)


def test_distances_are_to_masked_pixels() -> None:
    mask = np.ones((5, 8), bool)
    assert np.isinf(masks.distance_px(mask)).all()
    mask[2, 0] = False
    distance = masks.distance_px(mask)
    assert distance[2, 0] == 0
    np.testing.assert_allclose(distance[2, 1:], np.arange(1, 8))
    np.testing.assert_allclose(distance[0, 2], np.hypot(2, 2), rtol=1e-6)


def test_a_picture_shows_squares_of_gray_where_it_is_masked() -> None:
    image = np.full((32, 32, 3), 50, np.uint8)
    mask = np.ones((32, 32), bool)
    mask[:, 16:] = False
    shown = masks.checkered(image, mask)
    assert (shown[:, :16] == 50).all()
    assert set(np.unique(shown[:, 16:])) == set(masks.CHECKER)
    assert masks.checkered(image, None) is image


@given(st.integers(0, 1000), st.floats(0.0, 1.0))
@settings(deadline=None, max_examples=30)
def test_a_total_is_that_of_usable_pixels(seed: int, share: float) -> None:
    mask = mask_of(seed, share=share)
    planes = np.random.default_rng(seed + 1).random((3, *mask.shape), dtype=np.float32)
    wanted = planes[:, mask].sum(dtype=np.float64)
    np.testing.assert_allclose(masks.total(planes, mask), wanted, rtol=1e-12)
    np.testing.assert_allclose(
        masks.total(planes[0], mask), planes[0][mask].sum(dtype=np.float64), rtol=1e-12
    )


def test_regions_of_less_than_a_share_of_the_image_are_left_out() -> None:
    pixels = np.zeros((10, 10), bool)
    pixels[0, 0] = pixels[1, 1] = pixels[2, 2] = True  # connected by corners
    pixels[7, 7] = True
    found = masks.large_regions(pixels, 0.03)
    assert found.sum() == 3
    assert not found[7, 7]
    assert not masks.large_regions(pixels, 0.04).any()
    assert (masks.large_regions(pixels, 0.0) == pixels).all()
