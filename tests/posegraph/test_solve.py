"""A team on the wire against the graph solved in one place, with every solver."""

import json
from functools import partial

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.posegraph import settings
from duagc.pipeline.exchange import rounds as session_rounds
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.network.packets import MAX_PACKET_BYTES, parse
from duagc.pipeline.posegraph.files import read_team_graph
from duagc.pipeline.posegraph.pose_graph import solve_pose_graph
from duagc.pipeline.team_posegraph import solve
from duagc.pipeline.team_posegraph import team as team_rounds
from duagc.pipeline.team_posegraph.agent import PoseGraphAgent
from duagc.pipeline.team_posegraph.table import format_result
from duagc.pipeline.team_posegraph.team import Traffic, meet
from tests.fixtures.commands import assert_one_line, duagc, duagc_here
from tests.fixtures.pose_graphs import g2o_line, helix, helix_edges, wild_edges, write_g2o, write_team

N = 48


@pytest.fixture
def helix_file(tmp_path):
    return write_g2o(tmp_path / "helix.g2o", helix_edges(N))


@pytest.mark.parametrize("solver", ["admm", "elimination"])
@pytest.mark.parametrize(("robots", "loss"), [(1, 0.0), (2, 0.0), (4, 0.0), (4, 0.5)])
def test_the_team_reaches_the_optimum(helix_file, solver, robots, loss):
    result = solve.solve(helix_file, settings(solver, loss=loss), robots)
    assert result["converged"]
    assert result["robots"] == robots
    assert abs(result["gap"]) < 1e-8
    assert result["components"][0]["distance_rms_m"] < 1e-4
    assert result["packets_refused"] == 0
    assert (result["packets_lost"] > 0) == (loss > 0)
    if robots > 1:
        assert result["bytes_to"]["1e-4"] <= result["bytes_to"]["1e-6"] <= result["bytes"]
        assert result["rounds_to"]["1e-6"] <= result["rounds"]
        assert result["bytes_setup"] > 0


def test_a_robot_alone_is_at_its_optimum_before_the_first_round(helix_file):
    """Nobody to wait for: what it solved by itself counts, and nothing is called `not reached`."""
    config = settings("admm", "gnc")
    result = solve.solve(helix_file, config, 1)
    assert abs(result["gap"]) < 1e-8
    assert result["components"][0]["rounds_to"] == dict.fromkeys(solve.GAPS, 0)
    assert result["components"][0]["bytes_to"] == dict.fromkeys(solve.GAPS, result["bytes_setup"])
    assert "not reached" not in format_result(result)


def test_both_solvers_end_at_the_same_poses_up_to_the_gauge(helix_file):
    costs = [solve.solve(helix_file, settings(solver), 3)["cost"] for solver in ("admm", "elimination")]
    np.testing.assert_allclose(costs[0], costs[1], rtol=1e-8)


def test_an_exact_step_is_one_exchange(helix_file):
    """Gauss-Newton from a good start needs few steps, whatever the number of robots."""
    for robots in (2, 5):
        component = solve.solve(helix_file, settings("elimination"), robots)["components"][0]
        assert component["exchanges"] <= 9


def test_matrices_in_float32_cost_half_and_reach_the_same(helix_file):
    full = solve.solve(helix_file, settings("elimination"), 4)
    config = settings("elimination").model_copy(update={"elimination_wire": "float32"})
    half = solve.solve(helix_file, config, 4)
    assert abs(half["gap"]) < 1e-8
    assert half["bytes_to"]["1e-6"] < 0.75 * full["bytes_to"]["1e-6"]


def test_the_printed_iteration_does_not_reach_the_optimum(helix_file):
    """Its multipliers make constraints of noisy closures: far behind where edge-ADMM has long arrived."""
    rounds = solve.solve(helix_file, settings("admm"), 4)["rounds"]
    paper = solve.solve(helix_file, settings("paper", max_rounds=2 * rounds), 4)
    assert not paper["converged"]
    assert paper["gap"] > 1e-3


def test_two_runs_send_the_same_packets(helix_file):
    runs = []
    for _ in range(2):
        packets = []
        team = read_team_graph(helix_file, 3)
        _, traffic, rounds = record(team, settings("admm", loss=0.3, seed=4), packets)
        runs.append((packets, traffic.bytes, rounds))
    assert runs[0] == runs[1]


def record(team, config, packets):
    """`meet`, keeping every packet that was sent."""
    carried = session_rounds.LinkModel.fate

    def fate(self, sender, receiver, *, sequence, send_ns, size):
        packets.append((sender, receiver, sequence, size))
        return carried(self, sender, receiver, sequence=sequence, send_ns=send_ns, size=size)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session_rounds.LinkModel, "fate", fate)
        return meet(team, config, lambda k, agents, traffic: None)


@pytest.mark.parametrize("solver", ["admm", "elimination", "paper"])
def test_bytes_are_those_of_real_packets_with_their_headers(helix_file, solver):
    team = read_team_graph(helix_file, 3)
    config = settings(solver, max_rounds=40)
    agents = {name: PoseGraphAgent(team.robots[name], sorted(team.robots), config) for name in team.robots}
    waiting, size, count = {name: [] for name in agents}, 0, 0
    for k in range(40):
        sent = [out for name, agent in agents.items() for out in agent.tick(k, waiting[name])]
        waiting = {name: [] for name in agents}
        for out in sent:
            assert len(out.packet) <= MAX_PACKET_BYTES
            parse(out.packet)
            waiting[out.receiver].append(out.packet)
            size, count = size + len(out.packet), count + 1
        if all(agent.done for agent in agents.values()):
            break
    seen = Traffic({})

    def watch(rounds, agents, traffic):
        seen.sent, seen.packets = dict(traffic.sent), traffic.packets

    meet(team, config, watch)
    assert (seen.bytes, seen.packets) == (size, count)


def test_an_agent_gets_its_own_graph_only(helix_file, monkeypatch):
    given = {}

    def make(part, team, config):
        given[part.name] = (part, team)
        return PoseGraphAgent(part, team, config)

    monkeypatch.setattr(team_rounds, "PoseGraphAgent", make)
    team = read_team_graph(helix_file, 4)
    meet(team, settings("admm"), lambda k, agents, traffic: None)
    for name, (graph, names) in given.items():
        assert graph is team.robots[name]
        assert names == sorted(team.robots)
        for factors in (graph.odometry, graph.loops):
            assert max(factors.i.max(initial=0), factors.j.max(initial=0)) < graph.keyframes


def test_parts_of_a_team_that_nothing_joins_get_one_result_each(tmp_path):
    rows = [(i, j, T) for i, j, T in helix_edges(N) if (i < 24) == (j < 24)]
    path = write_g2o(tmp_path / "two.g2o", rows)
    for solver in ("admm", "elimination"):
        result = solve.solve(path, settings(solver), 4)
        first, second = result["components"]
        assert (first["robots"], second["robots"]) == (["robot0", "robot1"], ["robot2", "robot3"])
        for component in (first, second):
            assert component["converged"]
            assert abs(component["gap"]) < 1e-8
        np.testing.assert_allclose(result["cost"], first["cost"] + second["cost"], rtol=1e-12)
        alone = write_g2o(tmp_path / "one.g2o", [row for row in rows if row[0] < 24])
        np.testing.assert_allclose(
            first["optimum"], solve.solve(alone, settings(solver), 2)["optimum"], rtol=1e-9
        )


@pytest.mark.parametrize("solver", ["admm", "elimination", "paper"])
def test_robots_that_never_hear_each_other_keep_their_own_optimum(helix_file, solver):
    alone = []

    def watch(rounds, agents, traffic):
        assert traffic.lost == traffic.packets
        alone[:] = [agent.T_world_keyframe for agent in agents.values()]

    team = read_team_graph(helix_file, 3)
    agents, _, rounds = meet(team, settings(solver, loss=1.0, max_rounds=12), watch)
    assert rounds == 12
    for T, agent in zip(alone, agents.values(), strict=True):
        np.testing.assert_array_equal(T, agent.graph.T_map_keyframe)
    result = solve.solve(helix_file, settings(solver, "gnc", loss=1.0, max_rounds=12), 3)
    assert not result["converged"]
    assert result["rounds_to"]["1e-4"] is None


@pytest.mark.parametrize("solver", ["admm", "elimination"])
def test_false_loops_and_closures_are_left_out(tmp_path, solver):
    rows = helix_edges(N)
    path = write_g2o(tmp_path / "measurements.g2o", rows + wild_edges(N, 8))
    numbers = "".join(
        f"<outlier_lc_indices>{k}</outlier_lc_indices>\n" for k in range(len(rows) + 1, len(rows) + 9)
    )
    (tmp_path / "gt_info.xml").write_text(numbers)
    result = solve.solve(path, settings(solver, "gnc"), 4)
    component = result["components"][0]
    assert component["reference"]["precision"] == component["reference"]["recall"] == 1.0
    assert result["converged"]
    (tmp_path / "clean").mkdir()
    clean = solve.solve(write_g2o(tmp_path / "clean" / "helix.g2o", rows), settings(solver), 4)
    np.testing.assert_allclose(result["inlier_cost"], clean["optimum"], rtol=1e-6)
    assert result["cost"] > result["inlier_cost"]


def test_the_command_on_a_teams_files(tmp_path):
    folder = write_team(tmp_path / "team", helix_edges(N), 3, N)
    done = duagc("posegraph", folder, "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert {"cost", "inlier_cost", "optimum", "rounds", "bytes", "rounds_to", "bytes_to"} <= set(result)
    assert {"bytes_raw_alternative", "converged"} <= set(result)
    assert set(result["rounds_to"]) >= {"1e-4", "1e-6"}
    assert abs(result["cost"] / result["optimum"] - 1) < 1e-6
    text = duagc_here("posegraph", folder, "--solver", "elimination").stdout
    assert "centralized optimum" in text
    assert "all agents have converged" in text
    assert "Examples" in duagc_here("posegraph", "--help").stdout


def test_the_command_refuses_in_one_line(tmp_path):
    flat = tmp_path / "flat.g2o"
    flat.write_text("VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    assert_one_line(duagc("posegraph", flat), "flat.g2o", "2-D", "expected 3-D")
    assert_one_line(duagc_here("posegraph", tmp_path / "absent.g2o"), "absent.g2o", "not found")
    path = write_g2o(tmp_path / "helix.g2o", helix_edges(N))
    assert_one_line(duagc_here("posegraph", path, "--robots", "40"), "48 poses", "40 robots")


def test_too_many_robots_are_refused_before_anything_is_solved(tmp_path, monkeypatch):
    path = write_g2o(tmp_path / "helix.g2o", helix_edges(150))
    monkeypatch.setattr(solve, "solve_pose_graph", None)
    with pytest.raises(DuagError, match=r"helix.g2o: found 70 robots, expected at most 64"):
        solve.solve(path, settings("admm"), 70)


@pytest.mark.parametrize("solver", ["admm", "elimination"])
@pytest.mark.parametrize("tree", [False, True])
def test_a_graph_without_contradictions_reaches_its_optimum(tmp_path, solver, tree):
    T = helix(40)
    pairs = [(k, k + 1) for k in range(39)] + ([] if tree else [(k, k + 8) for k in range(0, 32, 2)])
    path = write_g2o(tmp_path / "exact.g2o", [(i, j, se3.inverse(T[i]) @ T[j]) for i, j in pairs])
    result = solve.solve(path, settings(solver), 4)
    assert result["converged"]
    assert abs(result["gap"]) < 1e-2
    assert None not in (result["rounds_to"]["1e-2"], result["bytes_to"]["1e-2"])
    assert "to a gap of 1e-2            not reached" not in format_result(result)


def test_an_optimum_that_has_not_converged_is_called_so(helix_file, monkeypatch):
    result = solve.solve(helix_file, settings("elimination"), 2)
    assert result["optimum_converged"]
    assert result["components"][0]["optimum_converged"]
    assert "not converged" not in format_result(result)
    monkeypatch.setattr(solve, "solve_pose_graph", partial(solve_pose_graph, iterations=1))
    for robust in ("none", "gnc"):
        result = solve.solve(helix_file, settings("admm", robust), 2)
        assert not result["optimum_converged"]
        assert not result["components"][0]["optimum_converged"]
        assert "(not converged; gap" in format_result(result)


@pytest.mark.parametrize("robust", ["none", "gnc"])
@pytest.mark.parametrize("weights", ["tau", "kappa"])
def test_weights_that_nobody_can_solve_for_are_refused_with_the_file(tmp_path, weights, robust):
    step = se3.from_rotation_translation(so3.exp(np.array([0, 0, 0.1])), [1.0, 0, 0])
    even = {"tau": 100.0, "kappa": 100.0}
    lines = [g2o_line(k, k + 1, step, **even | {weights: (1e10, 1e-10)[k % 2]}) for k in range(12)]
    path = tmp_path / "uneven.g2o"
    path.write_text("".join(lines))
    with pytest.raises(DuagError, match=r"uneven.g2o: pose graph: .*cannot be solved for, expected"):
        solve.solve(path, settings("admm", robust), 4)


def test_a_robot_without_closures_does_not_hide_when_the_others_arrived(tmp_path):
    rows = [(i, j, T) for i, j, T in helix_edges(N) if (i < 32) == (j < 32)]
    result = solve.solve(write_g2o(tmp_path / "apart.g2o", rows), settings("admm"), 3)
    together, alone = result["components"]
    assert (together["robots"], alone["robots"]) == (["robot0", "robot1"], ["robot2"])
    assert result["rounds_to"] == together["rounds_to"]
    assert result["bytes_to"] == together["bytes_to"]
    assert None not in together["rounds_to"].values()
