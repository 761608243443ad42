"""Trajectory files and errors, with known answers from public benchmark files where they are present."""

from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, trajectory
from duagc.pipeline.geometry.trajectory import Trajectory

BENCHMARK = Path(__file__).parents[2].parent / "shared" / "data" / "trajectories"


def walk(n: int = 40) -> Trajectory:
    rng = np.random.default_rng(3)
    poses = np.stack([np.eye(4)] * n)
    for i in range(1, n):
        poses[i] = poses[i - 1] @ se3.exp(rng.normal(scale=0.05, size=6))
    return Trajectory(np.arange(n, dtype=np.int64) * 33_333_333 + 1_700_000_000_123_456_789, poses)


def test_tum_files_keep_nanoseconds_and_poses(tmp_path: Path) -> None:
    before = walk()
    trajectory.write_tum(tmp_path / "t.tum", before)
    after = trajectory.read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(after.stamps_ns, before.stamps_ns)
    np.testing.assert_allclose(after.poses, before.poses, atol=1e-14)
    assert [p.name for p in tmp_path.iterdir()] == ["t.tum"]


def test_times_with_an_exponent_keep_nanoseconds(tmp_path: Path) -> None:
    """As numpy.savetxt writes them."""
    path = tmp_path / "t.tum"
    path.write_text("1.305031102175304123e+09 1 2 3 0 0 0 1\n1305031103.175304123 1 2 3 0 0 0 1\n")
    stamps_ns = [1_305_031_102_175_304_123, 1_305_031_103_175_304_123]
    assert trajectory.read_tum(path).stamps_ns.tolist() == stamps_ns


@pytest.mark.parametrize(
    "line",
    [
        *("1.0 1 2 3 0 0 0", "1.0 1 2 3 0 0 0 nan", "x 1 2 3 0 0 0 1", ""),
        *("1e999 1 2 3 0 0 0 1", "9999999999 1 2 3 0 0 0 1", "\udcff"),  # the last is no UTF-8
    ],
)
def test_bad_tum_lines_are_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "bad.tum"
    path.write_bytes(line.encode(errors="surrogateescape") + b"\n")
    with pytest.raises(DuagError, match=r"bad\.tum"):
        trajectory.read_tum(path)


@pytest.mark.parametrize("quaternion", ["0 0 0 0", "1e200 0 0 1e200"])
def test_a_quaternion_that_is_none_is_named(tmp_path: Path, quaternion: str) -> None:
    path = tmp_path / "bad.tum"
    path.write_text(f"1.0 1 2 3 0 0 0 1\n2.0 1 2 3 {quaternion}\n")
    with pytest.raises(DuagError, match=f"line 2 has the quaternion {quaternion}"):
        trajectory.read_tum(path)


def test_poses_are_in_order_of_their_times_and_the_last_of_one_time_counts(tmp_path: Path) -> None:
    path = tmp_path / "back.tum"
    path.write_text("".join(f"{t} {x} 0 0 0 0 0 1\n" for t, x in ((3, 1), (1, 2), (2, 3), (1, 4))))
    found = trajectory.read_tum(path)
    assert found.stamps_ns.tolist() == [1_000_000_000, 2_000_000_000, 3_000_000_000]
    assert found.positions[:, 0].tolist() == [4, 3, 1]


def test_ate_ignores_the_frame_but_sees_the_noise() -> None:
    true = walk(400)
    T = se3.exp(np.array([3, -2, 1, 0.4, 2.0, -1.0]))
    moved = se3.transform(T, true.positions)
    assert trajectory.ate_rmse_m(true.positions, moved) < 1e-12
    noise = np.random.default_rng(4).normal(scale=0.01, size=moved.shape)
    # 400 positions with 6 free parameters: the expected value is 0.01 sqrt(3) sqrt(1 - 6/1200)
    assert trajectory.ate_rmse_m(true.positions, moved + noise) == pytest.approx(0.01 * np.sqrt(3), rel=0.1)


def test_alignment_says_when_it_is_not_determined() -> None:
    line = np.outer(np.arange(5.0), [1, 2, 3])
    with pytest.raises(DuagError, match="one line"):
        trajectory.align(line, line)
    with pytest.raises(DuagError, match="at least 3"):
        trajectory.align(line[:2], line[:2])


@pytest.mark.skipif(not BENCHMARK.is_dir(), reason="the benchmark trajectories are not next to this checkout")
@pytest.mark.parametrize(
    ("truth", "estimate", "expected_m"),
    [
        ("rgbd_dataset_freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam.txt", 0.013473),
        ("rgbd_dataset_freiburg1_desk-groundtruth.txt", "freiburg1_desk-rgbdslam.txt", 0.025831),
        ("rgbd_dataset_freiburg2_desk-groundtruth.txt", "freiburg2_desk-rgbdslam.txt", 0.095114),
    ],
)
def test_ate_of_public_trajectories(truth: str, estimate: str, expected_m: float) -> None:
    true, estimated = trajectory.read_tum(BENCHMARK / truth), trajectory.read_tum(BENCHMARK / estimate)
    j, i = trajectory.associate(estimated, true, tolerance_ns=20_000_000)  # fewer poses than the truth
    assert trajectory.ate_rmse_m(true.positions[i], estimated.positions[j]) == pytest.approx(
        expected_m, abs=2e-6
    )


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_errors_name_the_positions_that_are_not_finite(value: float, tmp_path: Path) -> None:
    truth, broken = walk().positions, walk().poses
    broken[[7, 9], 1, 3] = value
    with pytest.raises(ValueError, match="positions_estimated: 2 of 40 are not finite, the first is 7"):
        trajectory.ate_rmse_m(truth, broken[:, :3, 3])
    with pytest.raises(ValueError, match="positions_true: 2 of 40"):
        trajectory.ate_rmse_m(broken[:, :3, 3], truth)
    with pytest.raises(ValueError, match="points_b: 2 of 40"):
        trajectory.align(truth, broken[:, :3, 3])
    with pytest.raises(ValueError, match=r"trajectory\.poses: 2 of 40"):
        trajectory.write_tum(tmp_path / "t.tum", Trajectory(walk().stamps_ns, broken))
    assert not list(tmp_path.iterdir())


def test_errors_name_the_shape_of_what_are_no_paired_positions() -> None:
    truth = walk().positions
    with pytest.raises(ValueError, match=r"positions_estimated has shape \(20, 3\), expected \(40, 3\)"):
        trajectory.ate_rmse_m(truth, truth[:20])
    with pytest.raises(ValueError, match=r"positions_true has shape \(40, 4, 4\), expected \(40, 3\)"):
        trajectory.ate_rmse_m(walk().poses, truth)
