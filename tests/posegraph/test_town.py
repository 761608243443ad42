"""Teams with false loop closures in clusters: what is generated, and what a team makes of it."""

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.posegraph import TeamConsensusConfig, settings
from duagc.pipeline.experiments.team_graphs import generate, write
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.files import read_team_graph
from duagc.pipeline.posegraph.gnc import RobustWeights
from duagc.pipeline.team_posegraph import solve
from tests.fixtures.commands import assert_one_line, duagc_here
from tests.fixtures.full_disks import no_file_larger_than


def off_m(graph):
    """Distance (m) of every loop closure from the truth."""
    T = graph.T_world_keyframe
    true = [se3.inverse(T[a][i]) @ T[b][j] for a, i, b, j, _ in graph.closures]
    return se3.distance(np.array(true), np.array([M for *_, M in graph.closures]))[0]


def test_true_loop_closures_are_near_the_truth_and_false_ones_agree_on_something_else():
    graph = generate(3, 200, 100, 0.6, seed=1)
    true, off = np.array(graph.true), off_m(graph)
    assert len(true) == 100
    assert np.count_nonzero(~true) == 60
    assert off[true].max() < 1.0
    assert off[~true].min() > 10.0
    T, moved = graph.T_world_keyframe, []
    for k in np.flatnonzero(~true):
        a, i, b, j, M = graph.closures[k]
        moved.append(T[a][i] @ M @ se3.inverse(T[b][j]))  # where the second walk seems to be
    alike = [
        np.count_nonzero(np.linalg.norm(np.array(moved)[:, :3, 3] - m[:3, 3], axis=1) < 8) for m in moved
    ]
    assert np.median(alike) >= 4


def test_a_seed_gives_the_same_files_and_another_seed_others(tmp_path):
    texts = []
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        write(generate(2, 60, 20, 0.5, seed=seed), tmp_path / name)
        files = sorted((tmp_path / name).rglob("*.csv"))
        texts.append([file.read_bytes() for file in files])
    assert texts[0] == texts[1]
    assert texts[0] != texts[2]


def test_the_files_say_what_was_generated(tmp_path):
    graph = generate(3, 80, 40, 0.5, seed=2)
    write(graph, tmp_path / "town")
    team = read_team_graph(tmp_path / "town")
    assert [g.keyframes for g in team.robots.values()] == [80] * 3
    assert sum(len(g.odometry) for g in team.robots.values()) == 3 * 79
    truths = [*team.loops_true.values(), *team.closures_true.values()]
    assert sum(len(t) for t in truths) == 40
    assert sum(int(t.sum()) for t in truths) == 20
    with pytest.raises(DuagError, match="exists"):
        write(graph, tmp_path / "town")


def test_walks_that_meet_too_rarely_are_refused():
    with pytest.raises(DuagError, match="the walks meet for"):
        generate(2, 20, 5000, 0.0, seed=0)


def test_both_solvers_find_a_better_selection_than_the_reference(tmp_path):
    """In a small town false clusters may fit; nothing true is lost, and the truncated cost is below the truth's."""
    write(generate(3, 50, 40, 0.5, seed=0), tmp_path / "town")
    costs = []
    for solver in ("admm", "elimination"):
        result = solve.solve(tmp_path / "town", settings(solver, "gnc"))
        (component,) = result["components"]
        assert result["converged"]
        assert component["reference"]["recall"] == 1.0
        assert result["cost"] <= component["reference"]["cost_of_reference"] * (1 + 1e-9)
        costs.append(result["cost"])
    np.testing.assert_allclose(costs[0], costs[1], rtol=1e-6)


def test_the_command_makes_a_graph_that_the_other_command_reads(tmp_path):
    out = tmp_path / "town"
    options = ["--robots", "3", "--keyframes", "60", "--closures", "20", "--false", "0.5"]
    assert "3 robots, 180 keyframes, 20 loop closures, 10 of them false" in (
        duagc_here("generate-posegraph", out, *options).stdout
    )
    assert "optimum of its inliers" in duagc_here("posegraph", out, "--robust", "gnc").stdout
    assert_one_line(
        duagc_here("generate-posegraph", out, *options),
        "town: exists already; choose another path or give --force",  # the command has no --out
    )


def test_weights_are_truncated_anew_until_nothing_changes():
    config = TeamConsensusConfig(checks=5, robust_warm_up=0, robust_packets=1, robust_skip=False)
    weights = RobustWeights(np.ones(2), config)
    squared = np.array([1.0, 1e6])
    received = 0.0
    while not weights.scheduled:
        received += 1
        weights.advance(received, False, lambda: squared)
    np.testing.assert_array_equal(weights.weights, [1, 0])
    assert not weights.done
    squared = np.array([1.0, 2.0])  # others' weights have moved the second one
    assert weights.advance(received + config.check_packets, False, lambda: squared)
    np.testing.assert_array_equal(weights.weights, [1, 1])
    assert not weights.advance(received + 2 * config.check_packets, True, lambda: squared)
    assert weights.done


def test_a_table_that_finds_no_room_is_named(tmp_path):
    graph = generate(2, 10, 0, 0.0, seed=0)
    with (
        no_file_larger_than(100),
        pytest.raises(DuagError, match=r"robot0/measurements\.csv: File too large"),
    ):
        write(graph, tmp_path / "town")
    assert list(tmp_path.iterdir()) == []
