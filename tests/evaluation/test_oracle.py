"""The gap to the centralized answer: zero at the answer, whatever the gauge, and as large as what was moved."""

import numpy as np
import pytest

from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.consensus.local_problem import with_floor
from duagc.pipeline.evaluation.network import Session
from duagc.pipeline.evaluation.oracle import (
    NO_LISTS,
    NO_WEIGHTS,
    Gap,
    gap_to_oracle,
    pose_gap,
    solve_component,
)
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import HeldLoopClosures, RelativePoses
from duagc.pipeline.runs.folder import RunFolder
from tests.fixtures.fake_run import make
from tests.fixtures.pose_worlds import make_team, talk

CONFIG = PoseConsensusConfig(wire="float64", tolerance=1e-9)


@pytest.fixture(scope="module")
def agreed():
    """Three robots that have agreed: their poses, odometry and closures with final weights."""
    world = make_team(0, robots=3, closures=6)
    agents = world.agents(CONFIG)
    talk(agents, 400)
    poses = {name: agent.T_world_keyframe for name, agent in agents.items()}
    odometry = {name: agent.odometry for name, agent in agents.items()}
    closures = [
        HeldLoopClosures(agent.robot, link.peer, (closure,), (weight,))
        for agent in agents.values()
        for link in agent.links.values()
        for closure, weight in zip(link.closures, link.robust.weights.tolist(), strict=True)
    ]
    return poses, odometry, closures


def gap_of_component(poses, odometry, closures, config=CONFIG):
    """Meters and radians between the robots' poses and the centralized answer."""
    central = solve_component(poses, odometry, closures, config)
    assert not isinstance(central, Absent)
    return pose_gap(poses, central)


def test_robots_that_agreed_are_at_the_centralized_answer(agreed):
    poses, odometry, closures = agreed
    meters, radians = gap_of_component(poses, odometry, closures)
    # they stop when nothing moves by more than the tolerance, a little before they are there
    assert meters < 1e-6
    assert radians < 1e-6


def test_the_gauge_does_not_count(agreed):
    poses, odometry, closures = agreed
    T = se3.exp(np.array([3.0, -2.0, 1.0, 0.3, 0.8, -0.4]))
    meters, _ = gap_of_component({name: T @ p for name, p in poses.items()}, odometry, closures)
    assert meters < 1e-6


def test_a_moved_keyframe_is_the_gap(agreed):
    poses, odometry, closures = agreed
    moved = {name: p.copy() for name, p in poses.items()}
    moved["bravo"][3] = moved["bravo"][3] @ se3.exp(np.array([0.01, 0.0, 0.0, 0.0, 0.002, 0.0]))
    meters, radians = gap_of_component(moved, odometry, closures)
    assert meters == pytest.approx(0.01, abs=1e-5)
    assert radians == pytest.approx(0.002, abs=1e-5)


def test_other_weights_have_another_answer(agreed):
    """The final weights count: with one closure left out, the robots are not at the answer."""
    poses, odometry, closures = agreed
    assert sum(c.weights[0] > 0 for c in closures) > 2
    used = next(k for k, c in enumerate(closures) if c.weights[0] > 0)
    less = [c for k, c in enumerate(closures) if k != used]
    assert gap_of_component(poses, odometry, less)[0] > 1e-5


def test_without_information_or_company_there_is_no_gap(tmp_path):
    apart = RunFolder(make(tmp_path / "apart", joined=False).run)
    found = gap_to_oracle(apart, [], {})
    assert isinstance(found, Absent)
    assert "share" in found.reason


def test_a_kept_closure_that_the_poses_never_had_is_no_rejected_one_and_leaves_no_gap(tmp_path):
    session = Session(RunFolder(make(tmp_path).run))
    assert isinstance(gap_to_oracle(session.run, session.loop_closures, session.pairs), Gap)
    before = session.loop_closure_counts()
    for decision in session.loop_closures:
        decision.weight = -1.0 if decision.verdict == "kept" else decision.weight
    assert gap_to_oracle(session.run, session.loop_closures, session.pairs) == NO_WEIGHTS
    after = session.loop_closure_counts()
    assert (before["inter_robot_loop_closures"], after["inter_robot_loop_closures"]) == (1, 0)
    assert before["inter_robot_loop_closures_rejected"] == after["inter_robot_loop_closures_rejected"] == 2


def test_without_a_list_of_matches_there_is_a_gap_of_poses_alone(tmp_path):
    session = Session(RunFolder(make(tmp_path).run))
    listed = gap_to_oracle(session.run, session.loop_closures, session.pairs)
    found = gap_to_oracle(session.run, session.loop_closures, {})
    assert (found.meters, found.radians) == (listed.meters, listed.radians)
    assert found.sigma == found.sigma_p99 == NO_LISTS != listed.sigma


def test_the_floor_is_that_of_the_agents():
    one = RelativePoses(np.array([0]), np.array([1]), np.eye(4)[None], 1e12 * np.eye(6)[None])
    information = with_floor(one, CONFIG).information[0]
    assert information[0, 0] == pytest.approx(1 / CONFIG.odometry_floor_m**2, rel=1e-4)
    assert information[5, 5] == pytest.approx(1 / CONFIG.odometry_floor_rad**2, rel=1e-4)
