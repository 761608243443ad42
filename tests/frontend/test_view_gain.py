"""Views are chosen by what they would tell the map beyond what it knows."""

import numpy as np

from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.frontend.view_gain import PRIOR, ViewGain
from duagc.pipeline.geometry import se3
from tests.fixtures.speckled_wall import CAMERA, POSES, wall


def gain_of() -> ViewGain:
    return ViewGain(wall(), "blended", CAMERA, MappingConfig(), 1)


def test_a_view_of_what_was_not_seen_is_chosen_first_and_what_was_seen_last() -> None:
    away = POSES[0] @ se3.exp(np.array([0, 0, 0, np.pi / 2, 0, 0]))  # it looks at the ceiling
    aside = POSES[0].copy()
    aside[0, 3] += 0.5
    gain = gain_of()
    assert gain.information(away).sum() == 0
    assert gain.chosen([POSES[0]], [away, POSES[0], aside], 1) == [2]
    assert gain.chosen([POSES[0]], [away, POSES[0], aside], 1, least=True) == [0]
    # once a view was taken, its like adds less than another
    assert gain.chosen([], [aside, aside, POSES[0]], 2) == [0, 2]


def test_no_other_pair_tells_more_than_that_of_the_largest_gains() -> None:
    gain, seen = gain_of(), [POSES[0]]
    candidates = list(POSES[1:])
    known = PRIOR + gain.information(seen[0])
    own = [gain.information(T) for T in candidates]
    assert sum(information.any() for information in own) > 2

    def gained(chosen: list[int]) -> float:
        return float(np.sum(np.log1p(sum(own[k] for k in chosen) / known)))

    best = gained(gain.chosen(seen, candidates, 2))
    every = [gained([i, j]) for i in range(len(own)) for j in range(i)]
    assert best >= (1 - 1 / np.e) * max(every)  # the bound of a greedy choice (Nemhauser et al. 1978)
    assert best > np.median(every)
    assert gained(gain.chosen(seen, candidates, 2, least=True)) < np.median(every)
