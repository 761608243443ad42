"""Images of a camera that moves slowly are chosen, in every part of a path."""

from itertools import accumulate

import numpy as np
import pytest

from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.image_motion import image_shift, image_speeds, nearby_cameras, slowest_of_parts
from duagc.pipeline.geometry.trajectory import Trajectory


def path_of(moves: list[list[float]], seconds: float = 0.1) -> Trajectory:
    poses = [np.eye(4)]
    for move in moves:
        poses.append(poses[-1] @ se3.exp(np.array(move, dtype=float)))
    return Trajectory((1e9 * seconds * np.arange(len(poses))).astype(np.int64), np.array(poses))


def test_turns_count_as_they_are_and_shifts_by_the_distance() -> None:
    turning = path_of([[0, 0, 0, 0, 0.02, 0]] * 3)
    np.testing.assert_allclose(image_speeds(turning, 5.0), 0.2)
    shifting = path_of([[0.1, 0, 0, 0, 0, 0]] * 3)
    np.testing.assert_allclose(image_speeds(shifting, 5.0), 0.2)
    np.testing.assert_allclose(image_speeds(shifting, 10.0), 0.1)


def test_a_pause_is_the_slowest_whatever_the_rate_of_the_log() -> None:
    moves = [[0, 0, 0, 0, 0.02, 0]] * 4 + [[0, 0, 0, 0, 0.0, 0]] * 2 + [[0, 0, 0, 0, 0.02, 0]] * 4
    path = path_of(moves)
    assert int(np.argmin(image_speeds(path, 1.0))) == 5
    uneven = Trajectory(path.stamps_ns**2 // 10**9, path.poses)
    assert image_speeds(uneven, 1.0)[1] == pytest.approx(0.04 / 0.04)


@pytest.mark.parametrize("total", [0, 1, 7, 40])
def test_every_part_gives_its_slowest(total: int) -> None:
    speeds = np.random.default_rng(total).random(total)
    for count in {0, 1, total // 3, total}:
        if count <= total:
            chosen = slowest_of_parts(speeds, count)
            assert chosen == sorted(set(chosen))
            assert len(chosen) == count
            for k, index in enumerate(chosen):
                part = range(k * total // count, (k + 1) * total // count)
                assert index in part
                assert speeds[index] == min(speeds[part.start : part.stop])


def test_a_path_of_one_pose_stands_still() -> None:
    assert image_speeds(path_of([]), 1.0).tolist() == [0.0]
    assert len(image_speeds(Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4))), 1.0)) == 0


@pytest.mark.parametrize(
    ("most_rad", "least", "most"), [(0.0, 40, 40), (0.03, 11, 30), (0.06, 2, 20), (0.1, 2, 10), (10.0, 1, 1)]
)
def test_a_camera_nearby_is_near_and_serves_several(most_rad: float, least: int, most: int) -> None:
    rng = np.random.default_rng(3)
    steps = se3.exp(rng.normal(size=(40, 6)) * [0.02, 0.02, 0.02, 0.01, 0.01, 0.01])
    poses = np.array(list(accumulate(steps, np.matmul)))
    near = nearby_cameras(poses, 2.0, most_rad)
    assert (image_shift(poses, poses[near], 2.0) <= most_rad + 1e-12).all()
    assert (np.diff(near) >= 0).all()
    used = np.unique(near)
    np.testing.assert_array_equal(near[used], used)
    assert least <= len(used) <= most
    first_of_next = np.searchsorted(near, used[:-1], side="right")
    assert (image_shift(poses[used[:-1]], poses[first_of_next], 2.0) > most_rad).all()


def test_no_camera_has_none_nearby() -> None:
    assert nearby_cameras(np.zeros((0, 4, 4)), 1.0, 0.1).shape == (0,)
