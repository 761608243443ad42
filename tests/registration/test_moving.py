"""What moved is found where others looked through it, and a rigid room is left alone."""

from collections import Counter

import numpy as np
import pytest

from duagc.pipeline.config.registration import MovingConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration.moving import FreeSpace
from tests.fixtures.moving_ball import with_ball
from tests.fixtures.room import CAMERA, pose, render

CONFIG = MovingConfig(halvings=1, grow_px=2)
POSES = [pose(x=-0.2 + 0.1 * k, z=-1.4, yaw=0.1 - 0.05 * k) for k in range(5)]


def ball_at(k: int) -> np.ndarray:
    return np.array([-0.5 + 0.25 * k, -0.3, 0.4])


def scene(
    centers: list[np.ndarray], config: MovingConfig = CONFIG, noise: np.random.Generator | None = None
) -> tuple[FreeSpace, list[np.ndarray], list[np.ndarray]]:
    """The set of all views, their depth images and where they show the ball."""
    free, depths, shown = FreeSpace(CAMERA, config), [], []
    for T, center in zip(POSES, centers, strict=True):
        depth, shows = with_ball(render(T, noise)[1], T, center)
        free.add(depth, T)
        depths.append(depth)
        shown.append(shows)
    return free, depths, shown


def test_a_ball_that_moves_is_found_and_nothing_else() -> None:
    free, depths, shown = scene([ball_at(k) for k in range(5)])
    for T, depth, shows in zip(POSES, depths, shown, strict=True):
        assert np.count_nonzero(shows) > 100
        moving = free.moving(depth, T)
        assert np.count_nonzero(moving & shows) > 0.9 * np.count_nonzero(shows)
        assert np.count_nonzero(moving & ~shows) < 0.5 * np.count_nonzero(shows)  # the margin around it


def test_a_ball_that_rests_is_part_of_the_room() -> None:
    free, depths, _ = scene([ball_at(2)] * 5)
    assert not any(free.moving(depth, T).any() for depth, T in zip(depths, POSES, strict=True))


@pytest.mark.parametrize("off_m", [0.0, 0.03])
def test_a_rigid_room_with_noise_and_poses_that_are_off_is_left_alone(off_m: float) -> None:
    rng = np.random.default_rng(0)
    free = FreeSpace(CAMERA, CONFIG)
    seen = []
    for T in POSES:
        depth = render(T, rng, depth_sigma_m=0.02)[1]
        depth[rng.random(depth.shape) < 0.05] = 0
        T = T @ se3.exp(off_m * rng.uniform(-1, 1, 6) * [1, 1, 1, 0.3, 0.3, 0.3])
        free.add(depth, T)
        seen.append((depth, T))
    assert not any(free.moving(depth, T).any() for depth, T in seen)


def test_one_view_is_not_enough() -> None:
    free = FreeSpace(CAMERA, CONFIG)
    empty = render(POSES[2])[1]
    depth, shows = with_ball(empty, POSES[2], ball_at(2))
    free.add(empty, POSES[1])
    assert not free.moving(depth, POSES[2]).any()
    free.add(render(POSES[3])[1], POSES[3])
    free.add(render(POSES[1])[1], POSES[1])
    assert free.moving(depth, POSES[2])[shows].mean() > 0.8


def test_the_mask_given_stays_and_nothing_found_is_no_mask() -> None:
    free, depths, shown = scene([ball_at(k) for k in range(5)])
    given = np.ones(depths[0].shape, bool)
    given[:10] = False
    usable = free.usable(depths[2], POSES[2], given)
    assert usable is not None
    assert not usable[:10].any()
    assert not usable[shown[2]].mean() > 0.1
    still, depths, _ = scene([ball_at(2)] * 5)
    assert still.usable(depths[2], POSES[2], None) is None
    off, depths, _ = scene([ball_at(k) for k in range(5)], CONFIG.model_copy(update={"enabled": False}))
    assert off.usable(depths[2], POSES[2], given) is given


def test_no_depth_is_nothing() -> None:
    free, _, _ = scene([ball_at(k) for k in range(5)])
    free.add(np.zeros((CAMERA.height, CAMERA.width), np.float32), POSES[0] @ se3.exp(np.full(6, 0.01)))
    assert not free.moving(np.zeros((CAMERA.height, CAMERA.width), np.float32), POSES[1]).any()


def test_what_moves_in_a_frame_is_known_until_a_view_is_added(monkeypatch: pytest.MonkeyPatch) -> None:
    free, depths, _ = scene([ball_at(k) for k in range(5)])
    still, mask = render(POSES[0])[1], np.ones((CAMERA.height, CAMERA.width), bool)
    frames = [*zip(depths, POSES, strict=True), (still, POSES[0] @ se3.exp(np.full(6, 0.001)))]
    expected = [free.usable(depth, T, mask) for depth, T in frames]
    assert expected[-1] is mask
    assert all(found is not None and not found.all() for found in expected[:-1])
    counted = Counter[str]()
    plain = FreeSpace.moving

    def moving(self: FreeSpace, depth_m: np.ndarray, T_map_camera: np.ndarray) -> np.ndarray:
        counted["moving"] += 1
        return plain(self, depth_m, T_map_camera)

    monkeypatch.setattr(FreeSpace, "moving", moving)
    for _ in range(3):
        for index, ((depth, T), usable) in enumerate(zip(frames, expected, strict=True)):
            assert np.array_equal(free.usable(depth, T, mask, index=index), usable)
    assert counted["moving"] == len(frames)
    free.usable(depths[0], POSES[0] @ se3.exp(np.full(6, 0.01)), mask, index=0)  # at another pose
    free.add(depths[0], POSES[0])
    free.usable(depths[0], POSES[0], mask, index=0)
    assert counted["moving"] == len(frames) + 2
