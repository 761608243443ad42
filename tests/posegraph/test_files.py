"""Readers of public pose graphs: who gets what, and what is refused in one line."""

import numpy as np
import pytest

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.posegraph import GivenLoopClosureConfig, settings
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.edges import KIMERA_COLUMNS, read_g2o, read_kimera
from duagc.pipeline.posegraph.files import read_team_graph
from duagc.pipeline.posegraph.pose_graph import PoseGraph
from duagc.pipeline.posegraph.relative_poses import HeldLoopClosures, RelativePoses
from duagc.pipeline.team_posegraph.solve import solve
from tests.fixtures.pose_graphs import KAPPA, TAU, g2o_line, helix, helix_edges, symbol, write_g2o, write_team

EXACT = GivenLoopClosureConfig()


def team_cost(team, T_by_robot):
    """Cost of the measurements of all robots, each loop closure once."""
    own = {r: RelativePoses.concatenate([g.odometry, g.loops]) for r, g in team.robots.items()}
    pairs = [(a, b, team.robots[a].closures[b]) for a, b in team.pairs]
    closures = [HeldLoopClosures(a, b, held, np.ones(len(held))) for a, b, held in pairs]
    whole = PoseGraph.of_team(T_by_robot, own, closures, EXACT)
    return least_squares.cost(whole.relative_poses, whole.T_start), len(whole.relative_poses)


def chordal_cost(rows, T):
    """SE-Sync's cost, written down independently."""
    total = 0.0
    for i, j, M in rows:
        turned = T[j][:3, :3] - T[i][:3, :3] @ M[:3, :3]
        moved = T[j][:3, 3] - T[i][:3, 3] - T[i][:3, :3] @ M[:3, 3]
        total += KAPPA * (turned**2).sum() + TAU * (moved**2).sum()
    return total


@pytest.mark.parametrize("robots", [1, 3, 5])
def test_no_factor_is_lost_however_a_graph_is_cut(tmp_path, robots):
    rows, T = helix_edges(40), helix(40)
    team = read_team_graph(write_g2o(tmp_path / "helix.g2o", rows), robots)
    assert len(team.robots) == robots
    sizes = [g.keyframes for g in team.robots.values()]
    assert sum(sizes) == 40
    assert max(sizes) - min(sizes) <= 1
    first = np.cumsum([0, *sizes])
    cost, count = team_cost(team, {r: T[first[k] : first[k + 1]] for k, r in enumerate(team.robots)})
    assert count == len(rows)
    np.testing.assert_allclose(cost, chordal_cost(rows, T), rtol=1e-12)


def test_a_teams_files_say_the_same_as_one_file_that_is_cut(tmp_path):
    rows, T = helix_edges(40), helix(40)
    cut = read_team_graph(write_g2o(tmp_path / "helix.g2o", rows), 4)
    team = read_team_graph(write_team(tmp_path / "team", rows, 4, 40))
    assert list(team.robots) == ["a", "b", "c", "d"]
    costs = [team_cost(t, {r: T[10 * k : 10 * k + 10] for k, r in enumerate(t.robots)}) for t in (cut, team)]
    assert costs[0] == costs[1]


def test_both_ends_know_the_same_closures(tmp_path):
    team = read_team_graph(write_g2o(tmp_path / "helix.g2o", helix_edges(40)), 4)
    assert team.pairs
    for a, b in team.pairs:
        for one, other in zip(team.robots[a].closures[b], team.robots[b].closures[a], strict=True):
            back = other.reversed()
            assert (one.own_keyframe, one.peer_keyframe) == (back.own_keyframe, back.peer_keyframe)
            assert one.measured_from_peer == back.measured_from_peer
            np.testing.assert_allclose(one.T_own_peer, back.T_own_peer, atol=1e-15)


def test_consecutive_keyframes_are_odometry_and_the_rest_is_not(tmp_path):
    team = read_team_graph(write_g2o(tmp_path / "helix.g2o", helix_edges(40)), 2)
    for graph in team.robots.values():
        assert np.all(np.abs(graph.odometry.j - graph.odometry.i) == 1)
        assert np.all(np.abs(graph.loops.j - graph.loops.i) == 8)


def test_a_loop_that_alone_holds_a_robot_together_is_trusted(tmp_path):
    rows = [row for row in helix_edges(16) if row[:2] != (11, 12)]
    team = read_team_graph(write_g2o(tmp_path / "gap.g2o", rows), 1)
    (graph,) = team.robots.values()
    assert (4, 12) in zip(graph.odometry.i.tolist(), graph.odometry.j.tolist(), strict=True)
    assert len(graph.odometry) + len(graph.loops) == len(rows)


def write_kimera(folder):
    """Tables of two robots, and the edges of both."""
    rows, owner = helix_edges(20), [0] * 10 + [1] * 10
    head = "robot_src,pose_src,robot_dst,pose_dst,qx,qy,qz,qw,tx,ty,tz,kappa,tau,is_known_inlier,weight\n"
    for a in range(2):
        (folder / f"robot{a}").mkdir()
        lines = [head]
        for i, j, T in rows:
            if a in (owner[i], owner[j]):
                quat = g2o_line(i, j, T).split()[6:10]
                pose = ",".join([*quat, *(repr(float(x)) for x in T[:3, 3])])
                lines.append(f"{owner[i]},{i},{owner[j]},{j},{pose},{KAPPA},{TAU},0,0.5\n")
        (folder / f"robot{a}" / "measurements.csv").write_text("".join(lines))
    return rows, owner


REFERENCE_HEAD = "robot_src,pose_src,robot_dst,pose_dst,inlier\n"


def test_kimera_tables_with_their_reference(tmp_path):
    rows, owner = write_kimera(tmp_path)
    flags = [f"{owner[i]},{i},{owner[j]},{j},{int(i != 4)}\n" for i, j, _ in rows if j - i > 1]
    (tmp_path / "reference_inliers.csv").write_text(REFERENCE_HEAD + "".join(flags))
    team, T = read_team_graph(tmp_path), helix(20)
    cost, count = team_cost(team, {"robot0": T[:10], "robot1": T[10:]})
    assert count == len(rows)
    np.testing.assert_allclose(cost, chordal_cost(rows, T), rtol=1e-9)
    false = [
        (c.own_keyframe, c.peer_keyframe)
        for c, true in zip(
            team.robots["robot0"].closures["robot1"], team.closures_true["robot0", "robot1"], strict=True
        )
        if not true
    ]
    assert false == [(9, 0), (4, 2)]  # the first is not named by the reference at all
    without = read_team_graph(tmp_path, only_reference=True)
    assert team_cost(without, {"robot0": T[:10], "robot1": T[10:]})[1] == count - 2


def truths(team):
    """What the reference says of every loop and loop closure."""
    parts = [*team.loops_true.items(), *team.closures_true.items()]
    return {name: part.tolist() for name, part in parts}


def test_a_reference_may_name_an_edge_from_its_other_end(tmp_path):
    rows, owner = write_kimera(tmp_path)
    found = []
    for turned in (False, True):
        pairs = [((j, i) if turned else (i, j), int(i != 4)) for i, j, _ in rows if j - i > 1]
        flags = [f"{owner[a]},{a},{owner[b]},{b},{flag}\n" for (a, b), flag in pairs]
        (tmp_path / "reference_inliers.csv").write_text(REFERENCE_HEAD + "".join(flags))
        found.append(truths(read_team_graph(tmp_path)))
    assert found[0] == found[1]
    assert sum(sum(part) for part in found[1].values()) == len(flags) - 1


def test_the_reference_of_another_graph_is_refused(tmp_path):
    write_kimera(tmp_path)
    reference = tmp_path / "reference_inliers.csv"
    for text in ("2,0,3,8,1\n", "2,0,3,8,0\n", "0,0,0,8,0\n2,0,3,8,1\n"):
        reference.write_text(REFERENCE_HEAD + text)
        with pytest.raises(
            DuagError, match=r"reference_inliers.csv: found 1 edges.*robot2 0 to robot3 8.*none"
        ):
            read_team_graph(tmp_path)
    reference.write_text(REFERENCE_HEAD + "0,0,0,8,0\n")  # all false is an answer, and so is nothing
    assert not any(map(any, truths(read_team_graph(tmp_path)).values()))
    reference.write_text(REFERENCE_HEAD)
    assert not any(map(any, truths(read_team_graph(tmp_path)).values()))


def test_numbers_of_edges_are_refused_if_several_files_were_read(tmp_path):
    folder = write_team(tmp_path / "team", helix_edges(24), 2, 24)
    (folder / "gt_info.xml").write_text("<outlier_lc_indices>3</outlier_lc_indices>\n")
    with pytest.raises(
        DuagError, match=r"gt_info.xml: numbers the edges of one file, but 2 were read; expected"
    ):
        read_team_graph(folder)


def test_edges_that_the_reference_names_false_by_number(tmp_path):
    rows = helix_edges(24)
    path = write_g2o(tmp_path / "measurements.g2o", rows)
    false = len(rows)  # numbers start from one: the last edge
    (tmp_path / "gt_info.xml").write_text(
        f"<struct>\n <outlier_lc_indices>{false}</outlier_lc_indices>\n</struct>\n"
    )
    team = read_team_graph(path, 2)
    (truth,) = team.closures_true.values()
    loops = np.concatenate(list(team.loops_true.values()))
    assert (~truth).sum() + (~loops).sum() == 1


def test_robots_that_nothing_joins_are_components_of_their_own(tmp_path):
    rows = [(i, j, T) for i, j, T in helix_edges(40) if (i < 20) == (j < 20)]
    team = read_team_graph(write_g2o(tmp_path / "two.g2o", rows), 4)
    assert team.components() == [("robot0", "robot1"), ("robot2", "robot3")]


def test_a_graph_of_the_whole_team_in_its_folder_is_left_out(tmp_path):
    folder = write_team(tmp_path / "team", helix_edges(40), 2, 40)
    write_g2o(folder / "fullGraph.g2o", helix_edges(40))
    team = read_team_graph(folder)
    assert list(team.robots) == ["a", "b"]
    assert team.ignored == ("fullGraph.g2o",)


SE2 = "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
FINE = g2o_line(0, 1, np.eye(4))
IDENTITY = "0.0 0.0 0.0 1.0"


def far_line(x_m: float) -> str:
    """An edge of such a length."""
    return g2o_line(1, 2, se3.from_rotation_translation(np.eye(3), [x_m, 0.0, 0.0]))


def information_line(translation: Array) -> str:
    """An edge with this information of its translation [3, 3]."""
    information = np.eye(6)
    information[:3, :3] = translation
    words = g2o_line(1, 2, np.eye(4)).split()[:10]
    return " ".join([*words, *(repr(float(x)) for x in information[np.triu_indices(6)])]) + "\n"


SINGULAR = np.array([[10.0, 2.0, -16.0], [2.0, 20.0, -6.0], [-16.0, -6.0, 26.0]])  # rank two


@pytest.mark.parametrize("seed", range(20))
def test_a_singular_information_is_refused_and_an_uneven_one_is_not(tmp_path, seed):
    rng = np.random.default_rng(seed)
    A = rng.integers(-5, 6, (2, 3)) * rng.choice([1.0, 0.5, 0.1, 10.0, 100.0])
    path = tmp_path / "graph.g2o"
    path.write_text(FINE + information_line(A.T @ A))
    with pytest.raises(DuagError, match="line 2: the information"):
        read_g2o(path)
    uneven = np.diag(10.0 ** rng.uniform(-8, 8, 3))
    path.write_text(FINE + information_line(uneven))
    np.testing.assert_allclose(read_g2o(path).tau[1], 3 / np.trace(np.linalg.inv(uneven)), rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "robots", "words"),
    [
        (SE2, None, ["line 1", "EDGE_SE2", "2-D"]),
        ("VERTEX_SE2 0 0 0 0\n" + FINE, None, ["line 1", "2-D"]),
        (FINE + "EDGE_SE3:QUAT 0 x 0\n", None, ["line 2", "not a number"]),
        (FINE + "EDGE_SE3:QUAT 0 2 1 2 3\n", None, ["line 2", "28"]),
        (FINE.replace(repr(TAU), "nan"), None, ["line 1", "finite"]),
        (g2o_line(0, 1, np.eye(4), tau=0.0), None, ["information", "edge 1"]),
        (FINE + far_line(1e200), None, ["line 2: translation", "found 1e+200", "1e+06"]),
        (FINE + far_line(2e6), None, ["line 2: translation", "found 2e+06"]),
        (FINE.replace(IDENTITY, "0.0 0.0 0.0 1e-170"), None, ["line 1: quaternion norm", "0.001 to 1000"]),
        (FINE.replace(IDENTITY, "7e200 0.0 0.0 7e200"), None, ["line 1: quaternion norm", "found 9.9e+200"]),
        (FINE + g2o_line(1, 2, np.eye(4), tau=1e300), None, ["line 2: information", "found 1e+300"]),
        (FINE + g2o_line(1, 2, np.eye(4), kappa=1e-300), None, ["line 2: information", "2e-300", "1e-18"]),
        (
            "# two\n" + FINE + information_line(SINGULAR),
            None,
            ["line 3: the information of edge 2 is singular"],
        ),
        (FINE + information_line(-SINGULAR), None, ["line 2: the information of edge 2"]),
        (FINE + g2o_line(5, 5, np.eye(4)), None, ["line 2 is an edge from pose 5 to itself", "two poses"]),
        (
            FINE + g2o_line(symbol("a", 1), symbol("a", 2), np.eye(4)),
            None,
            ["line 2", "all keys of the file plain"],
        ),
        (g2o_line(symbol("a", 1), 2, np.eye(4)), None, ["line 1", "all keys of the file plain"]),
        ("EDGE_SE3_PRIOR 0 1\n", None, ["EDGE_SE3_PRIOR"]),
        ("", None, ["no EDGE_SE3:QUAT"]),
        (FINE, 2, ["cannot be cut"]),
        (FINE + g2o_line(2, 3, np.eye(4)), 1, ["pieces"]),
        (g2o_line(symbol("a", 0), symbol("a", 1), np.eye(4)), 3, ["--robots 3", "1 robots"]),
    ],
)
def test_what_cannot_be_read_is_said_in_one_line(tmp_path, text, robots, words):
    path = tmp_path / "graph.g2o"
    path.write_text(text)
    with pytest.raises(DuagError) as error:
        read_team_graph(path, robots)
    message = str(error.value)
    assert "\n" not in message
    assert str(path) in message
    assert all(word in message for word in words), message


def test_a_folder_without_graphs_is_refused(tmp_path):
    with pytest.raises(DuagError, match=r"found neither \*\.g2o nor .*, expected a team"):
        read_team_graph(tmp_path)
    with pytest.raises(DuagError, match="not found"):
        read_team_graph(tmp_path / "absent.g2o")
    (tmp_path / "robot0").mkdir()
    (tmp_path / "robot0" / "measurements.csv").write_text("a,b\n1,2\n")
    with pytest.raises(DuagError, match="no column robot_src"):
        read_team_graph(tmp_path)
    plain = tmp_path / "plain"
    plain.mkdir()
    write_g2o(plain / "0.g2o", helix_edges(8, 4))
    write_g2o(plain / "1.g2o", helix_edges(8, 4))
    with pytest.raises(DuagError, match="gtsam symbols"):
        read_team_graph(plain)
    with pytest.raises(DuagError, match="no reference"):
        read_team_graph(plain / "0.g2o", 2, only_reference=True)


FINE_ROW = dict.fromkeys(KIMERA_COLUMNS, 0.0) | {"pose_dst": 1, "qw": 1.0, "kappa": KAPPA, "tau": TAU}


def write_table(folder, rows, separator=","):
    """`measurements.csv` of one robot."""
    lines = [[f"{row[n]:.0f}" if "_" in n else repr(float(row[n])) for n in KIMERA_COLUMNS] for row in rows]
    path = folder / "measurements.csv"
    path.write_text("\n".join(separator.join(words) for words in [KIMERA_COLUMNS, *lines]))
    return path


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"tx": 1e200}, "translation in m found 1e+200, expected 0 to 1e+06"),
        ({"qw": 1e-170}, "quaternion norm found"),
        ({"kappa": 1e300}, "kappa found 1e+300, expected 1e-18 to 1e+18"),
        ({"tau": 1e-300}, "tau found 1e-300"),
    ],
)
def test_a_table_with_numbers_that_nobody_computes_with_is_refused(tmp_path, changes, words):
    path = write_table(tmp_path, [FINE_ROW, FINE_ROW | changes])
    with pytest.raises(DuagError) as error:
        read_kimera(path)
    assert f"{path}: line 3: {words}" in str(error.value)


def test_a_table_with_spaces_behind_its_commas_is_read(tmp_path):
    plain, spaced = (read_kimera(write_table(tmp_path, [FINE_ROW], separator)) for separator in (",", ", "))
    assert (spaced.i, spaced.j) == (plain.i, plain.j)
    np.testing.assert_array_equal(spaced.T_i_j, plain.T_i_j)


def test_a_measurement_from_a_pose_to_itself_is_refused(tmp_path):
    path = write_table(tmp_path, [FINE_ROW, FINE_ROW | {"pose_dst": 0}])
    with pytest.raises(DuagError, match="line 3 is an edge from pose 0 to itself, expected"):
        read_kimera(path)


def test_a_team_too_far_apart_to_say_so_ends_in_one_line(tmp_path):
    """Every edge is within the limit, and the second robot's first keyframe is not."""
    step = se3.from_rotation_translation(np.eye(3), [9e5, 0.0, 0.0])
    path = write_g2o(tmp_path / "far.g2o", [(k, k + 1, step) for k in range(7)])
    with pytest.raises(DuagError, match=r"pose graph: .*expected a team within 1e\+06 m"):
        solve(path, settings("admm", max_rounds=40), 2)
