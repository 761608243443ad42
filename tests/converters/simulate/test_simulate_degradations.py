"""Each degradation of the simulator obeys the law that its dial states, and leaves alone what it does not name."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.simulate.frames import FrameJob, FrameRenderer, FrameSettings
from duagc.converters.simulate.movers import Mover, _figure
from duagc.converters.simulate.render import triangles
from duagc.converters.simulate.sensors import light, noise
from duagc.converters.simulate.sensors.degradations import FRAME_RATE_HZ, Degradations
from duagc.converters.simulate.sensors.lens import RadialLens
from duagc.converters.simulate.sensors.rig import GAMMA, MovingCamera, Rig
from duagc.converters.simulate.settings import camera_of
from duagc.converters.simulate.simulated_scenes import SimulatedMeshes
from duagc.converters.simulate.team import simulate
from duagc.converters.simulate.trajectories.loops import look_at
from duagc.converters.simulate.trajectories.moments import pose_at
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import Recording, open_rgbd
from tests.fixtures.recordings import true_poses

CAMERA = camera_of((160, 120))
SMALL = {"frames": 6, "size": (64, 48), "workers": 1, "robots": 2}


@pytest.fixture(scope="module")
def clean(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("clean") / "rec"
    simulate(out, scene=str(folder), **SMALL)
    return out


def simulated(folder: Path, out: Path, robots: int = 2, **dials: float) -> Path:
    simulate(out, scene=str(folder), degradations=Degradations(**dials), **SMALL | {"robots": robots})
    return out


def frames_of(recording: Path, robot: str = "alpha") -> list:
    with open_rgbd(Recording(recording).log(robot)) as log:
        return list(log.frames())


# --- light


def test_automatic_exposure_stays_within_its_dial_and_works_against_the_light() -> None:
    scene = np.exp(np.sin(np.arange(300) / 20))
    gains = light.exposure_gains(scene, Degradations(auto_exposure=0.3))
    assert gains.max() <= 1.3
    assert gains.min() >= 1 / 1.3
    assert max(gains.max(), 1 / gains.min()) > 1.2
    assert np.corrcoef(np.log(gains), np.log(scene))[0, 1] < -0.5
    instant = light.exposure_gains(scene, Degradations(auto_exposure=0.3, exposure_lag_s=0.0))
    assert max(instant.max(), 1 / instant.min()) == pytest.approx(1.3)
    assert np.corrcoef(np.log(instant[1:]), np.log(scene[:-1]))[0, 1] == pytest.approx(-1)  # the image before


def test_automatic_exposure_lags_by_its_time_constant() -> None:
    lag_s = 0.5
    scene = np.where(np.arange(200) < 60, 0.2, 0.4)
    gains = np.log(light.exposure_gains(scene, Degradations(auto_exposure=0.3, exposure_lag_s=lag_s)))
    before, after = gains[60], gains[-1]
    at = 61 + round(lag_s * FRAME_RATE_HZ) - 1
    assert (gains[at] - before) / (after - before) == pytest.approx(1 - np.exp(-1), abs=0.02)
    assert np.ptp(gains[:61]) == 0


def test_light_that_does_not_change_needs_no_other_exposure() -> None:
    assert (light.exposure_gains(np.full(5, 0.3), Degradations(auto_exposure=0.3)) == 1).all()
    assert (light.exposure_gains(np.array([0.1, 0.9]), Degradations()) == 1).all()


def test_white_balance_moves_red_against_blue() -> None:
    gains = light.white_balance_gains(300, Degradations(white_balance=0.15), 3, "alpha")
    assert (gains[:, 1] == 1).all()
    assert gains[:, 0] * gains[:, 2] == pytest.approx(1)
    assert gains.max() <= 1.15
    assert gains.max() > 1.05
    assert np.abs(np.diff(np.log(gains[:, 0]))).max() < 0.02  # a drift, not a jump
    other = light.white_balance_gains(300, Degradations(white_balance=0.15), 3, "bravo")
    assert not np.allclose(gains, other)


def test_a_vignette_takes_its_share_in_the_corner_and_nothing_in_the_middle() -> None:
    through = light.vignette(CAMERA, 0.4)
    assert through[0, 0] == pytest.approx(0.6)
    assert through[60, 80] == pytest.approx(1, abs=1e-3)
    row = through[60, 80:]
    assert (np.diff(row) < 0).all()
    gray = np.full((120, 160, 3), 100, dtype=np.uint8)
    seen = light.with_light(gray, np.ones(3), through)
    assert seen[0, 0].tolist() == [round(100 * 0.6 ** (1 / GAMMA))] * 3
    assert light.with_light(gray, np.array([1.3, 1, 9.0]))[0, 0].tolist() == [113, 100, 255]


def test_a_recording_has_the_gains_that_it_states(folder: Path, clean: Path, tmp_path: Path) -> None:
    lit = simulated(folder, tmp_path / "lit", auto_exposure=0.3, white_balance=0.15)
    checks = json.loads((lit / "recording.json").read_text())["checks"]
    for robot in ("alpha", "bravo"):
        gains = np.array(checks["auto_exposure_gain"][robot])[:, None] * checks["white_balance_gain"][robot]
        for before, after, gain in zip(frames_of(clean, robot), frames_of(lit, robot), gains, strict=True):
            expected = np.clip(before.color * gain ** (1 / GAMMA), 0, 255)
            assert np.abs(after.color - expected).max() <= 0.5 + 1e-9
            assert np.array_equal(after.depth, before.depth)
            assert after.stamp_ns == before.stamp_ns


# --- the lens


@pytest.mark.parametrize("k1", [-0.5, -0.3, 0.2])
def test_undistortion_is_the_inverse_of_distortion(k1: float) -> None:
    lens = RadialLens(CAMERA, k1)
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 41), np.linspace(-0.6, 0.6, 31))
    there = lens.distort(x, y)
    assert np.stack(lens.undistort(*there)) == pytest.approx(np.stack([x, y]), abs=1e-9)
    outward = np.hypot(*there)[15, 20:]
    assert (np.diff(outward) > 0).all()
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    theirs, _ = cv2.projectPoints(
        rays, np.zeros(3), np.zeros(3), np.eye(3), np.array([k1, lens.k2, 0.0, 0.0])
    )
    assert np.stack(there, axis=-1).reshape(-1, 2) == pytest.approx(theirs.reshape(-1, 2), abs=1e-9)


@pytest.mark.parametrize("k1", [-0.3, 0.2])
def test_the_undistorted_image_holds_all_that_the_lens_saw_and_a_rim(k1: float) -> None:
    lens = RadialLens(CAMERA, k1)
    x, y = lens.rays(0.0, 0.0)
    camera = lens.pinhole
    u, v = camera.fx * x + camera.cx, camera.fy * y + camera.cy
    assert u.min() > -1e-6
    assert v.min() > -1e-6
    assert u.max() < CAMERA.width - 1 + 1e-6
    assert v.max() < CAMERA.height - 1 + 1e-6
    assert min(u.min(), v.min()) == pytest.approx(0, abs=1e-6)  # and no more than that
    _, _, inside = lens.maps()
    assert inside[60, 80]
    assert 0.02 < 1 - inside.mean() < 0.4


def test_images_of_a_lens_are_those_of_a_pinhole_but_for_the_rim(
    folder: Path, stage: SimulatedMeshes, tmp_path: Path
) -> None:
    recording = simulated(folder, tmp_path / "lens", robots=1, lens_k1=-0.3)
    lens = RadialLens(camera_of((64, 48)), -0.3)
    eye = stage.renderer(lens.pinhole)
    inside = lens.maps()[2]
    with open_rgbd(Recording(recording).log("alpha")) as log:
        assert log.camera == lens.pinhole
        frames = list(log.frames())
    for frame, T in zip(frames, true_poses(Recording(recording), "alpha"), strict=True):
        straight = eye.render(T)
        assert frame.mask is not None
        assert np.array_equal(frame.mask, inside)
        assert (frame.usable_depth[~inside] == 0).all()
        seen = frame.color.astype(int)
        difference = np.abs(seen - straight.color)[inside].mean()  # interpolated
        for axis in (0, 1):
            for shift in (-1, 1):
                assert difference < 0.6 * np.abs(seen - np.roll(straight.color, shift, axis))[inside].mean()
        relative = np.abs(frame.depth / np.where(inside, straight.depth, 1) - 1)[inside]
        assert np.median(relative) < 0.01


# --- depth


def test_depth_comes_in_steps_that_grow_with_its_square() -> None:
    depth = np.linspace(0.5, 6.0, 20_001)
    seen = noise.quantized(depth, 0.01)
    levels = np.unique(seen)
    assert np.diff(levels) == pytest.approx(0.01 * levels[:-1] * levels[1:], rel=1e-9)
    assert (np.abs(seen - depth) <= 0.0051 * seen * depth).all()
    assert noise.quantized(np.zeros(3), 0.01).tolist() == [0, 0, 0]
    assert noise.quantized(depth, 0.0) is depth


def test_delayed_depth_is_that_of_the_path_before(
    folder: Path, stage: SimulatedMeshes, tmp_path: Path
) -> None:
    recording = Recording(simulated(folder, tmp_path / "late", robots=1, depth_delay_s=2 / FRAME_RATE_HZ))
    path, frames = true_poses(recording, "alpha"), frames_of(recording.path)
    eye = stage.renderer(camera_of((64, 48)))
    for before, frame in zip(path, frames[2:], strict=False):
        assert np.abs(frame.depth - eye.depth(before)[0]).max() < 2e-4  # the unit of its images
        assert np.abs(frame.depth - eye.depth(path[frame.index])[0]).max() > 1e-3
    # before the path began, the camera moved as it does between the first two frames
    back = path[0] @ se3.inverse(path[1]) @ path[0]
    assert np.abs(frames[1].depth - eye.depth(back)[0]).max() < 2e-4


def test_a_pose_between_two_frames_moves_evenly() -> None:
    step = np.array([0.1, -0.02, 0.05, 0.2, 0.1, -0.3])
    path = np.stack([se3.exp(k * step) for k in range(3)] + [se3.exp(2 * step) @ se3.exp(-step)])
    for moment, T in ((1.25, se3.exp(1.25 * step)), (-0.5, se3.exp(-0.5 * step)), (2.5, se3.exp(1.5 * step))):
        assert pose_at(path, moment) == pytest.approx(T, abs=1e-12)
    assert np.array_equal(pose_at(path, 2.0), path[2])
    assert np.array_equal(pose_at(path, 3), path[3])


def test_delayed_depth_shows_a_figure_where_it_was_and_both_places_are_masked(
    stage: SimulatedMeshes, tmp_path: Path
) -> None:
    triangles.write(_figure(0, 0), 0.02, tmp_path)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :2, 3] = np.array([1.6, 2.0]) + np.arange(4)[:, None] * np.array([0.2, 0.0])
    T = look_at(np.array([[2.0, 0.5, 1.2]]), np.array([[2.0, 2.0, 1.0]]))[0]
    dials = Degradations(depth_delay_s=1.5 / FRAME_RATE_HZ)
    settings = FrameSettings(CAMERA, "none", 0, Rig(), [Mover(tmp_path, poses)], (), dials)
    renderer = FrameRenderer(stage, settings)
    assert renderer.moving is not None
    image = renderer.render(FrameJob("alpha", 3, T, np.zeros(6), T_world_depth=T))
    alone = poses.copy()
    alone[:, 0, 3] -= 0.3  # of 1.5 frames
    earlier = MovingCamera(renderer.renderer, Rig(), [Mover(tmp_path, alone)])
    then_m, then = earlier.depth(T, 3)
    _, now = renderer.moving.depth(T, 3)
    assert image.depth is not None
    assert image.mask is not None
    assert np.abs(image.depth * stage.depth_scale_m - then_m).max() < 2e-4
    assert min((then & ~now).sum(), (now & ~then).sum()) > 100
    assert not (image.mask & (then | now)).any()


# --- which frames there are


def test_a_low_rate_keeps_frames_at_even_times() -> None:
    assert Degradations(rate_hz=5.0).kept_frames(120, 0, "alpha").tolist() == list(range(0, 120, 6))
    assert Degradations().kept_frames(7, 0, "alpha").tolist() == list(range(7))
    odd = Degradations(rate_hz=12.0).kept_frames(300, 0, "alpha")
    assert len(odd) == 120
    assert set(np.diff(odd).tolist()) == {2, 3}


@pytest.mark.parametrize("rate_hz", [30.0, 10.0])
def test_missing_frames_are_as_many_as_said_and_never_the_ends(rate_hz: float) -> None:
    whole = Degradations(rate_hz=rate_hz).kept_frames(300, 0, "alpha")
    dial = Degradations(rate_hz=rate_hz, missing=0.2)
    kept = dial.kept_frames(300, 0, "alpha")
    assert len(kept) == round(0.8 * len(whole))
    assert set(kept.tolist()) < set(whole.tolist())
    assert (kept[0], kept[-1]) == (whole[0], whole[-1])
    assert not np.array_equal(kept, dial.kept_frames(300, 0, "bravo"))
    assert not np.array_equal(kept, dial.kept_frames(300, 1, "alpha"))
    assert replace(dial, missing=0.9).kept_frames(3, 0, "alpha").tolist()[0] == 0


def test_the_frames_that_remain_are_those_of_the_whole_recording(
    folder: Path, clean: Path, tmp_path: Path
) -> None:
    few = simulated(folder, tmp_path / "few", missing=0.4)
    kept = json.loads((few / "recording.json").read_text())["checks"]["frames_of_path"]
    for robot in ("alpha", "bravo"):
        all_frames, some = frames_of(clean, robot), frames_of(few, robot)
        assert len(some) == len(kept[robot]) == 4
        for index, frame in zip(kept[robot], some, strict=True):
            assert frame.stamp_ns == all_frames[index].stamp_ns
            assert np.array_equal(frame.color, all_frames[index].color)
            assert np.array_equal(frame.depth, all_frames[index].depth)


# --- all together


def test_all_together_are_in_the_description(all_degradations: Path) -> None:
    description = json.loads((all_degradations / "recording.json").read_text())
    assert description["parameters"]["degradations"]["lens_k1"] == -0.3
    sensors = description["robots"]["alpha"]["sensors"]
    lens = RadialLens(camera_of((64, 48)), -0.3)
    assert float(sensors["rolling_shutter_s"]) == 0.03 * lens.rows_per_row
    assert float(sensors["exposure_s"]) > 0


def test_dials_at_zero_leave_no_trace(clean: Path) -> None:
    description = json.loads((clean / "recording.json").read_text())
    assert "degradations" not in description["parameters"]
    assert "triangles" not in description["parameters"]
    assert all(frame.mask is None for frame in frames_of(clean))


@pytest.mark.parametrize(
    "dials",
    [
        {"auto_exposure": -0.1},
        {"vignette": 1.0},
        {"blur_px": 100.0},
        {"lens_k1": -2.0},
        {"depth_step_m": 1.0},
        {"depth_delay_s": -0.1},
        {"missing": 1.0},
        {"rate_hz": 0.0},
        {"rate_hz": 60.0},
        {"white_balance": float("nan")},
    ],
)
def test_dials_out_of_range_are_refused(tmp_path: Path, dials: dict[str, float]) -> None:
    with pytest.raises(DuagError, match="expected"):
        simulate(tmp_path / "rec", degradations=Degradations(**dials), **SMALL)
    assert not (tmp_path / "rec").exists()


@pytest.mark.parametrize(
    "bad",
    [
        {"rig": Rig("stereo"), "degradations": Degradations(lens_k1=-0.3)},
        {"rig": Rig("lidar"), "degradations": Degradations(depth_step_m=0.01)},
        {"rig": Rig(exposure_s=0.01), "degradations": Degradations(blur_px=4.0)},
        {"movers": 1, "degradations": Degradations(lens_k1=-0.3)},
    ],
)
def test_dials_that_do_not_go_together_are_refused(tmp_path: Path, bad: dict) -> None:
    with pytest.raises(DuagError, match="expected"):
        simulate(tmp_path / "rec", **bad, **SMALL)
