"""Settings that every test shares; they must be in place before numpy is imported."""

import os
from collections.abc import Iterator
from functools import lru_cache

import pytest

from duagc.pipeline.base import determinism

determinism.configure_determinism()
# Threads of the kernels sleep while they wait for each other: the images of tests are so small that most of their time
# would be waiting, and a thread that waits awake counts as processor time.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.pop("DUAGC_STORE", None)  # runs of tests keep their results next to them

pytest_plugins = ["tests.budget", "tests.distribution", "tests.fixtures.small_run"]


@pytest.fixture(scope="session", autouse=True)
def baked_rooms() -> Iterator[None]:
    """The procedural room of a seed is baked once for all recordings that tests simulate in it."""
    from duagc.converters.simulate import simulated_scenes
    from duagc.converters.simulate.render.bake import Atlas, bake
    from duagc.converters.simulate.scenes.catalog import build
    from duagc.converters.simulate.simulated_scenes import ROOM, SimulatedRoom

    @lru_cache(maxsize=3)
    def atlas_of(seed: int) -> Atlas:
        atlas = bake(build("room", seed), ROOM.texel_m)
        for level in atlas.levels:
            level.flags.writeable = False
        return atlas

    class BakedRoom(SimulatedRoom):
        def __init__(self, seed: int, atlas: Atlas | None = None) -> None:
            super().__init__(seed, atlas_of(seed) if atlas is None else atlas)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulated_scenes, "SimulatedRoom", BakedRoom)
        yield
