"""The names of the package: they exist, and load late."""

import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import duagc
from tests.fixtures import fake_run


@pytest.mark.parametrize(
    "name", sorted(name for name in duagc.__all__ if inspect.ismodule(getattr(duagc, name)))
)
def test_a_module_may_be_the_first_name_that_is_used(name: str) -> None:
    subprocess.run([sys.executable, "-c", f"from duagc import {name}"], check=True)


def test_the_package_imports_nothing_heavy() -> None:
    heavy = {"numpy", "torch", "cv2", "rerun", "open3d", "scipy", "mcap", "pydantic"}
    code = f"import sys, duagc; print(sorted({heavy} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="Rasteriser"):
        duagc.Rasteriser  # noqa: B018


def test_places_may_be_texts(tmp_path: Path) -> None:
    fake = fake_run.make(tmp_path)
    run = str(fake.run)
    assert list(duagc.RunFolder(run).robots) == ["alpha", "bravo"]
    odometry = f"{run}/robots/alpha/odometry.tum"
    duagc.write_tum(f"{run}/copy.tum", duagc.read_tum(odometry))
    assert len(duagc.read_tum(f"{run}/copy.tum").poses) == len(duagc.read_tum(Path(odometry)).poses)
    assert duagc.digest(odometry) == duagc.digest(Path(odometry))
    assert duagc.load_config(duagc.RunConfig, f"{run}/config.toml").seed == 0
    assert duagc.evaluate(run, str(fake.recording), progress=False)["schema"] == 2
    with pytest.raises(duagc.DuagError, match=r"fused\.ply: No such file"):
        duagc.replay(run, str(fake.recording), ["alpha"], print)
    with pytest.raises(duagc.DuagError, match="exists already"):
        duagc.run(str(fake.recording), run, duagc.RunConfig(), store=str(tmp_path / "store"))
    with pytest.raises(duagc.DuagError, match="config is of type dict, expected a RunConfig"):
        duagc.run(fake.recording, tmp_path / "out", {})  # type: ignore[arg-type]
    with pytest.raises(duagc.DuagError, match="config: seed is -1, expected 0 or more"):
        duagc.run(fake.recording, tmp_path / "out", duagc.RunConfig(seed=-1))
    with pytest.raises(duagc.DuagError, match="workers is '2', expected a whole number, 1 or more"):
        duagc.run(fake.recording, tmp_path / "out", duagc.RunConfig(), workers="2")  # type: ignore[arg-type]
