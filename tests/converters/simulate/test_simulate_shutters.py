"""Motion blur and rolling shutters: the law of each dial, and both together with others and at the robots' speed."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.converters.simulate.frames import FrameJob, FrameRenderer, FrameSettings
from duagc.converters.simulate.render.raycast import MeshRenderer
from duagc.converters.simulate.sensors import shutter
from duagc.converters.simulate.sensors.degradations import Degradations
from duagc.converters.simulate.sensors.lens import RadialLens
from duagc.converters.simulate.sensors.rig import BASELINE_M, GAMMA, MovingCamera, Rig
from duagc.converters.simulate.settings import camera_of
from duagc.converters.simulate.simulated_scenes import SimulatedMeshes
from duagc.converters.simulate.team import simulate
from duagc.converters.simulate.trajectories.moments import twists_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from tests.fixtures.mesh_scenes import some_poses

CAMERA = camera_of((160, 120))
WALL_M = 2.0
SIDEWAYS = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
PIXELS_A_SECOND = CAMERA.fx * SIDEWAYS[0] / WALL_M


class HalfWhiteWall(MeshRenderer):
    """A wall two meters ahead, black on the left of x = 0 and white on its right."""

    def __init__(self) -> None:
        self.camera = CAMERA

    def shade(self, origins, directions):
        t = (WALL_M - np.broadcast_to(origins, directions.shape)[:, 2]) / directions[:, 2]
        x = np.broadcast_to(origins, directions.shape)[:, 0] + t * directions[:, 0]
        return t.astype(np.float32), np.repeat(255.0 * (x > 0), 3).reshape(-1, 3).astype(np.float32)

    def depth(self, T_world_camera):
        return np.full((self.camera.height, self.camera.width), WALL_M), None


def edge_columns(image: np.ndarray) -> np.ndarray:
    """Column (px) of the step from black to white in every row of an image [h, w, 3], as if it were sharp."""
    whiteness = (image[..., 0] / 255.0) ** GAMMA
    return image.shape[1] - 0.5 - whiteness.sum(axis=1)


@pytest.mark.parametrize("blur_px", [2.0, 5.0, 8.0])
def test_a_blurred_edge_is_as_wide_as_the_dial_says(blur_px: float) -> None:
    wall = HalfWhiteWall()
    exposure_s = shutter.exposure_for(
        blur_px, wall, [np.tile(np.eye(4), (3, 1, 1))], [[SIDEWAYS] * 3], camera=CAMERA
    )
    assert exposure_s == pytest.approx(blur_px / PIXELS_A_SECOND, rel=1e-3)
    camera = MovingCamera(wall, Rig(exposure_s=exposure_s), [], blur_px=blur_px)
    image = camera.render(np.eye(4), SIDEWAYS, 0)[0].color[60, :, 0]
    partly = np.flatnonzero((image > 0) & (image < 255))
    assert abs(len(partly) - blur_px) <= 1.5
    falling = (image[partly] / 255.0) ** GAMMA  # light, not image values, grows evenly across the edge
    expected = (partly - partly[0] + 0.5) / len(partly)
    assert np.abs(falling - expected).max() < 1 / blur_px


def test_the_blur_of_a_recording_is_that_of_the_median_frame(stage: SimulatedMeshes) -> None:
    small, poses = stage.renderer(CAMERA.scaled(40, 30)), some_poses()
    paths = [
        np.stack([T @ se3.exp(k * np.array([0.02, 0, 0.01, 0, 0.01, 0])) for k in range(4)]) for T in poses
    ]
    twists = [twists_of(path) for path in paths]
    exposure_s = shutter.exposure_for(6.0, small, paths, twists, camera=CAMERA)
    moved = [
        shutter.pixel_speed_px_s(small, T, twist, CAMERA) * exposure_s
        for path, many in zip(paths, twists, strict=True)
        for T, twist in zip(path, many, strict=True)
    ]
    assert np.median(moved) == pytest.approx(6.0, rel=1e-6)
    assert min(moved) < 6.0 < max(moved)


def test_every_row_of_a_rolling_shutter_is_read_later_by_the_readout_over_the_rows() -> None:
    camera = MovingCamera(HalfWhiteWall(), Rig(readout_s=0.03), [])
    T = se3.exp(np.array([-0.001, 0, 0, 0, 0, 0]))
    moving = edge_columns(camera.render(T, 20 * SIDEWAYS, 0)[0].color)
    rows = np.arange(CAMERA.height)
    drift_px_a_row = np.polyfit(rows, moving, 1)[0]
    assert drift_px_a_row == pytest.approx(-20 * PIXELS_A_SECOND * 0.03 / (CAMERA.height - 1), rel=0.02)
    still = edge_columns(camera.render(T, np.zeros(6), 0)[0].color)
    assert moving[59:61].mean() == pytest.approx(
        still[59:61].mean(), abs=0.6
    )  # the pose is that of the middle row


def test_nothing_that_stands_still_is_blurred() -> None:
    still = [np.tile(np.eye(4), (3, 1, 1))]
    with pytest.raises(DuagError, match="expected robots that move"):
        shutter.exposure_for(8.0, HalfWhiteWall(), still, [np.zeros((3, 6))], camera=CAMERA)


@pytest.mark.parametrize(("k1", "share"), [(-0.3, 0.35), (0.2, 0.6)])
def test_the_stated_readout_is_that_of_the_undistorted_images(k1: float, share: float) -> None:
    lens = RadialLens(CAMERA, k1)
    _, v, inside = lens.maps()
    rows = np.flatnonzero(inside[:, 80])
    true = v[rows, 80] / 119 - 0.5  # when a pixel of the middle column was read, as a share of the readout
    off, without = (true - slope * (rows / 119 - 0.5) for slope in (lens.rows_per_row, 1.0))
    assert np.abs(off).max() < 0.03
    assert np.sqrt(np.mean(off**2)) < share * np.sqrt(np.mean(without**2))


def test_a_pinhole_is_read_as_long_as_its_lens() -> None:
    assert RadialLens(CAMERA, 1e-9).rows_per_row == pytest.approx(1.0, abs=1e-6)


def test_the_right_camera_turns_about_the_left_one(
    stage: SimulatedMeshes, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = camera_of((64, 48))
    renderer = FrameRenderer(
        stage, FrameSettings(camera, "none", 0, Rig("stereo", 0.03), [], (), Degradations())
    )
    seen: list[tuple[np.ndarray, np.ndarray]] = []
    render = MovingCamera.render

    def watched(self, T, twist, frame):
        seen.append((T, twist))
        return render(self, T, twist, frame)

    monkeypatch.setattr(MovingCamera, "render", watched)
    T, twist = some_poses()[0], np.array([0.5, -0.2, 0.3, 0.4, 0.6, -0.3])
    renderer.render(FrameJob("alpha", 0, T, twist))
    (left, left_twist), (right, right_twist) = seen
    T_left_right = np.eye(4)
    T_left_right[0, 3] = BASELINE_M
    for time_s in (-0.015, 0.0, 0.015):
        held = left @ se3.exp(time_s * left_twist) @ T_left_right
        assert right @ se3.exp(time_s * right_twist) == pytest.approx(held, abs=1e-12)


def test_blur_that_takes_too_long_an_exposure_is_refused(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "rec"
    with pytest.raises(
        DuagError, match=r"motion blur of 60 px takes an exposure of .* s .*, expected at most 1 s"
    ):
        simulate(
            out,
            scene=str(folder),
            robots=1,
            frames=4,
            size=(32, 32),
            workers=1,
            degradations=Degradations(blur_px=60.0),
        )
    assert not out.exists()


def test_a_recording_states_one_gain_for_each_of_its_frames(folder: Path, tmp_path: Path) -> None:
    of_all: dict[str, Any] = {"scene": str(folder), "robots": 1, "frames": 10, "size": (32, 32), "workers": 1}
    rig = Rig(gain_stops=1.0)
    whole, few = tmp_path / "whole", tmp_path / "few"
    simulate(whole, rig=rig, **of_all)
    simulate(few, rig=rig, degradations=Degradations(missing=0.4), **of_all)
    (gains, _), (some, kept) = (
        (checks["exposure_gain"]["alpha"], checks.get("frames_of_path", {}).get("alpha"))
        for checks in (json.loads((out / "recording.json").read_text())["checks"] for out in (whole, few))
    )
    assert len(kept) == 6
    assert some == [gains[k] for k in kept]
