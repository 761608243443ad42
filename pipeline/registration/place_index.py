"""An index of many views, so that a view is compared feature by feature with a bounded number of them.

A descriptor has words as in `place_recognition`; two of different tables together make a rare word, which is listed
with the views that have it (an inverted file: Sivic and Zisserman 2003). A query reads the shortest lists, up to a
bounded number of entries, and ranks views by how often they were read: what it costs does not grow with the views.
"""

from __future__ import annotations

from collections import Counter
from itertools import islice

import numpy as np

from duagc.pipeline.registration.descriptors import Descriptors
from duagc.pipeline.registration.place_recognition import TABLES, WORDS, center_of, words_of

MOST = 64
"""Views that a query gives. No more than so many are all given, as without an index."""
STRONGEST = 120
"""Features of a view that are indexed."""
ENTRIES = 4000
"""Read by a query. Among 500, 2,000 and 5,000 views, 13 of RedKitchen and others shuffled from real descriptors, 49, 48
and 46 of the 49 pairs that brute force finds are given."""


class PlaceIndex:
    """Views in the order in which they were added.

    Attributes:
        entries_read: by all queries so far.
    """

    def __init__(self) -> None:
        self.entries_read = 0
        self._count = 0
        self._first: list[Descriptors] = []  # until there are more than are given anyway
        self._center = np.zeros(0, dtype=np.float32)
        self._views: dict[int, list[int]] = {}  # by rare word

    def __len__(self) -> int:
        return self._count

    def add(self, view: Descriptors) -> None:
        """Index a view.

        Args:
            view: its descriptors, strongest first, uint8 [n, 128].
        """
        self._count += 1
        self._first.append(view[:STRONGEST])
        if self._count <= MOST:
            return
        if self._count == MOST + 1:
            self._center = center_of(self._first)
        for index, one in enumerate(self._first, start=self._count - len(self._first)):
            for word in self._rare_words(one):
                self._views.setdefault(word, []).append(index)
        self._first = []

    def alike(self, view: Descriptors) -> list[int]:
        """The views that share most rare words with a view, `MOST` of them, ascending.

        Args:
            view: its descriptors, strongest first, uint8 [n, 128].
        """
        if self._count <= MOST:
            return list(range(self._count))
        lists = sorted((self._views.get(word, []) for word in self._rare_words(view)), key=len)
        shared: Counter[int] = Counter()
        left = ENTRIES
        for views in lists:
            if len(views) > left:
                break
            left -= len(views)
            shared.update(views)
        self.entries_read += ENTRIES - left
        best = sorted(shared, key=lambda index: (-shared[index], index))[:MOST]
        others = (index for index in range(self._count) if index not in shared)
        return sorted([*best, *islice(others, MOST - len(best))])

    def _rare_words(self, view: Descriptors) -> list[int]:
        """Pairs of words of a view, as numbers, ascending."""
        words = words_of(view[:STRONGEST].astype(np.float32) - self._center)
        tables = np.arange(TABLES // 2)
        return np.unique((tables * WORDS + words[:, ::2]) * WORDS + words[:, 1::2]).tolist()
