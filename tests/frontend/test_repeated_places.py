"""Along a place that repeats itself features of two keyframes may agree on a motion to the next of the same things."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.experiments.disturbed_tracking import Undisturbed
from duagc.pipeline.frontend.followed_things import fills_views
from duagc.pipeline.frontend.judgment import Judgment, PairVerdict, judge
from duagc.pipeline.frontend.repeated_places import Ends, of_repeated_places
from duagc.pipeline.frontend.tracked import TrackedKeyframe
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.registration import RgbdPyramid
from duagc.pipeline.registration.features import Features
from tests.frontend.conftest import CONFIG, STARTS

COUNT = 5
ENDS = (0, COUNT - 1)
SHARED = 40  # features of two keyframes
PERIOD = se3.exp(np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
POSES = np.array([se3.exp(np.array([0.3 * k, 0.0, 0.0, 0.0, 0.0, 0.0])) for k in range(COUNT)])
T_TRUE = se3.inverse(POSES[0]) @ POSES[-1]


def no_images(index: int, levels: int) -> RgbdPyramid:
    raise AssertionError("features leave nothing to be asked of images")


def views_of(
    run: Undisturbed, T_ends: np.ndarray, *, spread: float = 1.0, confirmed: int = COUNT - 1
) -> list[TrackedKeyframe]:
    """Keyframes share features with the two before them, the last one with the first under another motion.

    Of the others only pairs that begin before keyframe `confirmed` have features in common.
    """
    rng = np.random.default_rng(1)
    low, high = np.array([-2.0, -1.5, 1.0]), np.array([2.0, 1.5, 5.0])
    middle = (low + high) / 2
    points: list[list[np.ndarray]] = [[] for _ in POSES]
    descriptors: list[list[np.ndarray]] = [[] for _ in POSES]

    def share(first: int, second: int, T: np.ndarray, wide: float) -> None:
        theirs = middle + wide * (rng.uniform(low, high, (SHARED, 3)) - middle)
        for k, seen in ((first, se3.transform(T, theirs)), (second, theirs)):
            points[k].append(seen)
        named = rng.integers(0, 256, (SHARED, 128)).astype(np.uint8)
        for k in (first, second):
            descriptors[k].append(named)

    for second in range(1, COUNT):
        for first in range(max(0, second - 2), min(second, confirmed)):
            share(first, second, se3.inverse(POSES[first]) @ POSES[second], spread)
    share(0, COUNT - 1, T_ends, 1.0)
    keyframe = run.tracker(STARTS[-1]).keyframes[0]
    return [
        replace(keyframe, features=Features(np.concatenate(d), np.concatenate(p).astype(np.float32)))
        for d, p in zip(descriptors, points, strict=True)
    ]


def judged(views: Sequence[TrackedKeyframe]) -> Judgment:
    factors = [RelativePose(*ENDS, np.eye(4), np.eye(6))]
    return judge(POSES, views, factors, CONFIG, images=no_images, seed=0, robot="alpha")


def test_what_pairs_between_exclude_is_the_next_of_the_same_things(run: Undisturbed) -> None:
    found = judged(views_of(run, se3.inverse(PERIOD) @ T_TRUE))
    assert found.verdicts.pop(ENDS) is PairVerdict.OPEN
    assert set(found.verdicts.values()) == {PairVerdict.CONFIRMED}
    assert not found.by_features
    assert found.believes_all


@pytest.mark.parametrize(
    ("off_m", "spread", "confirmed", "repeated"),
    [
        (2.0, 1.0, COUNT - 1, {ENDS}),
        (0.1, 1.0, COUNT - 1, set()),  # by so much all pairs between may be off together
        (2.0, 0.1, COUNT - 1, set()),  # what they follow may be a thing that moves along
        (2.0, 1.0, 2, set()),  # they do not lead to the last keyframe
    ],
)
def test_pairs_between_exclude_what_they_cannot_add_up_to(
    run: Undisturbed, off_m: float, spread: float, confirmed: int, repeated: set[Ends]
) -> None:
    T_other = T_TRUE @ se3.exp(np.array([off_m, 0.0, 0.0, 0.0, 0.0, 0.0]))
    views = views_of(run, T_other, spread=spread, confirmed=confirmed)
    between = {(i, j): 0.001 for j in range(COUNT) for i in (j - 2, j - 1) if 0 <= i < confirmed}
    limits = CONFIG.keyframes.judgment
    assert of_repeated_places({ENDS: T_other}, between, POSES, views=views, config=limits) == repeated


def test_a_view_without_depth_in_its_coarsest_image_is_not_known_to_be_filled(run: Undisturbed) -> None:
    first, second = views_of(run, T_TRUE)[:2]
    T = se3.inverse(POSES[0]) @ POSES[1]
    assert fills_views(first, second, T, CONFIG.keyframes.judgment)
    coarsest = second.coarsest
    empty = replace(coarsest, inverse_depth=np.zeros_like(coarsest.inverse_depth))
    second = replace(second, coarsest=empty)
    assert not fills_views(first, second, T, CONFIG.keyframes.judgment)
