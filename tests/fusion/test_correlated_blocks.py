"""Blocks of two images that show the same."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from duagc.pipeline.fusion.correlated_blocks import BLOCK_PX, CorrelatedBlocks

SHAPE = (130, 170)  # not a multiple of the block
EVERYWHERE = np.ones(SHAPE, bool)


def texture(seed: int) -> np.ndarray:
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(*SHAPE, 3)), (2, 2, 0))
    return (0.5 + 0.15 * noise / noise.std()).astype(np.float32)


def share(seen: np.ndarray, shown: np.ndarray, where: np.ndarray = EVERYWHERE) -> tuple[float, int]:
    found = CorrelatedBlocks()
    found.add(seen, shown, where)
    return found.share, found.blocks


def test_what_differs_in_exposure_is_alike():
    assert share(texture(0), 0.6 * texture(0) + 0.1) == (1.0, (130 // BLOCK_PX) * (170 // BLOCK_PX))


@pytest.mark.parametrize("other", [texture(1), np.roll(texture(0), 9, axis=1), 1 - texture(0)])
def test_what_shows_something_else_is_not(other):
    assert share(texture(0), other)[0] < 0.15


def test_slopes_and_single_colors_tell_nothing():
    slope = np.broadcast_to(np.linspace(0, 1, SHAPE[1], dtype=np.float32)[None, :, None], (*SHAPE, 3))
    assert share(slope, slope)[1] == 0
    assert share(np.full_like(slope, 0.4), texture(0))[1] == 0
    assert share(texture(0), np.full_like(slope, 0.4))[0] == 0.0
    assert share(texture(0) / 2 + slope / 2, texture(1) / 2 + slope / 2)[0] < 0.15


def test_half_of_an_image_is_half_of_the_blocks():
    mixed, known = texture(0).copy(), EVERYWHERE.copy()
    mixed[:64] = texture(1)[:64]
    assert share(texture(0), mixed)[0] == pytest.approx(0.5, abs=0.1)
    known[:64] = False
    assert share(texture(0), mixed, known) == (1.0, 4 * (170 // BLOCK_PX))


def test_a_block_is_compared_where_most_of_it_is_known():
    known = np.zeros(SHAPE, bool)
    known[:14, :16] = known[16:26, :16] = True
    assert share(texture(0), texture(0), known)[1] == 1
    hidden = np.where(known[..., None], texture(0), 0).astype(np.float32)
    assert share(texture(0), hidden, known) == (1.0, 1)
