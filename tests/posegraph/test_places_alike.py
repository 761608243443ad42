"""Rooms with the same furniture: what looks different at the same place to most views that show it."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.loop_closures import KeyframePoses, consistent
from duagc.pipeline.posegraph.places_alike import MIN_PLACES, share_unlike
from duagc.pipeline.posegraph.relative_poses import LoopClosure

VIEWS = 6
T_OWN = np.array([se3.exp([0.1 * k, 0.0, 0.0, 0.0, 0.05 * k, 0.0]) for k in range(VIEWS)])
WALL = np.stack([*np.meshgrid(np.arange(-5, 6) * 0.6, np.arange(-3, 4) * 0.6, indexing="ij")], axis=-1)
POINTS = np.insert(WALL.reshape(-1, 2), 2, 3.0, axis=1) + 0.2  # 77 places on a wall 3 m ahead
SPOTS = ([0, 1, 7, 8], [35], [56, 57], [75, 76])
ALL = [place for spot in SPOTS for place in spot]


def closures(unlike: list[int], *, votes: int = VIEWS, points: np.ndarray = POINTS) -> list[LoopClosure]:
    """Loop closures that all show the same points, some of which look different to the first `votes` of them."""
    out = []
    for k, T in enumerate(T_OWN):
        alike = np.ones(len(points))
        if k < votes:
            alike[unlike] = 0
        texture = np.column_stack([se3.transform(se3.inverse(T), points), alike])
        out.append(LoopClosure(k, k, np.eye(4), 1e5 * np.eye(6), texture=texture))
    return out


def test_places_that_look_different_count_but_for_the_largest_spot() -> None:
    assert share_unlike(closures([]), T_OWN) == 0
    assert share_unlike(closures(SPOTS[0]), T_OWN) == 0
    assert share_unlike(closures(ALL), T_OWN) == pytest.approx(5 / len(POINTS))


def test_most_views_decide_and_few_places_decide_nothing() -> None:
    both = ALL
    assert share_unlike(closures(both, votes=VIEWS // 2), T_OWN) == 0
    assert share_unlike(closures(both)[:2], T_OWN[:2]) == 0
    few = POINTS[: MIN_PLACES - 1]
    assert share_unlike(closures([0, 20, 40], points=few), T_OWN) == 0
    assert share_unlike([replace(c, texture=np.zeros((0, 4))) for c in closures(both)], T_OWN) == 0


@pytest.mark.parametrize("unlike", [ALL, SPOTS[0]])
def test_robots_in_two_rooms_with_the_same_furniture_are_not_joined(unlike: list[int]) -> None:
    found = closures(unlike)
    poses = KeyframePoses(T_OWN, np.zeros((VIEWS, 2)))
    joined = consistent(found, poses, poses, LoopClosureConfig())
    if unlike == SPOTS[0]:  # one thing that changed
        assert joined.keep.all()
        return
    assert joined.T_ownmap_peermap is None
    assert joined.unlike.all()
    assert joined.reasons[0] == "6.5% of the places look different to most views, at most 6% allowed"


def test_the_other_end_of_a_loop_closure_knows_the_same_places() -> None:
    one = replace(closures([3])[1], T_own_peer=se3.exp([0.4, 0.1, 0.0, 0.0, 0.3, 0.0]))
    other = one.reversed()
    np.testing.assert_allclose(se3.transform(one.T_own_peer, other.texture[:, :3]), one.texture[:, :3])
    np.testing.assert_array_equal(other.texture[:, 3], one.texture[:, 3])
