"""Loop closures that follow something that moved, by views that show two motions."""

from collections.abc import Sequence

import numpy as np

from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.loop_closures import KeyframePoses
from duagc.pipeline.posegraph.moved_things import TwoMotions, following_moved_things
from duagc.pipeline.posegraph.relative_poses import LoopClosure

PLACE, THING = se3.exp([1.0, 0.2, 0, 0, 0.3, 0]), se3.exp([1.4, 0.2, 0, 0, 0.3, 0])
KEYFRAMES = np.array([se3.exp([0.1 * k, 0, 0.05 * k, 0, 0.02 * k, 0]) for k in range(12)])
POSES = KeyframePoses(KEYFRAMES, np.zeros((12, 2)))


def closures(first: int, last: int, T_ownmap_peermap: np.ndarray) -> list[LoopClosure]:
    """Loop closures of keyframes with those of the same numbers."""
    return [
        LoopClosure(
            k,
            k,
            se3.inverse(KEYFRAMES[k]) @ T_ownmap_peermap @ KEYFRAMES[k],
            np.diag([1e4] * 3 + [1e5] * 3),
        )
        for k in range(first, last)
    ]


def following(
    held: list[LoopClosure], shown: list[TwoMotions], tentative: Sequence[LoopClosure] = ()
) -> dict[int, float]:
    return following_moved_things(held, tentative, shown, own=POSES, peer=POSES, config=LoopClosureConfig())


def two(first: int, last: int, T_place: np.ndarray, T_thing: np.ndarray) -> list[TwoMotions]:
    """Views that show two motions."""
    motions = zip(closures(first, last, T_place), closures(first, last, T_thing), strict=True)
    return [TwoMotions(place, thing) for place, thing in motions]


def test_where_the_place_is_known_what_follows_the_thing_is_that_far_off() -> None:
    held = [*closures(0, 2, PLACE), *closures(2, 7, THING)]
    found = following(held, two(0, 2, PLACE, THING))
    assert sorted(found) == [2, 3, 4, 5, 6]
    assert np.allclose(list(found.values()), se3.distance(PLACE, THING)[0])


def test_the_place_may_be_known_by_features_alone() -> None:
    """Registration confirmed no loop closure of the place, and eight that follow the thing."""
    assert sorted(following(closures(0, 8, THING), two(8, 10, PLACE, THING))) == list(range(8))


def test_one_view_of_both_suffices_where_features_of_others_agree_with_it() -> None:
    """Without them nothing is known: one motion alone is no group."""
    held, shown = closures(0, 5, THING), two(5, 6, PLACE, THING)
    assert following(held, shown) == {}
    assert sorted(following(held, shown, closures(6, 9, PLACE))) == list(range(5))


def test_features_of_two_motions_that_agree_with_no_others_decide_nothing() -> None:
    elsewhere = [se3.exp([0.0, 2.0 + k, 0, 0, 0, 0.3 * k]) for k in range(2)]
    shown = [*two(8, 9, elsewhere[0], elsewhere[1]), *two(9, 10, PLACE, elsewhere[0])]
    assert following(closures(0, 8, PLACE), shown) == {}


def test_without_views_of_two_motions_nothing_is_known() -> None:
    assert following([*closures(0, 3, PLACE), *closures(3, 8, THING)], []) == {}
