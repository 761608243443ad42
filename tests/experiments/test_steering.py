"""A steered robot goes where its own map says, and nowhere else; what others do is not changed by it."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from duagc.converters.simulate.settings import SimulationSettings
from duagc.converters.simulate.trajectories.legs import FIRST_FRAMES, LEG_FRAMES
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.evaluation import groundtruth
from duagc.pipeline.experiments.rule import Policy, SimulatedData
from duagc.pipeline.experiments.steering import simulate_steered, unseen, views_after
from duagc.pipeline.frontend.view_gain import ViewGain
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import Recording
from tests.fixtures.speckled_wall import CAMERA, POSES, wall

FRAMES = FIRST_FRAMES + LEG_FRAMES
SETTINGS = (
    "frontend.mapping.max_gaussians=500",
    "frontend.mapping.iterations=2",
    "frontend.mapping.final_iterations=0",
    "frontend.mapping.final_iterations_view=0",
)


def small(policy: str) -> SimulatedData:
    data = {"robots": 2, "frames": FRAMES, "width": 80, "height": 60, "steering": policy}
    return SimulatedData.model_validate(data)


def steered(folder: Path, policy: Policy) -> dict[str, np.ndarray]:
    """True paths of a small recording, by robot."""
    settings: SimulationSettings = small(policy).settings(7)
    simulate_steered(folder, settings, policy, SETTINGS)
    recording, paths = Recording(folder), {}
    for robot in recording.robots:
        true = groundtruth.trajectory(recording, robot)
        assert isinstance(true, Trajectory)
        paths[robot] = true.poses
    return paths


def test_share_of_a_view_that_shows_nothing() -> None:
    gain = ViewGain(wall(), "blended", CAMERA, MappingConfig(), 1)
    away = POSES[0] @ se3.exp(np.array([0, 0, 0, np.pi / 2, 0, 0]))
    assert unseen(gain, away) == 1
    assert unseen(gain, POSES[0]) < 0.1


def test_views_are_where_legs_lead_by_the_estimate() -> None:
    """Also if it lost itself on the last frame: the motion since is known."""
    rng = np.random.default_rng(1)
    path = se3.exp(0.1 * rng.standard_normal((3, 6)))
    leg = np.stack([path[2] @ se3.exp(0.1 * rng.standard_normal(6)) for _ in range(2)])
    error = se3.exp(0.02 * rng.standard_normal(6))
    T_map_world = se3.inverse(path[0])
    frames = [
        SimpleNamespace(frame_index=k, status="ok", T_map_camera=T_map_world @ T @ error)
        for k, T in enumerate(path)
    ]
    for last_status in ("ok", "lost"):
        frames[2].status = last_status
        last = frames[2 if last_status == "ok" else 1]
        (view,) = views_after(SimpleNamespace(frames=frames), path, [leg])  # type: ignore[arg-type]
        motion = se3.inverse(path[last.frame_index]) @ leg[-1]
        np.testing.assert_allclose(view, last.T_map_camera @ motion, atol=1e-12)


@pytest.mark.slow
def test_policies_part_at_the_first_leg_and_the_other_robot_walks_as_always(tmp_path: Path) -> None:
    random, informed = steered(tmp_path / "random", "random"), steered(tmp_path / "unseen", "unseen")
    again = steered(tmp_path / "again", "unseen")
    assert [len(path) for path in random.values()] == [FRAMES, FRAMES]
    first = slice(0, FIRST_FRAMES)
    assert np.array_equal(random["alpha"][first], informed["alpha"][first])
    assert not np.array_equal(random["alpha"], informed["alpha"])
    assert np.array_equal(random["bravo"], informed["bravo"])
    assert np.array_equal(informed["alpha"], again["alpha"])
