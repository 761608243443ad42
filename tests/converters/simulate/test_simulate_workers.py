"""The bytes of a simulated recording do not depend on the number of processes that render it."""

from pathlib import Path
from typing import Any

import pytest

from duagc.converters.simulate.team import simulate
from tests.converters.simulate.conftest import ALL_DEGRADATIONS, ALL_SENSORS
from tests.fixtures.mesh_scenes import folder_of


def check_two_workers(one: Path, two: Path, **settings: Any) -> None:
    """`one` was written by one worker; its preview, if it has one, lies next to it."""
    preview = {"preview": two.with_suffix(".png")} if one.with_suffix(".png").exists() else {}
    simulate(two, workers=2, **preview, **settings)
    names = sorted(path.name for path in one.iterdir())
    assert names == sorted(path.name for path in two.iterdir())
    assert len(names) >= 4
    for name in names:
        assert (one / name).read_bytes() == (two / name).read_bytes(), name
    if preview:
        assert one.with_suffix(".png").read_bytes() == two.with_suffix(".png").read_bytes()


def test_with_all_sensors_and_movers(folder: Path, all_sensors: Path, tmp_path: Path) -> None:
    check_two_workers(all_sensors, tmp_path / "rec", scene=str(folder), **ALL_SENSORS)


@pytest.mark.slow
def test_with_all_degradations(folder: Path, all_degradations: Path, tmp_path: Path) -> None:
    check_two_workers(all_degradations, tmp_path / "rec", scene=str(folder), **ALL_DEGRADATIONS)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["glb", "ply"])
def test_of_other_files(tmp_path: Path, kind: str) -> None:
    scene = str(folder_of(tmp_path / "flat", kind))
    settings = {"scene": scene, "frames": 3, "size": (64, 48), "noise": "kinect", "seed": 2}
    simulate(tmp_path / "one" / "rec", workers=1, **settings)
    check_two_workers(tmp_path / "one" / "rec", tmp_path / "two" / "rec", **settings)


@pytest.mark.slow
def test_in_the_room(tmp_path: Path) -> None:
    settings = {"frames": 5, "size": (160, 120), "noise": "kinect", "seed": 7}
    simulate(tmp_path / "one" / "rec", workers=1, **settings)
    check_two_workers(tmp_path / "one" / "rec", tmp_path / "two" / "rec", **settings)
