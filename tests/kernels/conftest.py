"""Scenes as fixtures."""

import pytest

from tests.kernels.scenes import KINDS, Scene, make_scene


@pytest.fixture(scope="session", params=KINDS)
def scene(request: pytest.FixtureRequest) -> Scene:
    return make_scene(request.param)


@pytest.fixture
def plain() -> Scene:
    return make_scene("plain")
