"""A shortlist of the views that resemble a view, so that only a bounded number is compared feature by feature.

A descriptor becomes one word per table: of the directions of the table, all with entries +1 and -1, the one that it
points along most, and the sign (cross-polytope hashing: Andoni et al. 2015). Near descriptors mostly share some word.
A view is the set of its words; views are ranked by words in common. No vocabulary is trained; the directions are drawn
once and for all. Sums of small integers are exact in float32, so the ranking does not depend on the order of sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.registration.descriptors import DIMENSIONS, Descriptors, matches

TABLES = 8
DIRECTIONS = 128  # per table, two words each
WORDS = 2 * DIRECTIONS


class PlaceLimits(Protocol):
    """Which views resemble a view.

    Attributes:
        compared: views, those that share most words, whose descriptors are compared.
        ratio: of the ratio test of the matches.
        min_matches: from which a view resembles.
        candidates: at most so many do, those with most matches.
    """

    @property
    def compared(self) -> int: ...
    @property
    def ratio(self) -> float: ...
    @property
    def min_matches(self) -> int: ...
    @property
    def candidates(self) -> int: ...


class Places:
    """Views by the words of their descriptors."""

    def __init__(self, views: Sequence[Descriptors]) -> None:
        """Index the views.

        Args:
            views: descriptors of every view, uint8 [n, 128] each.
        """
        self._views = views
        center = center_of(views)
        self._has = np.stack([_words(d.astype(np.float32) - center) for d in views])

    def alike(self, view: int, among: int, most: int) -> list[int]:
        """The views that share most words with a view, ascending.

        A view of few features has few words to share: the count is divided by the root of its words.

        Args:
            view: its index.
            among: only the first so many views are compared.
            most: largest number of views returned.
        """
        if among <= most:
            return list(range(among))
        shared = self._has[:among] @ self._has[view]
        score = shared / np.sqrt(np.maximum(self._has[:among].sum(axis=1), 1))
        return sorted(np.argsort(-score, kind="stable")[:most].tolist())

    def resembling(self, view: int, among: int, limits: PlaceLimits) -> list[tuple[int, int]]:
        """Views with most matches, each with their number, the best first, of several the earlier.

        Descriptors are compared with those of a bounded number of views only, however many there are.

        Args:
            view: its index.
            among: only the first so many views are compared.
            limits: how many, and from how many matches.
        """
        theirs = self._views[view]
        scores = [
            (len(matches(self._views[k], theirs, limits.ratio)), k)
            for k in self.alike(view, among, limits.compared)
        ]
        enough = [(score, k) for score, k in scores if score >= limits.min_matches]
        return sorted(enough, key=lambda scored: (-scored[0], scored[1]))[: limits.candidates]


def center_of(views: Sequence[Descriptors]) -> NDArray[np.float32]:
    """What the features of all views have in common, [128]; it does not distinguish places.

    Args:
        views: descriptors of every view, uint8 [n, 128] each.
    """
    total = sum((d.sum(axis=0, dtype=np.int64) for d in views), np.zeros(DIMENSIONS, dtype=np.int64))
    return np.rint(total / max(sum(map(len, views)), 1)).astype(np.float32)


def words_of(centered: NDArray[np.float32]) -> NDArray[np.int64]:
    """The word of every descriptor in every table, [n, TABLES], each below WORDS.

    Args:
        centered: descriptors [n, 128] without what all have in common.
    """
    words = np.zeros((len(centered), TABLES), dtype=np.int64)
    for table, directions in enumerate(_DIRECTIONS):
        along = centered @ directions
        nearest = np.abs(along).argmax(axis=1)
        words[:, table] = 2 * nearest + (along[np.arange(len(along)), nearest] > 0)
    return words


def _words(centered: NDArray[np.float32]) -> NDArray[np.float32]:
    """Which words descriptors [n, 128] have, [TABLES * WORDS], 0 or 1."""
    has = np.zeros((TABLES, WORDS), dtype=np.float32)
    has[np.arange(TABLES), words_of(centered)] = 1
    return has.ravel()


def _signs(table: int) -> NDArray[np.float32]:
    draw = random_streams.generator(0, "places", table=table).integers(0, 2, (DIMENSIONS, DIRECTIONS))
    return np.where(draw == 1, np.float32(1), np.float32(-1))


_DIRECTIONS = [_signs(table) for table in range(TABLES)]
