"""Consensus on matched Gaussians: where the rounds end, whatever is lost, and where the paper's average ends."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.weights import Weights
from duagc.pipeline.experiments.gaussian_consensus import (
    COORDINATES,
    GaussianAgent,
    GaussianConsensusConfig,
    Shares,
    optimum,
    total_weights,
)
from duagc.pipeline.splat.information import pack_information

EDGES = {
    "full": lambda n: [(i, j) for i in range(n) for j in range(i)],
    "chain": lambda n: [(i, i - 1) for i in range(1, n)],
    "ring": lambda n: [(i, i - 1) for i in range(1, n)] + [(n - 1, 0)],
}


@dataclass
class Team:
    """Robots with evidence on tracks, and who can talk to whom."""

    linked: dict[str, list[str]]
    members: dict[str, np.ndarray]
    theta: dict[str, np.ndarray]
    weights: dict[str, Weights]
    tracks: int

    @property
    def names(self) -> list[str]:
        return sorted(self.linked)

    def optimum(self) -> tuple[np.ndarray, np.ndarray]:
        """theta* and the roots of the diagonal of the total information, [tracks, 13]."""
        weights = [self.weights[n] for n in self.names]
        rows = [self.members[n] for n in self.names]
        best = optimum([self.theta[n] for n in self.names], weights, rows, self.tracks)
        return best, np.sqrt(total_weights(weights, rows, self.tracks).diagonal())

    def agents(self, config: GaussianConsensusConfig) -> tuple[dict[str, GaussianAgent], Shares]:
        shares = Shares.of(self.members, self.linked)
        agents = {}
        for name in self.names:
            rows = shares.rows[name]
            at = np.searchsorted(rows, self.members[name])
            theta = np.zeros((len(rows), COORDINATES))
            theta[at] = self.theta[name]
            weights = Weights.of_diagonal(np.zeros((len(rows), COORDINATES)))
            for part in ("position", "shape", "color", "opacity"):
                getattr(weights, part)[at] = getattr(self.weights[name], part)
            links = {
                peer: np.searchsorted(rows, shares.shared[min(name, peer), max(name, peer)])
                for peer in self.linked[name]
            }
            agents[name] = GaussianAgent(theta, weights, links, config)
        return agents, shares


def make_team(
    topology: str, robots: int, contrast: float = 47.0, unknown: float = 0.0, seed: int = 0, tracks: int = 40
) -> Team:
    rng = np.random.default_rng(seed)
    names = [f"r{i}" for i in range(robots)]
    linked: dict[str, list[str]] = {name: [] for name in names}
    for i, j in EDGES[topology](robots):
        linked[names[i]].append(names[j])
        linked[names[j]].append(names[i])
    truth = rng.normal(size=(tracks, COORDINATES))
    theta, weights = {}, {}
    for name in names:
        diagonal = 100 * np.exp(rng.uniform(0, np.log(contrast), (tracks, COORDINATES)))
        diagonal[rng.random(tracks) < unknown] = 0
        W = Weights.of_diagonal(diagonal)
        for blocks, size in ((W.position, 3), (W.shape, 6)):
            Q = np.linalg.qr(rng.normal(size=(tracks, size, size)))[0]
            blocks[:] = Q @ blocks @ Q.swapaxes(1, 2)
        sigma = 1 / np.sqrt(np.where(diagonal > 0, W.diagonal(), 1.0))
        theta[name], weights[name] = truth + sigma * rng.normal(size=truth.shape), W
    return Team(linked, {n: np.arange(tracks) for n in names}, theta, weights, tracks)


def gap_sigma(team: Team, agents: dict[str, GaussianAgent], shares: Shares) -> float:
    best, roots = team.optimum()
    gaps = [np.abs(agents[n].x - best[shares.rows[n]]) * roots[shares.rows[n]] for n in team.names]
    return max(float(gap.max()) for gap in gaps)


def rounds_to(
    team: Team, config: GaussianConsensusConfig, sigma: float, most: int, loss: float = 0.0, delay: int = 0
) -> tuple[int, float]:
    """Rounds until no robot is farther from the optimum than so many sigma, and the gap then."""
    agents, shares = team.agents(config)
    rng = np.random.default_rng(9)
    air: list[tuple[int, int, str, str, Any]] = []
    for round_index in range(most):
        for name in team.names:
            for peer in team.linked[name]:
                for part in agents[name].outgoing(peer).parts(1150):
                    if rng.random() >= loss:
                        due = round_index + int(rng.integers(delay + 1))
                        air.append((due, len(air), peer, name, part))
        for item in sorted((i for i in air if i[0] <= round_index), key=lambda i: i[:2]):
            agents[item[2]].receive(item[3], item[4])
        air = [i for i in air if i[0] > round_index]
        for agent in agents.values():
            agent.step()
        if gap_sigma(team, agents, shares) < sigma:
            return round_index + 1, gap_sigma(team, agents, shares)
    return most, gap_sigma(team, agents, shares)


DOUBLE = GaussianConsensusConfig(wire="float64")


@pytest.mark.parametrize(
    ("topology", "robots", "most"), [("full", 2, 200), ("chain", 4, 300), ("ring", 8, 300), ("full", 4, 300)]
)
@pytest.mark.parametrize("loss", [0.0, 0.6])
def test_rounds_end_at_the_optimum(topology: str, robots: int, most: int, loss: float) -> None:
    team = make_team(topology, robots)
    rounds, gap = rounds_to(team, DOUBLE, 1e-6, int(most / (1 - loss) * 1.5), loss)
    assert gap < 1e-6, rounds


def test_late_and_overtaken_packets_do_no_harm() -> None:
    _, gap = rounds_to(make_team("chain", 3), DOUBLE, 1e-6, 2500, loss=0.3, delay=4)
    assert gap < 1e-6


def test_nothing_is_known_by_some_and_passes_through_them() -> None:
    """With the geometric mean as penalty, what is known would never get through those who know nothing."""
    team = make_team("chain", 4, unknown=0.4)
    _, gap = rounds_to(team, DOUBLE, 1e-6, 2500)
    assert gap < 1e-6


def test_the_default_wire_is_good_to_a_twentieth_sigma() -> None:
    _, gap = rounds_to(make_team("ring", 4), GaussianConsensusConfig(), 1e-9, 300)
    assert 1e-9 < gap < 0.05


def test_members_without_a_link_are_joined_by_those_between() -> None:
    """Alpha and charlie saw what bravo, between them, did not."""
    team = make_team("chain", 3)
    team.members["r1"] = np.arange(20, 40)
    team.theta["r1"], team.weights["r1"] = team.theta["r1"][20:], team.weights["r1"].take(np.arange(20, 40))
    shares = Shares.of(team.members, team.linked)
    assert np.array_equal(shares.rows["r1"], np.arange(40))
    _, gap = rounds_to(team, DOUBLE, 1e-6, 1500)
    assert gap < 1e-6


def test_shares_take_the_shortest_way_and_nobody_else() -> None:
    linked = {"a": ["b", "c"], "b": ["a", "d"], "c": ["a", "d"], "d": ["b", "c"], "e": []}
    members = {
        "a": np.array([0, 1]),
        "b": np.array([1]),
        "c": np.array([1, 2]),
        "d": np.array([0]),
        "e": np.array([2]),
    }
    shares = Shares.of(members, linked)
    held = {name: rows.tolist() for name, rows in shares.rows.items()}
    assert held == {"a": [0, 1], "b": [0, 1], "c": [1, 2], "d": [0], "e": [2]}  # a to d by b, the lower name
    assert {pair: rows.tolist() for pair, rows in shares.shared.items()} == {
        ("a", "b"): [0, 1],
        ("a", "c"): [1],
        ("b", "d"): [0],
        ("c", "d"): [],
    }


def diagonal_only(team: Team) -> Team:
    return replace(team, weights={n: Weights.of_diagonal(w.diagonal()) for n, w in team.weights.items()})


def test_the_printed_average_is_right_for_two_and_wrong_for_four() -> None:
    """(12) on weights per coordinate, as printed, against the optimum of those same weights."""
    paper = GaussianConsensusConfig(mode="paper", wire="float64")
    _, gap = rounds_to(diagonal_only(make_team("full", 2)), paper, 1e-6, 10)
    assert gap < 1e-6
    _, gap = rounds_to(diagonal_only(make_team("chain", 4)), paper, 1e-6, 1000)
    assert gap > 0.3
    _, gap = rounds_to(diagonal_only(make_team("chain", 4)), DOUBLE, 1e-6, 1000)
    assert gap < 1e-6


def test_weights_are_undone_by_their_inverse() -> None:
    rng = np.random.default_rng(1)
    L3, L6 = (np.tril(rng.normal(size=(5, n, n))) for n in (3, 6))
    packed = pack_information(
        L3 @ L3.swapaxes(1, 2), L6 @ L6.swapaxes(1, 2), rng.uniform(1, 2, (5, 3)), rng.uniform(1, 2, 5)
    )
    block = Weights.of(Evidence("a", np.arange(5), np.zeros(5, np.int32), rng.normal(size=(5, 13)), packed))
    x = rng.normal(size=(5, 13))
    assert np.allclose(block.inverse().times(block.times(x)), x)


def test_directions_that_nobody_knows_stay_out() -> None:
    W = Weights.of_diagonal(np.zeros((1, COORDINATES)))
    W.position[0] = np.diag([0.0, 4.0, 0.0])
    x = np.ones((1, COORDINATES))
    assert np.array_equal(W.inverse().times(W.times(x))[0, :3], [0, 1, 0])


def test_rounding_of_a_direction_that_nobody_knows_is_no_knowledge() -> None:
    """Of a plane that is turned, the eigenvalues along it are a few ulps instead of zero."""
    rng = np.random.default_rng(4)
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    W = Weights.of_diagonal(np.zeros((50, COORDINATES)))
    W.position[:] = 1e6 * normals[:, :, None] * normals[:, None, :]
    across = normals[:, :, None] * normals[:, None, :] / 1e6
    np.testing.assert_allclose(W.inverse().position, across, atol=1e-16)
