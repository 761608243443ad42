"""The index of views: as brute force where views are few, and as cheap for many."""

import numpy as np
import pytest

from duagc.pipeline.exchange import place_recognition
from duagc.pipeline.registration import descriptors
from duagc.pipeline.registration.features import Features
from duagc.pipeline.registration.place_index import ENTRIES, MOST, PlaceIndex

QUERIES = 20


@pytest.fixture(scope="module")
def views() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """400 views of 24 descriptors, and 20 of them again: half of the descriptors, changed a little."""
    rng = np.random.default_rng(0)
    first = [rng.integers(0, 120, (24, 128)).astype(np.uint8) for _ in range(400)]
    again = []
    for k in range(QUERIES):
        near = np.clip(first[19 * k][:12] + rng.integers(-12, 13, (12, 128)), 0, 255)
        again.append(np.concatenate([near, rng.integers(0, 120, (12, 128))]).astype(np.uint8))
    return first, again


def indexed(views: list[np.ndarray]) -> PlaceIndex:
    index = PlaceIndex()
    for view in views:
        index.add(view)
    return index


@pytest.fixture(scope="module")
def large(views: tuple[list[np.ndarray], list[np.ndarray]]) -> PlaceIndex:
    return indexed(views[0])


def test_few_views_are_all_given(views: tuple[list[np.ndarray], list[np.ndarray]]) -> None:
    index = indexed(views[0][:MOST])
    assert index.alike(views[1][0]) == list(range(MOST))
    assert index.entries_read == 0


def test_a_place_seen_again_is_given_among_many(
    views: tuple[list[np.ndarray], list[np.ndarray]], large: PlaceIndex
) -> None:
    found = [large.alike(view) for view in views[1]]
    assert all(len(alike) == MOST and alike == sorted(set(alike)) for alike in found)
    assert sum(19 * k in alike for k, alike in enumerate(found)) == QUERIES
    assert len(large.alike(np.zeros((0, 128), np.uint8))) == MOST


def test_views_may_be_added_between_queries(views: tuple[list[np.ndarray], list[np.ndarray]]) -> None:
    index = indexed(views[0][:80])
    index.alike(views[1][0])
    for view in views[0][80:120]:
        index.add(view)
    assert index.alike(views[1][1]) == indexed(views[0][:120]).alike(views[1][1])


def test_a_query_compares_no_more_with_four_times_the_views(
    views: tuple[list[np.ndarray], list[np.ndarray]], large: PlaceIndex, monkeypatch: pytest.MonkeyPatch
) -> None:
    distances = 0
    squared = descriptors.squared_distances

    def counted(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
        nonlocal distances
        distances += len(ours) * len(theirs)
        return squared(ours, theirs)

    monkeypatch.setattr(descriptors, "squared_distances", counted)
    cost = []
    for count in (100, 400):
        own = [Features(d, np.zeros((len(d), 3), np.float32)) for d in views[0][:count]]
        distances = 0
        candidates, _ = place_recognition.scored(own, views[1][:2], 0.8, 8)
        assert [c.ends for c in candidates] == [(19 * j, j) for j in range(2)]
        cost.append(distances)
    assert cost[0] == cost[1] == 2 * MOST * 24 * 24
    before = large.entries_read
    large.alike(views[1][0])
    assert 0 < large.entries_read - before <= ENTRIES
