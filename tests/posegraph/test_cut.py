"""One graph cut among robots: every part is connected, and consecutive blocks are kept where they are."""

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.posegraph import settings
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.cut import owners, spanning_forest
from duagc.pipeline.posegraph.files import read_team_graph
from duagc.pipeline.team_posegraph import solve
from tests.fixtures.pose_graphs import helix_edges, write_g2o


def comb(teeth, length):
    """Chains whose first poses are joined: blocks of consecutive keys fall to pieces."""
    chains = [(t * length + k, t * length + k + 1) for t in range(teeth) for k in range(length - 1)]
    return chains + [(t * length, (t + 1) * length) for t in range(teeth - 1)]


def random_graph(seed, n):
    """Connected, with keys in no order."""
    rng = np.random.default_rng(seed)
    name = rng.permutation(n).tolist()
    tree = [(name[int(rng.integers(k))], name[k]) for k in range(1, n)]
    return tree + [tuple(rng.choice(n, 2, replace=False).tolist()) for _ in range(n // 4)]


def pieces(owner, edges, robot):
    members = [k for k, a in enumerate(owner) if a == robot]
    at = {k: position for position, k in enumerate(members)}
    own = [(at[i], at[j]) for i, j in edges if i in at and j in at]
    return len(set(spanning_forest(len(members), own)[1].tolist()))


@pytest.mark.parametrize("robots", [1, 2, 3, 5])
@pytest.mark.parametrize("edges", [comb(6, 10), *(random_graph(seed, 60) for seed in range(3))])
def test_every_part_is_connected_and_no_pose_is_lost(edges, robots):
    owner = owners(60, edges, robots, "graph")
    assert sorted(set(owner)) == list(range(robots))
    assert [owner.index(robot) for robot in range(robots)] == sorted(owner.index(r) for r in range(robots))
    assert all(pieces(owner, edges, robot) == 1 for robot in range(robots))


def test_parts_of_a_comb_are_about_equal():
    owner = owners(100, comb(10, 10), 4, "graph")
    sizes = np.bincount(owner)
    assert sizes.min() >= 20
    assert sizes.max() <= 30


def test_connected_blocks_stay_blocks():
    edges = [(k, k + 1) for k in range(39)] + [(0, 30)]
    assert owners(40, edges, 4, "graph") == [k // 10 for k in range(40)]


def test_pieces_that_nothing_joins_share_the_robots():
    edges = [(k, k + 1) for k in range(29)] + [(30, 31), (32, 33), (31, 33)]
    owner = owners(34, edges, 3, "graph")
    assert set(owner[30:]) == {2}
    assert sorted(np.bincount(owner[:30]).tolist()) == [15, 15]
    with pytest.raises(DuagError, match="falls into 2 pieces"):
        owners(34, edges, 1, "graph")


def test_edges_of_a_part_are_odometry_only_where_keys_are_consecutive(tmp_path):
    """In a part of two teeth of a comb, the end of one stands before the begin of the other: no odometry."""
    T = [se3.exp([k % 10, k // 10, 0, 0, 0, 0.1 * k]) for k in range(40)]
    edges = [*comb(4, 10), (9, 30), (19, 20)]
    rows = [(i, j, se3.inverse(T[i]) @ T[j]) for i, j in edges]
    path = write_g2o(tmp_path / "comb.g2o", rows)
    team = read_team_graph(path, 3)
    inside = sum(len(g.odometry) + len(g.loops) for g in team.robots.values())
    between = sum(len(team.robots[a].closures[b]) for a, b in team.pairs)
    assert inside + between == len(rows)
    assert all(
        len(g.odometry) == g.keyframes - 1 for g in team.robots.values()
    )  # what ties is trusted, no more
    result = solve.solve(path, settings("admm"), 3)
    assert result["converged"]
    assert result["cost"] < 1e-9


def test_a_cut_along_the_graph_reaches_the_same_optimum(tmp_path):
    """The helix with its poses renamed, so that blocks of consecutive names are not connected."""
    rows = helix_edges(48)
    name = [(k * 7) % 48 for k in range(48)]
    renamed = write_g2o(tmp_path / "renamed.g2o", [(name[i], name[j], T) for i, j, T in rows])
    plain = write_g2o(tmp_path / "plain.g2o", rows)
    results = [solve.solve(path, settings("admm"), 4) for path in (renamed, plain)]
    assert results[0]["converged"]
    np.testing.assert_allclose(results[0]["cost"], results[1]["optimum"], rtol=1e-8)
