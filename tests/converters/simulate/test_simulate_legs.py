"""Legs of a steered robot: free, slow enough, and from where it is; paths that are given are those of the recording."""

from pathlib import Path

import numpy as np
import pytest

from duagc.converters.simulate.scenes.catalog import build
from duagc.converters.simulate.scenes.scene import Scene
from duagc.converters.simulate.simulated_scenes import SimulatedRoom
from duagc.converters.simulate.team import simulate
from duagc.converters.simulate.trajectories import legs
from duagc.converters.simulate.trajectories.legs import LegPlanner
from duagc.converters.simulate.trajectories.loops import look_at
from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.evaluation import groundtruth
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import Recording

FRAMES = 12


class Unpainted(SimulatedRoom):
    """A room without its texture, which takes seconds."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene


@pytest.fixture(scope="module")
def room() -> SimulatedRoom:
    return Unpainted(build("room", 3))


@pytest.fixture
def begin(room: SimulatedRoom) -> Array:
    middle = np.array([*room.scene.size[:2] / 2, 1.5])
    return look_at(middle[None], middle[None] + [1.0, 0.5, -0.2])[0]


def test_legs_are_free_and_slow_and_begin_where_the_robot_is(room: SimulatedRoom, begin: Array) -> None:
    planner = LegPlanner(room, FRAMES)
    drawn = planner.draw(begin, 8, random_streams.generator(1, "test"))
    assert len(drawn) == 8
    for leg in drawn:
        assert leg.shape == (FRAMES, 4, 4)
        assert room.clearance(leg[:, :3, 3]).min() > legs.MIN_CLEARANCE_M
        moved, turned = se3.distance(np.concatenate([begin[None], leg])[:-1], leg)
        assert moved.max() < 1.6 * room.step_m + 0.02  # the fastest of an eased motion; height comes on top
        assert turned.max() < np.deg2rad(10)
        assert moved[-1] < moved[FRAMES // 2] > moved[0], "it starts and stops gently"
        np.testing.assert_allclose(leg[:, 2, 0], 0, atol=1e-12)  # upright
    ends = np.array([leg[-1, :3, 3] for leg in drawn])
    assert np.ptp(ends, axis=0).max() > 0.2, "they lead to different places"


def test_the_same_stream_draws_the_same_legs(room: SimulatedRoom, begin: Array) -> None:
    planner = LegPlanner(room, FRAMES)
    first, second, other = (
        np.array(planner.draw(begin, 3, random_streams.generator(seed, "test"))) for seed in (1, 1, 2)
    )
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


def test_a_robot_in_a_corner_has_no_leg(room: SimulatedRoom, begin: Array) -> None:
    corner = begin.copy()
    corner[:2, 3] = 0.05
    with pytest.raises(
        DuagError, match=r"found 0 legs with 0\.4 m of room around them in 200 tries, expected 2"
    ):
        LegPlanner(room, 2).draw(corner, 2, random_streams.generator(1, "test"))


def test_given_paths_are_those_of_the_recording(room: SimulatedRoom, begin: Array, tmp_path: Path) -> None:
    path = LegPlanner(room, 4).draw(begin, 1, random_streams.generator(1, "test"))[0]
    simulate(tmp_path / "steered", robots=1, frames=4, size=(32, 32), seed=3, workers=1, paths=[path])
    recording = Recording(tmp_path / "steered")
    true = groundtruth.trajectory(recording, recording.robots[0])
    assert isinstance(true, Trajectory)
    np.testing.assert_allclose(true.poses, path, atol=1e-12)
    with pytest.raises(DuagError, match=r"paths are of shapes \[\(4, 4, 4\)\], expected \[\(5, 4, 4\)\]"):
        simulate(tmp_path / "x", robots=1, frames=5, size=(32, 32), seed=3, workers=1, paths=[path])
    assert not (tmp_path / "x").exists()
