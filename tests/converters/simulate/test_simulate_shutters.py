"""Rolling shutters, exposures and gains together with a lens, with a second camera, and at the speed of the robots."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.converters.simulate.frames import FrameJob, FrameRenderer, FrameSettings
from duagc.converters.simulate.sensors.degradations import Degradations
from duagc.converters.simulate.sensors.lens import Lens
from duagc.converters.simulate.sensors.rig import BASELINE_M, MovingCamera, Rig
from duagc.converters.simulate.settings import camera_of
from duagc.converters.simulate.simulated_scenes import SimulatedMeshes
from duagc.converters.simulate.team import simulate
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from tests.fixtures.mesh_scenes import some_poses

CAMERA = camera_of((160, 120))


@pytest.mark.parametrize(("k1", "share"), [(-0.3, 0.35), (0.2, 0.6)])
def test_the_stated_readout_is_that_of_the_undistorted_images(k1: float, share: float) -> None:
    lens = Lens(CAMERA, k1)
    _, v, inside = lens.maps()
    rows = np.flatnonzero(inside[:, 80])
    true = v[rows, 80] / 119 - 0.5  # when a pixel of the middle column was read, as a share of the readout
    off, without = (true - slope * (rows / 119 - 0.5) for slope in (lens.rows_per_row, 1.0))
    assert np.abs(off).max() < 0.03
    assert np.sqrt(np.mean(off**2)) < share * np.sqrt(np.mean(without**2))


def test_a_pinhole_is_read_as_long_as_its_lens() -> None:
    assert Lens(CAMERA, 1e-9).rows_per_row == pytest.approx(1.0, abs=1e-6)


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
