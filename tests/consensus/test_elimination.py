"""Elimination along a tree of fronts is a step of the whole graph: nothing is lost, nothing counted twice."""

import numpy as np
import pytest

from duagc.pipeline.consensus.elimination import Front, damped, shared_variables
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.relative_poses import RelativePoses
from tests.fixtures.pose_worlds import random_information, random_poses


def scattered(seed, n=12, m=30):
    """A connected graph over n poses, far from satisfied, and which of three robots owns each pose."""
    rng = np.random.default_rng(seed)
    i = np.concatenate([np.arange(n - 1), rng.integers(n, size=m)])
    j = np.concatenate([np.arange(1, n), rng.integers(n, size=m)])
    i, j = i[i != j], j[i != j]
    factors = RelativePoses(i, j, random_poses(rng, len(i)), random_information(rng, len(i)))
    return factors, random_poses(rng, n), np.arange(n) * 3 // n


def robots_of(factors, owner):
    """By robot: its variables (owner, pose), own first, and its factors over them; a factor goes to its first end."""
    parts = {}
    for a in range(3):
        mine = factors.select(owner[factors.i] == a)
        own = np.flatnonzero(owner == a)
        copies = np.setdiff1d(np.union1d(mine.i, mine.j), own)
        poses = np.concatenate([own, copies])
        names = np.zeros(len(owner), np.int64)
        names[poses] = np.arange(len(poses))
        parts[a] = [(int(owner[p]), int(p)) for p in poses], mine.renamed(names), poses
    return parts


def ancestors(tree, robot):
    """A robot and all above it."""
    return [robot] if tree[robot] is None else [robot, *ancestors(tree, tree[robot])]


@pytest.mark.parametrize("tree", [{0: None, 1: 0, 2: 1}, {0: None, 1: 0, 2: 0}])
@pytest.mark.parametrize("damping", [0.0, 1e-2])
def test_fronts_take_the_step_of_the_whole_graph(tree, damping):
    factors, T, owner = scattered(0)
    parts = robots_of(factors, owner)
    masks = {}
    for a, (variables, _, _) in parts.items():
        for v in variables:
            masks[v] = masks.get(v, 0) | 1 << a
    subtree = {a: sum(1 << b for b in tree if a in ancestors(tree, b)) for a in tree}
    shared, fronts, H, g = {}, {}, {}, {}
    for a in (2, 1, 0):  # children first
        variables, own, poses = parts[a]
        children = [c for c in tree if tree[c] == a]
        here = {*variables, *(v for c in children for v in shared[c])}
        known = {v: masks[v] if subtree[a] >> v[0] & 1 else 0 for v in here}  # owners below say who has it
        shared[a] = shared_variables(known, subtree[a])
        fronts[a] = Front(variables, {c: shared[c] for c in children}, shared[a])
        gradient, jacobians = least_squares.gradient(own, np.ones(len(own)), T[poses])
        H_own = damped(own, jacobians, len(poses), damping=damping, anchor=0 if a == 0 else None)
        H[a] = fronts[a].factorize(H_own, {c: H[c] for c in children})
        g[a] = fronts[a].eliminate(gradient, {c: g[c] for c in children})
    assert shared[0] == []
    steps = np.full((len(T), 6), np.nan)
    down = {0: np.zeros((0, 6))}
    for a in (0, 1, 2):
        delta = fronts[a].resolve(down[a])
        for c in [c for c in tree if tree[c] == a]:
            down[c] = delta[fronts[a].child_slots[c]]
        own = delta[fronts[a].own_slots]
        for v, step in zip(parts[a][0], own, strict=True):
            if v[0] == a:
                steps[v[1]] = step
        for v, step in zip(parts[a][0], own, strict=True):  # copies move as their owners do
            if v[0] < a:
                np.testing.assert_allclose(step, steps[v[1]], rtol=1e-9, atol=1e-12)
    whole_gradient, jacobians = least_squares.gradient(factors, np.ones(len(factors)), T)
    whole = damped(factors, jacobians, len(T), damping=damping, anchor=0).toarray()
    expected = -np.linalg.solve(whole, whole_gradient.ravel()).reshape(-1, 6)
    expected -= expected[0]  # both hold pose 0, one with a stiffer spring
    np.testing.assert_allclose(steps[1:] - steps[0], expected[1:], rtol=1e-6, atol=1e-8)


def test_a_variable_stays_until_all_who_have_it_are_below():
    owners = {(0, 1): 0b011, (1, 4): 0, (1, 5): 0b111, (1, 6): 0b110}
    assert shared_variables(owners, 0b011) == [(1, 4), (1, 5), (1, 6)]
    assert shared_variables(owners, 0b111) == [(1, 4)]
