"""The sequence that the tests of 7-Scenes convert."""

import shutil
from pathlib import Path

import pytest

from tests.fixtures.seven_scenes import make_sequence


@pytest.fixture(scope="session")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sequence(tmp_path_factory.mktemp("scene") / "seq-01")


@pytest.fixture
def broken(sequence: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    shutil.copytree(sequence, tmp_path / "seq-01")
    return tmp_path / "seq-01"
