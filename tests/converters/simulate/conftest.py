"""A small room of meshes, set up once."""

from __future__ import annotations

from pathlib import Path

import pytest

from duagc.converters.simulate.simulated_scenes import SimulatedMeshes, set_up
from tests.fixtures.mesh_scenes import folder_of


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return folder_of(tmp_path_factory.mktemp("scene") / "flat", "obj")


@pytest.fixture(scope="session")
def stage(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> SimulatedMeshes:
    stage = set_up(str(folder), "y", 0, tmp_path_factory.mktemp("cache"), as_meshes=True)
    assert isinstance(stage, SimulatedMeshes)
    return stage
