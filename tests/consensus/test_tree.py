"""Nodes of a tree of robots that hand each other blocks and steps: far starts, wrong measurements, when they end."""

import numpy as np
import pytest

from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.elimination import BackSubstitution
from duagc.pipeline.consensus.tree import TreeGraph, TreeNode, TreePlace
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.gnc import RobustWeights
from duagc.pipeline.posegraph.pose_graph import solve_pose_graph
from duagc.pipeline.posegraph.relative_poses import RelativePoses
from tests.consensus.test_elimination import robots_of
from tests.fixtures.pose_worlds import from_first, random_poses

CHAIN = {0: None, 1: 0, 2: 1}
STAR = {0: None, 1: 0, 2: 0}
TOLERANCE = 1e-6
PLAIN = PoseConsensusConfig(robust=False)


def ring(seed, far_rad, n=12, sigma=0.01):
    """Poses along a ring with chords, measured well; where they start; which of three robots owns each."""
    rng = np.random.default_rng(seed)
    true = random_poses(rng, n)
    i = np.concatenate([np.arange(n), rng.integers(n, size=n)])
    j = np.concatenate([np.roll(np.arange(n), -1), rng.integers(n, size=n)])
    i, j = i[i != j], j[i != j]
    measured = se3.inverse(true[i]) @ true[j] @ se3.exp(sigma * rng.normal(size=(len(i), 6)))
    factors = RelativePoses(i, j, measured, np.tile(np.eye(6) / sigma**2, (len(i), 1, 1)))
    start = true @ se3.exp(far_rad * rng.normal(size=(n, 6)))
    return factors, start, np.arange(n) * 3 // n


def with_wrong_one(factors, owner):
    """The same with one wrong factor of the last robot, and its place."""
    far = (owner[factors.i] == 2) & (np.abs(factors.i - factors.j) > 1)
    wrong, T_i_j = int(np.flatnonzero(far)[0]), factors.T_i_j.copy()
    T_i_j[wrong] = T_i_j[wrong] @ se3.exp(np.array([1.0, 0, 0, 0, 0, 1.0]))
    return RelativePoses(factors.i, factors.j, T_i_j, factors.information), wrong


class Team:
    """Three nodes, and what they said of their costs and steps after every exchange."""

    def __init__(self, factors, start, owner, tree, *, config=PLAIN, robust=False, unweighted=None):
        parts = robots_of(factors, owner)
        masks = {}
        for a, (variables, _, _) in parts.items():
            for v in variables:
                masks[v] = masks.get(v, 0) | 1 << a
        self.factors, self.nodes, self.groups, self.poses = factors, {}, {}, {}
        for a, (variables, own, poses) in parts.items():
            shared = {v: masks[v] if v[0] == a else 0 for v in variables if masks[v] != 1 << a}
            groups = []
            if robust:  # all factors of the robot may be wrong, but those along the path
                along = np.abs(poses[own.i] - poses[own.j]) == 1
                group = own.select(~along)
                ends = zip(poses[group.i].tolist(), poses[group.j].tolist(), strict=True)
                first = np.array([float(pair != unweighted) for pair in ends])
                groups, own = [(group, RobustWeights(first, config))], own.select(along)
                self.groups[a] = poses[group.i], poses[group.j], groups[0][1]
            graph = TreeGraph(variables, start[poses], shared, own, groups)
            self.nodes[a] = TreeNode(TreePlace.of(a, tree), graph, config, TOLERANCE)
            self.poses[a] = poses
        self.n, self.owner = len(start), owner
        self.blocks = []  # sender, exchange, matrix of every block
        self.seen = lambda: None

    def talk(self, most):
        """Until all have finished; the cost before every exchange, and the largest step of any robot before it."""
        costs, steps, said = [], [], -1
        for _ in range(most):
            for node in self.nodes.values():
                node.advance()
            exchanges = {node.exchange for node in self.nodes.values()}
            if len(exchanges) == 1 and exchanges != {said}:
                (said,) = exchanges
                costs.append(sum(node.cost for node in self.nodes.values()))
                self.seen()
                steps.append(max(node.largest_step for node in self.nodes.values()))
            for a, node in self.nodes.items():
                for to, message in node.outbox:
                    self._hand(a, self.nodes[to], message)
                node.outbox.clear()
            if all(node.finished for node in self.nodes.values()):
                return costs, steps
        raise AssertionError(f"not finished after {most} turns")

    def _hand(self, sender, node, message):
        if isinstance(message, BackSubstitution):
            node.take_step(sender, message)
        elif isinstance(message, dict):
            node.take_front(sender, message)
        else:
            self.blocks.append((sender, message[0], message[1].H))
            node.take_block(sender, *message)

    def result(self):
        T = np.full((self.n, 4, 4), np.nan)
        for a, node in self.nodes.items():
            own = self.owner[self.poses[a]] == a
            T[self.poses[a][own]] = node.poses[own]
        return T


def slope(factors, T, weights=None):
    """Largest component of the gradient in units of the root of the information."""
    g, _ = least_squares.gradient(factors, np.ones(len(factors)) if weights is None else weights, T)
    return np.abs(g).max() / np.sqrt(factors.information.max())


@pytest.mark.parametrize("tree", [CHAIN, STAR])
@pytest.mark.parametrize("seed", [0, 1, 6, 7])
def test_from_far_away_too_the_team_ends_at_a_minimum(tree, seed):
    """Undamped steps would raise the cost from there; then all robots go back, and a damped one is tried."""
    factors, start, owner = ring(seed, far_rad=1.0)
    team = Team(factors, start, owner, tree)
    team.talk(400)
    T = team.result()
    before = least_squares.cost(factors, start)
    assert least_squares.cost(factors, T) < before
    assert slope(factors, T) < 1e-2  # of some hundred at the start
    central = solve_pose_graph(factors, start)
    assert central.converged
    assert least_squares.cost(factors, T) == pytest.approx(central.cost, rel=1e-6)
    np.testing.assert_allclose(from_first(T), from_first(central.poses), atol=1e-6)


def test_robots_move_alike_and_no_exchange_keeps_a_higher_cost():
    factors, start, owner = ring(0, far_rad=1.0)
    team = Team(factors, start, owner, CHAIN)
    costs, _ = team.talk(400)
    rises = np.flatnonzero(np.diff(costs) > 1e-9 * costs[0])
    assert len(rises)  # some step was too long ...
    for k in rises:
        assert costs[k + 2] == pytest.approx(costs[k], rel=1e-9)  # ... and was taken back
    for a, node in team.nodes.items():
        np.testing.assert_allclose(node.poses, team.result()[team.poses[a]], atol=1e-9)


def path(turn_rad, n=12):
    """Poses along a path without a loop, all at their places but those of the last robot, which are turned."""
    rng = np.random.default_rng(3)
    true, i = random_poses(rng, n), np.arange(n - 1)
    factors = RelativePoses(
        i, i + 1, se3.inverse(true[i]) @ true[i + 1], np.tile(1e4 * np.eye(6), (n - 1, 1, 1))
    )
    start, owner = true.copy(), np.arange(n) * 3 // n
    start[owner == 2] = start[owner == 2] @ se3.exp(np.array([0.1, 0, 0, 0, turn_rad, 0]))
    return factors, start, owner


@pytest.mark.parametrize("tree", [CHAIN, STAR])
def test_they_end_when_no_robot_moves_any_more(tree):
    """Only the last robot of the tree has anything to move; the root never does."""
    team = Team(*path(0.3), tree)
    root_steps = []
    team.seen = lambda: root_steps.append(team.nodes[0].largest_step)
    _, steps = team.talk(400)
    assert max(root_steps) < TOLERANCE
    assert steps[1] > 0.1
    assert steps[-1] < TOLERANCE
    assert steps[-2] > TOLERANCE


def test_what_is_new_below_goes_up_though_nothing_moves_here():
    team = Team(*path(0.3), CHAIN)
    team.talk(400)
    brought = {sender: {e for s, e, H in team.blocks if s == sender and H is not None} for sender in (1, 2)}
    assert len(brought[2]) > 2
    assert brought[2] <= brought[1]
    assert team.nodes[1].factorizations == len(brought[1])


def test_matrices_that_have_become_too_old_are_made_anew():
    """However far robots may turn before: steps that shrink too slowly show it."""
    factors, start, owner = ring(3, far_rad=0.05)
    config = PLAIN.model_copy(update={"relinearize_rad": 100.0})
    _, steps = Team(factors, start, owner, CHAIN, config=config).talk(400)
    assert len(steps) < 15  # more than a hundred with the first matrices


def test_they_wait_for_weights_below_that_are_not_final():
    """All poses are where they belong, and the wrong factor of the last robot has no weight from the start on."""
    factors, start, owner = ring(5, far_rad=0.0, sigma=1e-6)
    factors, wrong = with_wrong_one(factors, owner)
    ends = int(factors.i[wrong]), int(factors.j[wrong])
    team = Team(factors, start, owner, CHAIN, config=PoseConsensusConfig(), robust=True, unweighted=ends)
    team.talk(400)
    assert all(robust.done for _, _, robust in team.groups.values())


@pytest.mark.parametrize("tree", [CHAIN, STAR])
def test_they_end_when_all_weights_are_final_and_what_is_wrong_counts_for_nothing(tree):
    factors, start, owner = ring(5, far_rad=0.02)
    factors, wrong = with_wrong_one(factors, owner)
    team = Team(factors, start, owner, tree, config=PoseConsensusConfig(), robust=True)
    team.talk(400)
    assert all(robust.done for _, _, robust in team.groups.values())
    weights = np.ones(len(factors))
    for i, j, robust in team.groups.values():
        for first, second, weight in zip(i, j, robust.weights, strict=True):
            weights[(factors.i == first) & (factors.j == second)] = weight
    np.testing.assert_array_equal(np.flatnonzero(weights == 0), [wrong])
    assert slope(factors, team.result(), weights) < 1e-2
