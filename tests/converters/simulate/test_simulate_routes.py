"""Routes over the floor are as long as they must be, however many corners are smoothed away."""

from pathlib import Path

import numpy as np
import pytest

from duagc.converters.simulate.movers import STEP_M, walk
from duagc.converters.simulate.settings import camera_of
from duagc.converters.simulate.simulated_scenes import SimulatedMeshes
from duagc.converters.simulate.trajectories import walks
from duagc.converters.simulate.trajectories.routes import length_of, route
from duagc.pipeline.base import random_streams
from duagc.pipeline.base.errors import DuagError
from tests.fixtures.mesh_scenes import ROOM, some_poses

LENGTH_M = 30.0


def routes(stage: SimulatedMeshes, least_m: float) -> list[np.ndarray]:
    space = stage.free_space()
    graph = space.graph.tocsr()
    streams = [random_streams.generator(0, "test.route", attempt=k) for k in range(6)]
    return [route(space, graph, LENGTH_M, rng, least_m=least_m) for rng in streams]


def test_a_route_goes_on_until_it_is_long_enough_smoothed(stage: SimulatedMeshes) -> None:
    plain, longer = routes(stage, 0.0), routes(stage, LENGTH_M)
    assert min(length_of(path) for path in plain) < LENGTH_M - 1.0
    for before, path in zip(plain, longer, strict=True):
        assert length_of(path) >= LENGTH_M
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.026
        same = len(before) - 120  # the end is smoothed with what follows
        assert np.abs(path[:same] - before[:same]).max() < 0.03


def test_a_route_that_was_long_enough_keeps_its_bits(stage: SimulatedMeshes) -> None:
    plain = routes(stage, 0.0)
    enough = min(length_of(path) for path in plain)
    for before, path in zip(plain, routes(stage, enough), strict=True):
        assert np.array_equal(before, path)


def test_figures_of_a_long_recording_stay_in_the_room(stage: SimulatedMeshes, tmp_path: Path) -> None:
    ways = [np.tile(some_poses()[0], (1500, 1, 1))]
    (mover,) = walk(1, stage.free_space(), stage.caster, ways, seed=0, cache=tmp_path)
    floor = mover.poses[:, :2, 3]
    assert stage.clearance(mover.poses[:, :3, 3] + np.array([0, 0, 1.0])).min() > 0.2
    assert (floor > 0).all()
    assert (floor < ROOM[:2]).all()
    steps = np.linalg.norm(np.diff(floor, axis=0), axis=1)
    assert np.median(steps) == pytest.approx(STEP_M, rel=0.01)


def test_a_long_walk_is_planned(stage: SimulatedMeshes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(walks, "TRIES", 12)
    (path,) = walks.plan(stage, 1, 1100, 0.6, camera=camera_of((64, 48)), seed=0)
    assert path.shape == (1100, 4, 4)
    assert stage.clearance(path[:, :3, 3]).min() > 0.2


def test_walks_that_are_too_short_are_refused_for_that(
    stage: SimulatedMeshes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(walks, "TRIES", 3)
    monkeypatch.setattr(walks, "route", lambda *of, **how: np.zeros((40, 2)))
    with pytest.raises(
        DuagError, match=r"\(3 too short, 0 turns too fast.* of free floor, expected one; give"
    ):
        walks.plan(stage, 1, 100, 0.6, camera=camera_of((64, 48)), seed=0)
