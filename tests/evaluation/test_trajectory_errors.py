from types import SimpleNamespace

import numpy as np
import pytest

from duagc.pipeline.evaluation import groundtruth, trajectory_errors
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.trajectory_errors import Paired
from duagc.pipeline.evaluation.true_paths import TruePaths
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import Trajectory, rpe_rmse


def curved_path(n: int = 50, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    steps = se3.exp(np.concatenate([rng.normal(0.02, 0.02, (n, 3)), rng.normal(0.0, 0.05, (n, 3))], axis=1))
    poses = [np.eye(4)]
    for step in steps[1:]:
        poses.append(poses[-1] @ step)
    return np.array(poses)


STAMPS = np.arange(50, dtype=np.int64) * 33_000_000
T = se3.exp(np.array([1.0, -2.0, 0.5, 0.3, -0.8, 2.0]))


def test_errors_do_not_see_the_choice_of_frame():
    path = curved_path()
    pairs = trajectory_errors.pair(Trajectory(STAMPS, path), Trajectory(STAMPS, T @ path))
    assert len(pairs) == 50
    assert trajectory_errors.ate_rmse_m(pairs) < 1e-12
    assert trajectory_errors.rpe(pairs, STAMPS) == pytest.approx((0.0, 0.0), abs=1e-7)  # arccos near one


def test_rpe_sees_a_known_wrong_step():
    path = curved_path()
    wrong = path.copy()
    wrong[25:] = path[24] @ se3.exp(np.array([0.1, 0, 0, 0, 0, 0])) @ se3.inverse(path[24]) @ path[25:]
    trans, rot = trajectory_errors.rpe(Paired(STAMPS, path, wrong), STAMPS)
    assert trans == pytest.approx(0.1 / np.sqrt(49))
    assert rot == pytest.approx(0.0, abs=1e-7)


def test_steps_across_missing_frames_count_nowhere():
    path = curved_path()
    wrong = path.copy()
    wrong[25:] = path[24] @ se3.exp(np.array([0.1, 0, 0, 0, 0, 0])) @ se3.inverse(path[24]) @ path[25:]

    def without(*missing):
        kept = np.array([k for k in range(50) if k not in missing])
        return trajectory_errors.rpe(Paired(STAMPS[kept], path[kept], wrong[kept]), STAMPS)

    assert without(24, 25, 26) == pytest.approx((0.0, 0.0), abs=1e-7)
    assert without(10) == pytest.approx((0.1 / np.sqrt(47), 0.0), abs=1e-7)
    assert without(*range(40, 50)) == rpe_rmse(path[:40], wrong[:40])
    answer = without(*range(0, 50, 2))
    assert isinstance(answer, Absent)
    assert "no two consecutive frames" in answer.reason


def test_frames_without_ground_truth_are_left_out():
    path = curved_path()
    true = Trajectory(STAMPS[:20] + 10_000_000, path[:20])  # the 21st frame is 23 ms after the last one
    pairs = trajectory_errors.pair(true, Trajectory(STAMPS, path))
    assert pairs.stamps_ns.tolist() == STAMPS[:20].tolist()


@pytest.mark.parametrize(("rate_hz", "seconds"), [(100, 10), (25, 60)])
def test_frames_and_true_poses_are_paired_at_most_once_however_few_these_are(rate_hz, seconds):
    """60 s at 30 Hz; the truth covers them in part, or is slower than the camera."""

    def circle(t_s):
        poses = se3.exp(np.stack([0 * t_s, 0 * t_s, 0 * t_s, 0 * t_s, t_s / 10, 0 * t_s], axis=1))
        poses[:, :3, 3] = np.stack([10 * np.sin(t_s / 10), 0 * t_s, 10 * np.cos(t_s / 10)], axis=1)
        return Trajectory(np.rint(t_s * 1e9).astype(np.int64), poses)

    estimated, true = circle(np.arange(1800) / 30), circle(np.arange(rate_hz * seconds) / rate_hz)
    assert len(true) < len(estimated)
    pairs = trajectory_errors.pair(true, estimated)
    gaps_ns = np.abs(true.stamps_ns - estimated.stamps_ns[:, None]).min(axis=1)
    near = estimated.stamps_ns[gaps_ns <= 20_000_000]
    assert len(pairs) == min(len(true), len(near))
    assert len(set(pairs.stamps_ns.tolist())) == len(pairs)
    assert set(pairs.stamps_ns.tolist()) <= set(near.tolist())
    assert len(np.unique(pairs.true[:, :3, 3], axis=0)) == len(pairs)
    assert isinstance(trajectory_errors.rpe(pairs, estimated.stamps_ns), tuple)


@pytest.mark.parametrize("n", [0, 2])
def test_too_few_pairs_are_a_reason_not_a_number(n):
    path = curved_path()
    answer = trajectory_errors.ate_rmse_m(Paired(STAMPS[:n], path[:n], path[:n]))
    assert isinstance(answer, Absent)
    assert f"found {n}" in answer.reason


def test_a_straight_path_is_a_reason_not_a_number():
    path = np.tile(np.eye(4), (50, 1, 1))
    path[:, 0, 3] = np.arange(50)
    answer = trajectory_errors.ate_rmse_m(Paired(STAMPS, path, path))
    assert isinstance(answer, Absent)
    assert "one line" in answer.reason


def test_only_the_joint_alignment_sees_the_error_between_robots():
    alpha, bravo = curved_path(seed=1), curved_path(seed=2)
    shifted = se3.exp(np.array([0.3, 0, 0, 0, 0, 0])) @ bravo
    pairs_of = {"alpha": Paired(STAMPS, alpha, alpha), "bravo": Paired(STAMPS, bravo, shifted)}
    assert all(trajectory_errors.ate_rmse_m(p) < 1e-12 for p in pairs_of.values())
    team = trajectory_errors.team_error(pairs_of)
    assert not isinstance(team, Absent)
    assert 0.02 < team.ate_rmse_m < 0.16
    pooled = np.sqrt(np.mean([team.ate_rmse_m_of["alpha"] ** 2, team.ate_rmse_m_of["bravo"] ** 2]))
    assert team.ate_rmse_m == pytest.approx(pooled)


def test_a_team_of_one_has_no_joint_error():
    path = curved_path()
    answer = trajectory_errors.team_error({"alpha": Paired(STAMPS, path, path)})
    assert isinstance(answer, Absent)
    assert "only alpha" in answer.reason


def test_components_of_one_robot_are_no_team_but_share_one_alignment(monkeypatch):
    """Charlie has no ground truth."""
    ways = {
        name: curved_path(seed=k)
        for k, name in enumerate(("alpha", "alpha-2", "bravo", "bravo-3", "charlie"))
    }

    def true(source, name):
        return Absent("none") if name == "charlie" else Trajectory(STAMPS, ways[name])

    monkeypatch.setattr(groundtruth, "trajectory", true)
    monkeypatch.setattr(groundtruth, "knows_rotations", lambda source, name: True)

    def of(*components):
        robots = {}
        for component in components:
            for name in component:  # the second of a component lies off by 0.3 m
                T_world_true = se3.exp(np.array([0.3 * component.index(name), 0, 0, 0, 0, 0]))
                path = Trajectory(STAMPS, T_world_true @ ways[name])
                robots[name] = SimpleNamespace(trajectory=path, odometry=path, component=component)
        return TruePaths.of(SimpleNamespace(robots=robots, largest_component=components[0]), None)

    found = of(("alpha", "alpha-2"), ("bravo", "bravo-3"))
    assert isinstance(found.team, Absent)
    assert found.team.reason.endswith("only alpha")
    for one, other in (("alpha", "alpha-2"), ("bravo", "bravo-3")):
        both = trajectory_errors.alignment([found.after[one], found.after[other]])
        assert np.array_equal(found.T_gt_world(one), both)
        assert np.array_equal(found.T_gt_world(other), both)
    met = of(("alpha", "alpha-2", "bravo"), ("bravo-3",))
    assert sorted(met.team.ate_rmse_m_of) == ["alpha", "alpha-2", "bravo"]
    assert np.array_equal(met.T_gt_world("alpha-2"), met.team.T_gt_world)
    unknown = of(("alpha", "charlie"))
    assert unknown.team == unknown.T_gt_world("charlie") == Absent("none")
    assert np.allclose(unknown.T_gt_world("alpha"), np.eye(4))


def test_true_positions_without_rotations_say_nothing_about_steps() -> None:
    path = se3.exp(np.random.default_rng(3).normal(0, 0.3, (len(STAMPS), 6)))
    pairs = Paired(STAMPS, path, path, positions_only=True)
    assert isinstance(trajectory_errors.rpe(pairs, STAMPS), Absent)
    assert trajectory_errors.ate_rmse_m(pairs) == pytest.approx(0.0, abs=1e-9)
