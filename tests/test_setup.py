"""`make setup`: an environment without pip is made anew; libraries have the versions of the golden runs."""

import json
import re
import shutil
import subprocess
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from duagc.pipeline.manifest import LIBRARIES

ROOT = Path(__file__).parents[1]
PINNED = [
    line.split("==")
    for line in (ROOT / "constraints.txt").read_text().splitlines()
    if line and not line.startswith("#")
]
PYTHON = """#!/bin/sh
echo "$(basename "$0") $*" >> "{log}"
if [ "$2" = venv ]; then
    rm -rf "$4" && mkdir -p "$4/bin" && cp "$0" "$4/bin/python"
fi
"""


def test_an_environment_without_pip_is_made_anew(tmp_path: Path) -> None:
    for name in ("Makefile", "pyproject.toml", "constraints.txt", "CMakeLists.txt"):
        shutil.copy(ROOT / name, tmp_path / name)
    log, half = tmp_path / "log", tmp_path / ".venv" / "bin" / "python"
    made, python = "python3 -m venv --clear .venv", tmp_path / "python3"
    python.write_text(PYTHON.format(log=log))
    half.parent.mkdir(parents=True)
    half.write_text("#!/bin/sh\nexit 1\n")
    for path in (python, half):
        path.chmod(0o755)
    for _ in range(2):
        (tmp_path / ".venv" / ".set-up").unlink(missing_ok=True)
        subprocess.run(["make", "setup", f"PYTHON={python}"], cwd=tmp_path, check=True, capture_output=True)
        assert log.read_text().splitlines().count(made) == 1  # a sound one stays
    (tmp_path / "build" / "docs-venv" / "bin").mkdir(parents=True)
    python.write_text('#!/bin/sh\ncase "$2" in *version_info*) exit 1;; esac\necho Python 3.9\n')
    done = subprocess.run(
        ["make", "docs", f"PYTHON={python}"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode
    assert "Python 3.9 found, Python 3.11 or later expected" in done.stderr


@pytest.mark.parametrize(("name", "version"), PINNED)
def test_pinned_versions_are_installed_and_those_of_the_project(name: str, version: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert any(re.match(rf"{name}[><=;, ]", dependency) for dependency in project["dependencies"])
    assert metadata.version(name) == version


@pytest.mark.parametrize(
    "path", sorted((ROOT / "tests" / "golden").glob("*.json")), ids=lambda path: path.stem
)
def test_golden_runs_were_made_with_the_pinned_versions(path: Path) -> None:
    libraries = json.loads(path.read_text())["libraries"]
    assert set(libraries) == set(LIBRARIES)
    pinned = {name: version for name, version in PINNED if name in libraries}
    assert len(pinned) == 3
    assert libraries.items() >= pinned.items()
