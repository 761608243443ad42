"""Cycles of three robots: they find the right one of several relative frames, and the link that contradicts them."""

import itertools

import numpy as np
import pytest

from pipeline.consensus.cycles import Proposal, place
from pipeline.geometry import se3
from tests.consensus.worlds import random_poses

NAMES = ["alpha", "bravo", "charlie", "delta"]
VARIANCE = (0.02**2, 0.01**2)


def world(seed, robots=3):
    """Map frames [4, 4] by name, the first at the origin, and a right proposal for every pair."""
    rng = np.random.default_rng(seed)
    T = dict(zip(NAMES, random_poses(rng, robots, 3.0), strict=False))
    T = {name: se3.inverse(T["alpha"]) @ pose for name, pose in T.items()}
    noise = iter(0.005 * rng.normal(size=(20, 6)))

    def right(a, b, support):
        return Proposal(support, se3.inverse(T[a]) @ T[b] @ se3.exp(next(noise)), VARIANCE)

    return T, right


WRONG = se3.exp([1.0, 0.5, 0.0, 0.0, 0.0, 0.7])


def assert_placed(found, T):
    for name, pose in T.items():
        distance_m, angle_rad = se3.distance(found.T_world_map[name], pose)
        assert distance_m < 0.3
        assert angle_rad < 0.1


def test_a_smaller_group_that_closes_the_cycle_wins():
    """Alpha and charlie have more closures that agree on a wrong place than on the right one."""
    T, right = world(0)
    good = right("alpha", "charlie", 3)
    bad = Proposal(8, good.T_a_b @ WRONG, VARIANCE)
    pairs = {
        ("alpha", "bravo"): [right("alpha", "bravo", 6)],
        ("bravo", "charlie"): [right("bravo", "charlie", 6)],
        ("alpha", "charlie"): [bad, good],
    }
    found = place(pairs, list(T), 4.0)
    assert_placed(found, T)
    assert found.chosen["alpha", "charlie"] == 1
    assert not found.contradictions


def test_a_wrong_link_that_is_the_best_supported_one_is_outvoted_by_cycles():
    """Four robots: the links that close cycles place delta, not the one with most closures of its own."""
    T, right = world(1, robots=4)
    pairs = {(a, b): [right(a, b, 5)] for a, b in itertools.combinations(T, 2)}
    pairs["alpha", "delta"] = [Proposal(9, pairs["alpha", "delta"][0].T_a_b @ WRONG, VARIANCE)]
    found = place(pairs, list(T), 4.0)
    assert_placed(found, T)
    assert found.chosen["alpha", "delta"] is None
    assert (
        "bravo" in found.contradictions["alpha", "delta"]
        or "charlie" in found.contradictions["alpha", "delta"]
    )
    others = [k for pair, k in found.chosen.items() if pair != ("alpha", "delta")]
    assert others == [0] * 5


def test_without_a_cycle_the_largest_group_counts():
    T, right = world(2)
    pairs = {("alpha", "bravo"): [right("alpha", "bravo", 4), Proposal(2, WRONG, VARIANCE)]}
    found = place(pairs, list(T), 4.0)
    assert found.chosen == {("alpha", "bravo"): 0}
    assert np.array_equal(found.T_world_map["charlie"], np.eye(4))  # nobody met it


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_the_order_of_what_arrived_changes_no_bit(order):
    T, right = world(3)
    links = [
        (("alpha", "bravo"), [right("alpha", "bravo", 4)]),
        (("alpha", "charlie"), [right("alpha", "charlie", 4), Proposal(2, WRONG, VARIANCE)]),
        (("bravo", "charlie"), [right("bravo", "charlie", 4)]),
    ]
    first = place(dict(links), list(T), 4.0)
    again = place(dict(links[k] for k in order), list(T), 4.0)
    for name in T:
        assert np.array_equal(first.T_world_map[name], again.T_world_map[name])
    assert first.chosen == again.chosen
