"""Cycles of three robots: they find the right one of several relative frames, and the link that contradicts them."""

import itertools
import time

import numpy as np
import pytest

from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph import cycle_consistency
from duagc.pipeline.posegraph.cycle_consistency import Proposal, place
from duagc.pipeline.posegraph.spanning_tree import spanning_tree
from tests.fixtures.pose_worlds import random_poses

NAMES = ["alpha", "bravo", "charlie", "delta"]
VARIANCE = (0.02**2, 0.01**2)


def world(seed, robots=3):
    """Map frames [4, 4] by name, the first at the origin, and a right proposal for every pair."""
    rng = np.random.default_rng(seed)
    T = dict(zip(NAMES, random_poses(rng, robots, 3.0), strict=False))
    T = {name: se3.inverse(T["alpha"]) @ pose for name, pose in T.items()}
    noise = iter(0.005 * rng.normal(size=(20, 6)))

    def right(a, b, support):
        return Proposal(support, se3.inverse(T[a]) @ T[b] @ se3.exp(next(noise)), VARIANCE, 0.6)

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
    bad = Proposal(8, good.T_a_b @ WRONG, VARIANCE, 0.6)
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
    pairs["alpha", "delta"] = [Proposal(9, pairs["alpha", "delta"][0].T_a_b @ WRONG, VARIANCE, 0.6)]
    found = place(pairs, list(T), 4.0)
    assert_placed(found, T)
    assert found.chosen["alpha", "delta"] is None
    assert (
        "bravo" in found.contradictions["alpha", "delta"]
        or "charlie" in found.contradictions["alpha", "delta"]
    )
    others = [k for pair, k in found.chosen.items() if pair != ("alpha", "delta")]
    assert others == [0] * 5


def triangle(seed, supports, agreement):
    """Three robots; alpha and charlie are wrong about each other."""
    T, right = world(seed)
    links = [("alpha", "bravo"), ("bravo", "charlie"), ("alpha", "charlie")]
    pairs = {link: [right(*link, n)] for link, n in zip(links, supports, strict=True)}
    false = pairs["alpha", "charlie"][0]
    pairs["alpha", "charlie"] = [Proposal(false.support, false.T_a_b @ WRONG, VARIANCE, agreement)]
    return T, pairs


@pytest.mark.parametrize("supports", [(5, 6, 9), (9, 4, 20)])
def test_a_false_link_with_more_closures_gives_way_to_true_ones_whose_images_agree(supports):
    T, pairs = triangle(4, supports, 0.05)
    found = place(pairs, list(T), 4.0)
    assert_placed(found, T)
    assert not found.undecided
    assert found.chosen["alpha", "charlie"] is None
    assert "off the path by bravo" in found.contradictions["alpha", "charlie"]


@pytest.mark.parametrize("supports", [(5, 5, 5), (5, 6, 9), (3, 4, 9), (4, 4, 64)])
def test_where_images_agree_everywhere_no_link_of_a_cycle_that_does_not_close_counts(supports):
    T, pairs = triangle(5, supports, 0.6)
    found = place(pairs, list(T), 4.0)
    assert set(found.undecided) == set(pairs)
    weight = 0.6 * supports[2] ** 0.5
    assert all(f"alpha-charlie {weight:.2f}" in reason for reason in found.undecided.values())


def test_links_that_another_cycle_confirms_are_not_in_doubt():
    T, right = world(6, robots=4)
    pairs = {(a, b): [right(a, b, 3)] for a, b in itertools.combinations(T, 2)}
    pairs["alpha", "delta"] = [Proposal(9, pairs["alpha", "delta"][0].T_a_b @ WRONG, VARIANCE, 0.6)]
    found = place(pairs, list(T), 4.0)
    assert_placed(found, T)
    assert not found.undecided


def test_without_a_cycle_the_largest_group_counts():
    T, right = world(2)
    pairs = {("alpha", "bravo"): [right("alpha", "bravo", 4), Proposal(2, WRONG, VARIANCE, 0.6)]}
    found = place(pairs, list(T), 4.0)
    assert found.chosen == {("alpha", "bravo"): 0}
    assert np.array_equal(found.T_world_map["charlie"], np.eye(4))  # no robot met it


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_the_order_of_what_arrived_changes_no_bit(order):
    T, right = world(3)
    links = [
        (("alpha", "bravo"), [right("alpha", "bravo", 4)]),
        (("alpha", "charlie"), [right("alpha", "charlie", 4), Proposal(2, WRONG, VARIANCE, 0.6)]),
        (("bravo", "charlie"), [right("bravo", "charlie", 4)]),
    ]
    first = place(dict(links), list(T), 4.0)
    again = place(dict(links[k] for k in order), list(T), 4.0)
    for name in T:
        assert np.array_equal(first.T_world_map[name], again.T_world_map[name])
    assert first.chosen == again.chosen


def linked_team(seed, robots, most=3):
    """Proposals of all pairs of a team, half of the links with false ones too."""
    rng = np.random.default_rng(seed)
    T = dict(zip([f"r{k:02}" for k in range(robots)], random_poses(rng, robots, 3.0), strict=True))
    pairs = {}
    for a, b in itertools.combinations(T, 2):
        wrong = rng.integers(2, size=int(rng.integers(1, most + 1)))
        off = [WRONG if k else se3.exp(0.03 * rng.normal(size=6)) for k in wrong]
        supports = rng.integers(2, 20, len(off)).tolist()
        pairs[a, b] = [
            Proposal(n, se3.inverse(T[a]) @ T[b] @ d, VARIANCE, 0.6)
            for n, d in zip(supports, off, strict=True)
        ]
    return T, pairs


def test_all_detours_at_once_are_those_one_by_one():
    T, pairs = linked_team(7, 6)
    del pairs["r01", "r04"]
    links = pairs | {(b, a): [p.reversed() for p in proposals] for (a, b), proposals in pairs.items()}
    detours = cycle_consistency._all_detours(pairs, 1.0)
    cycles = {}
    for (a, b), proposals in pairs.items():
        scores = np.array([p.weight for p in proposals])
        for c in sorted(T):
            if {(a, c), (c, b)} <= set(links):
                confirmed = np.zeros(len(proposals))
                for first, second in itertools.product(links[a, c], links[c, b]):
                    for k, direct in enumerate(proposals):
                        around = first.T_a_b @ second.T_a_b @ se3.inverse(direct.T_a_b)
                        if cycle_consistency._closes(around, 3 * np.array(VARIANCE), 1.0):
                            confirmed[k] = max(confirmed[k], min(first.weight, second.weight))
                scores += confirmed
                if a < c < b:
                    cycles[a, c, b] = bool(confirmed.any())
        assert cycle_consistency._scores(proposals, detours[a, b]).tolist() == scores.tolist()
    found = {(a, b, c): closed for ((a, b), (_, c), _), closed in cycle_consistency._cycles(detours).items()}
    assert found == cycles
    assert 0 < sum(cycles.values()) < len(cycles) == 16


def test_a_team_of_two_dozen_robots_that_all_met_is_placed_in_little_time():
    T, pairs = linked_team(8, 24)
    began = time.process_time()
    found = place(pairs, list(T), 4.0)
    assert time.process_time() - began < 1.5  # cycle by cycle it is 3 s
    assert len(found.T_world_map) == 24


def test_the_tree_grows_along_the_best_supported_link_of_its_border():
    rng = np.random.default_rng(9)
    for _ in range(200):
        robots = [f"r{k}" for k in rng.permutation(int(rng.integers(1, 9)))]
        links = [link for link in itertools.combinations(robots, 2) if rng.random() < 0.5]
        support = {link: float(rng.integers(4)) for link in links}
        parent = spanning_tree(support, robots)
        joined = set()
        for robot, nearer in parent.items():
            ends = [(e, n) for link, n in support.items() for e in (link, link[::-1])]
            border = [(-n, (a, b)) for (a, b), n in ends if a in joined and b not in joined]
            expected = min(border)[1] if border else (None, min(set(robots) - joined))
            assert (nearer, robot) == expected
            joined.add(robot)


def test_a_proposal_from_the_other_side_undoes_it():
    T = random_poses(np.random.default_rng(9), 1)[0]
    back = Proposal(4, T, VARIANCE, 0.6).reversed()
    np.testing.assert_allclose(back.T_a_b @ T, np.eye(4), atol=1e-12)
    assert (back.support, back.variance, back.agreement) == (4, VARIANCE, 0.6)
