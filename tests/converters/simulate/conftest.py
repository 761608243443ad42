"""A small room of meshes, set up once, and recordings in it with everything that can be wrong with a sensor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from duagc.converters.simulate.sensors.degradations import Degradations
from duagc.converters.simulate.sensors.rig import Rig
from duagc.converters.simulate.simulated_scenes import SimulatedMeshes, set_up
from duagc.converters.simulate.team import simulate
from tests.fixtures.mesh_scenes import folder_of

ALL_SENSORS: dict[str, Any] = {
    "frames": 2,
    "size": (64, 48),
    "rig": Rig("lidar", readout_s=0.02, exposure_s=0.01, gain_stops=1.0, clock_s=0.2),
    "movers": 1,
}
ALL_DEGRADATIONS: dict[str, Any] = {
    "frames": 6,
    "size": (64, 48),
    "noise": "kinect",
    "rig": Rig(readout_s=0.03),
    "degradations": Degradations(
        auto_exposure=0.3,
        white_balance=0.15,
        vignette=0.4,
        blur_px=4.0,
        lens_k1=-0.3,
        depth_step_m=0.01,
        depth_delay_s=0.03,
        missing=0.2,
        rate_hz=20.0,
    ),
}


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return folder_of(tmp_path_factory.mktemp("scene") / "flat", "obj")


@pytest.fixture(scope="session")
def stage(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> SimulatedMeshes:
    stage = set_up(str(folder), "y", 0, tmp_path_factory.mktemp("cache"), as_meshes=True)
    assert isinstance(stage, SimulatedMeshes)
    return stage


@pytest.fixture(scope="session")
def all_sensors(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of one worker, next to a preview."""
    out = tmp_path_factory.mktemp("sensors") / "rec"
    simulate(out, scene=str(folder), workers=1, preview=out.with_suffix(".png"), **ALL_SENSORS)
    return out


@pytest.fixture(scope="session")
def all_degradations(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of one worker, next to a preview."""
    out = tmp_path_factory.mktemp("degradations") / "rec"
    simulate(out, scene=str(folder), workers=1, preview=out.with_suffix(".png"), **ALL_DEGRADATIONS)
    return out
