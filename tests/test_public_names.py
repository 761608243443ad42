"""The names of the package: they exist, load late, and say what they take."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import duagc
from tests.fixtures import fake_run

FUNCTIONS_AND_CLASSES = sorted(name for name in duagc.__all__ if not inspect.ismodule(getattr(duagc, name)))


def parameters_of(thing: object) -> list[str]:
    """Parameters that a caller gives; of a class those of its own constructor."""
    if inspect.isclass(thing):
        if "__init__" not in vars(thing) or hasattr(thing, "__dataclass_fields__"):
            return []
        thing = thing.__init__
    return [p for p in inspect.signature(thing).parameters if p != "self"]  # type: ignore[arg-type]


def documentation_of(thing: object) -> str:
    own = inspect.getdoc(thing) or ""
    if inspect.isclass(thing) and "__init__" in vars(thing):
        own += "\n" + (inspect.getdoc(thing.__init__) or "")
    return own


@pytest.mark.parametrize("name", FUNCTIONS_AND_CLASSES)
def test_every_parameter_of_a_public_name_has_a_line_of_its_own(name: str) -> None:
    thing = getattr(duagc, name)
    text = documentation_of(thing)
    assert text, f"duagc.{name} has no docstring"
    documented = re.findall(r"^ {4,}(\w+): \S", text, re.MULTILINE)
    missing = [p for p in parameters_of(thing) if p not in documented]
    assert not missing, f"duagc.{name}: Args: lacks a line for {', '.join(missing)}"


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
