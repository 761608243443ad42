"""A shortlist of views by words of their descriptors: bounded, and it holds the views that match."""

import numpy as np
import pytest

from duagc.pipeline.config.frontend import LoopConfig
from duagc.pipeline.registration.descriptors import matches
from duagc.pipeline.registration.place_recognition import Places


@pytest.fixture(scope="module")
def views() -> list[np.ndarray]:
    """100 places of 120 descriptors each, then the same places again: half of the descriptors, changed a little."""
    rng = np.random.default_rng(0)
    first = [rng.integers(0, 120, (120, 128)) for _ in range(100)]
    again = [
        np.concatenate([place[:60] + rng.integers(-12, 13, (60, 128)), rng.integers(0, 120, (60, 128))])
        for place in first
    ]
    return [np.clip(d, 0, 255).astype(np.uint8) for d in (*first, *again)]


def test_a_place_seen_again_is_on_the_list(views: list[np.ndarray]) -> None:
    places = Places(views)
    found = [places.alike(100 + k, 100, 3) for k in range(100)]
    assert all(len(alike) == 3 and alike == sorted(alike) for alike in found)
    assert sum(k in alike for k, alike in enumerate(found)) >= 99


def test_where_few_are_asked_for_all_are_on_the_list(views: list[np.ndarray]) -> None:
    assert Places(views).alike(5, 4, 32) == [0, 1, 2, 3]


def test_views_without_features_are_last(views: list[np.ndarray]) -> None:
    empty = np.zeros((0, 128), dtype=np.uint8)
    places = Places([empty, *views[:3], views[100]])
    assert places.alike(4, 4, 1) == [1]
    assert places.alike(4, 4, 3) == [1, 2, 3]
    assert Places([empty, empty]).alike(1, 1, 1) == [0]


@pytest.mark.parametrize("candidates", [1, 3])
def test_views_with_most_matches_resemble_the_earlier_first(views: list[np.ndarray], candidates: int) -> None:
    limits = LoopConfig(min_matches=20, candidates=candidates)
    shown = [views[0], views[7], views[3], views[7], views[107]]
    found = Places(shown).resembling(4, 4, limits)
    assert [k for _, k in found] == [1, 3][:candidates], "equal views, of which the earlier comes first"
    assert [count for count, _ in found] == [
        len(matches(shown[k], shown[4], limits.ratio)) for k in [1, 3][:candidates]
    ]
    assert Places(shown).resembling(4, 1, limits) == [], "of the first view alone"
    empty = np.zeros((0, 128), dtype=np.uint8)
    assert Places([empty, views[7], empty]).resembling(2, 2, limits) == []
