"""Sensors and moving figures of the simulator, held against the exact scene."""

import json

import numpy as np
import pytest

from duagc.converters.simulate.movers import Mover, walk
from duagc.converters.simulate.sensors.rig import (
    GAMMA,
    RANGE_SIGMA_M,
    T_CAMERA_LIDAR,
    MovingCamera,
    Rig,
    with_gain,
)
from duagc.converters.simulate.settings import camera_of
from duagc.converters.simulate.simulated_scenes import SimulatedMeshes
from duagc.converters.simulate.team import simulate
from duagc.converters.simulate.trajectories.moments import twists_of
from duagc.pipeline.base import random_streams
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.evaluation import groundtruth
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import Recording, open_rgbd
from tests.fixtures.mesh_scenes import ROOM, some_poses
from tests.fixtures.recordings import true_poses

CAMERA = camera_of((80, 60))
TWIST = np.array([0.5, -0.2, 0.3, 0.4, 0.6, -0.3])


@pytest.fixture(scope="module")
def movers(stage: SimulatedMeshes, tmp_path_factory: pytest.TempPathFactory) -> list[Mover]:
    ways = [np.tile(pose, (4, 1, 1)) for pose in some_poses()]
    return walk(2, stage.free_space(), stage.caster, ways, seed=0, cache=tmp_path_factory.mktemp("movers"))


def alike(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether colors are equal but for the two rays that a plain camera leaves out where the others agree."""
    difference = np.abs(one.astype(int) - other)
    return bool(difference.max() <= 12 and np.percentile(difference, 98) <= 4)


def test_a_camera_that_stands_still_sees_what_a_plain_one_sees(stage):
    eye = stage.renderer(CAMERA)
    for T in some_poses():
        view, still = MovingCamera(eye, Rig(readout_s=0.02), []).render(T, np.zeros(6), 0)
        plain = eye.render(T)
        assert np.array_equal(view.depth, plain.depth)
        assert alike(view.color, plain.color)
        assert still.all()


def test_every_row_of_a_rolling_shutter_is_a_view_of_its_own_time(stage):
    eye, T = stage.renderer(CAMERA), some_poses()[0]
    view, _ = MovingCamera(eye, Rig(readout_s=0.03), []).render(T, TWIST, 0)
    assert np.array_equal(view.depth, eye.render(T).depth)  # depth is of one moment
    for row in (0, 17, 59):
        time_s = (row - 29.5) / 59 * 0.03
        then = eye.render(T @ se3.exp(time_s * TWIST))
        assert alike(view.color[row], then.color[row])


def test_motion_blur_is_the_mean_over_the_exposure(stage):
    eye, T = stage.renderer(CAMERA), some_poses()[1]
    view, _ = MovingCamera(eye, Rig(exposure_s=0.03), []).render(T, TWIST, 0)
    times = (np.arange(16) + 0.5) / 16 * 0.03 - 0.015
    light = np.mean([(eye.render(T @ se3.exp(t * TWIST)).color / 255.0) ** GAMMA for t in times], axis=0)
    mean = 255 * light ** (1 / GAMMA)
    blurred, sharp = np.abs(view.color - mean).mean(), np.abs(eye.render(T).color - mean).mean()
    assert blurred < 0.5 * sharp


def test_the_mask_is_where_something_moves(stage, movers):
    eye = stage.renderer(CAMERA)
    hidden = 0
    for T in some_poses():
        for frame in range(4):
            view, still = MovingCamera(eye, Rig(), movers).render(T, np.zeros(6), frame)
            plain = eye.render(T)
            assert np.array_equal(view.depth[still], plain.depth[still])
            assert alike(view.color[still], plain.color[still])
            moved = view.depth != plain.depth
            assert not (moved & still).any()
            assert (view.depth[moved] < plain.depth[moved]).all()
            hidden += int(moved.sum())
    assert hidden > 200


def test_movers_keep_clear_of_walls_and_robots(stage, movers):
    for mover in movers:
        places = mover.poses[:, :3, 3] + np.array([0, 0, 1.0])
        assert stage.clearance(places).min() > 0.25
        assert np.linalg.norm(np.diff(mover.poses[:, :2, 3], axis=0), axis=1).max() < 0.03


def test_lidar_points_lie_on_surfaces(stage):
    for T in some_poses():
        points = MovingCamera(stage.renderer(CAMERA), Rig(sensor="lidar"), []).sweep(
            T, 0, random_streams.generator(0, "test")
        )
        world = se3.transform(T @ T_CAMERA_LIDAR, points)
        assert len(points) > 20_000
        away = stage.clearance(world)
        assert np.sqrt(np.mean(away**2)) < RANGE_SIGMA_M
        assert away.max() < 6 * RANGE_SIGMA_M
        assert (world > -0.1).all()
        assert (world < ROOM + 0.1).all()


def test_gain_changes_the_light():
    gray = np.full((4, 4, 3), 60, dtype=np.uint8)
    assert with_gain(gray, 1.0).mean() == 60
    assert with_gain(gray, 2.0).mean() == pytest.approx(60 * 2 ** (1 / 2.2), abs=1)


def test_cameras_differ_by_channel(folder, tmp_path):
    kind = {"scene": str(folder), "frames": 2, "size": (64, 48), "workers": 1}
    simulate(tmp_path / "alike", **kind)
    simulate(tmp_path / "differ", rig=Rig(camera_stops=1.0), **kind)
    checks = json.loads((tmp_path / "differ" / "recording.json").read_text())["checks"]
    gains = np.array([checks["camera_gain"][robot] for robot in ("alpha", "bravo")])
    assert len(np.unique(gains)) == 6
    assert (np.abs(np.log2(gains)) <= 1 / 2.2).all()
    for robot in ("alpha", "bravo"):
        gain, black = (np.array(checks[name][robot]) for name in ("camera_gain", "camera_black"))
        with (
            open_rgbd(Recording(tmp_path / "alike").log(robot)) as alike,
            open_rgbd(Recording(tmp_path / "differ").log(robot)) as differ,
        ):
            for before, after in zip(alike.frames(), differ.frames(), strict=True):
                expected = np.clip(before.color * gain + 255 * black, 0, 255)
                assert np.abs(after.color - expected).max() <= 0.5
                assert np.array_equal(after.depth, before.depth)


def test_withheld_masks_are_known_to_the_truth_alone(folder, tmp_path):
    simulate(
        tmp_path / "rec",
        scene=str(folder),
        robots=1,
        frames=2,
        size=(64, 48),
        workers=1,
        movers=2,
        masks=False,
    )
    recording = Recording(tmp_path / "rec")
    with open_rgbd(recording.log("alpha")) as log:
        frames = list(log.frames())
    assert all(frame.mask is None for frame in frames)
    true = groundtruth.static_masks(recording, "alpha", [frame.stamp_ns for frame in frames])
    assert [true[frame.stamp_ns].shape for frame in frames] == [(48, 64)] * 2
    assert 0 < np.mean([~mask for mask in true.values()]) < 0.9


def test_stereo_depth_is_as_good_as_its_sigma_says(folder, stage, tmp_path):
    simulate(
        tmp_path / "rec", scene=str(folder), robots=1, frames=2, size=(320, 240), workers=1, rig=Rig("stereo")
    )
    recording = Recording(tmp_path / "rec")
    with open_rgbd(recording.log("alpha")) as log:
        frames = list(log.frames())
        eye = stage.renderer(log.camera)
    for frame, pose in zip(frames, true_poses(recording, "alpha"), strict=True):
        assert frame.depth_sigma is not None
        seen = frame.depth > 0
        assert seen.mean() > 0.5
        error = np.abs(frame.depth - eye.render(pose).depth)[seen] / frame.depth_sigma[seen]
        assert 0.1 < np.median(error) < 1.5


def test_a_recording_says_what_it_was_made_of(folder, all_sensors):
    text = (all_sensors / "recording.json").read_text()
    description = json.loads(text)
    assert str(folder.parent) not in text
    assert str(all_sensors.parent) not in text
    assert description["parameters"]["scene"] == description["source"]["scene"] == "flat"
    assert description["parameters"]["up"] == "y"
    assert sorted(description["source"]["files_sha256"]) == ["table.obj", "walls.obj"]
    offsets = description["checks"]["clock_offset_ns"]
    assert len(set(offsets.values())) == 2
    for robot, offset in offsets.items():
        assert description["robots"][robot]["start_ns"] == 1_000_000_000 + offset
        assert abs(offset) < 2e8
    with open_rgbd(Recording(all_sensors).log("alpha")) as log:
        assert all(frame.mask is not None for frame in log.frames())


def test_twists_lead_to_the_next_pose():
    way = np.stack([se3.exp(k * TWIST / 30) for k in range(4)])
    twists = twists_of(way)
    assert way[1] @ se3.exp(twists[1] / 30) == pytest.approx(way[2], abs=1e-12)
    assert np.array_equal(twists[-1], twists[-2])


@pytest.mark.parametrize(
    "bad",
    [
        {"rig": Rig("sonar")},
        {"rig": Rig("lidar"), "noise": "kinect"},
        {"rig": Rig(readout_s=0.1)},
        {"rig": Rig(clock_s=2.0)},
        {"rig": Rig(camera_stops=3.0)},
        {"movers": 20},
        {"masks": False},
    ],
)
def test_sensors_that_cannot_be_are_refused(tmp_path, bad):
    with pytest.raises(DuagError, match="expected"):
        simulate(tmp_path / "rec", **bad)
    assert not (tmp_path / "rec").exists()
