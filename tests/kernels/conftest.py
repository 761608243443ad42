"""Scenes and rasterizers as fixtures."""

import pytest

from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.kernels.reference import ReferenceRasterizer
from tests.kernels.scenes import KINDS, Scene, make_scene


@pytest.fixture(scope="session", params=KINDS)
def scene(request: pytest.FixtureRequest) -> Scene:
    return make_scene(request.param)


@pytest.fixture
def plain() -> Scene:
    return make_scene("plain")


@pytest.fixture(params=[ReferenceRasterizer, Rasterizer], ids=lambda implementation: implementation.__name__)
def rasterizer(request: pytest.FixtureRequest) -> ReferenceRasterizer | Rasterizer:
    return request.param()
