"""A front end that is killed goes on from its last checkpoint, and no bit of its log is other."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from duagc.converters.simulate.team import simulate
from duagc.pipeline.base.checkpoints import Checkpoints
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.frontend.stage import run_frontend
from duagc.pipeline.recording import RgbdLog, content_digest, read_log
from duagc.schemas import topics
from tests.fixtures.films import walk_around
from tests.frontend import test_depth_times, test_submaps

SMALL = (
    "frontend.mapping.max_gaussians=500",
    "frontend.mapping.iterations=4",
    "frontend.mapping.final_iterations=12",
    "frontend.mapping.final_iterations_view=0",
    "frontend.keyframes.min_overlap=0.85",
)
CONFIG = load_config(RunConfig, overrides=[*SMALL, "frontend.tracking.strides=[2, 1, 1, 1]"]).frontend

_TILES = {"whole_keyframes": 2, "tile_keyframes": 2, "border_keyframes": 1}
TILED = CONFIG.model_copy(
    update={
        "mapping": CONFIG.mapping.model_copy(update=_TILES),
        "keyframes": CONFIG.keyframes.model_copy(update={"min_overlap": 0.98}),  # many of them
    }
)
MOST_KILLS = 100


class KilledError(Exception):
    """In place of a signal."""


@dataclass
class Runs:
    """A front end that is killed again and again."""

    log: Path
    folder: Path
    config: FrontendConfig = CONFIG
    said: list[str] = field(default_factory=list)
    steps: list[str] = field(default_factory=list)

    def run(self, most: float = math.inf) -> str | None:
        """The digest of its log; None if it was killed after so many steps."""
        begin = len(self.steps)

        def report(part: str, done: int, total: int, shown: object) -> None:
            assert 0 <= done <= total
            if len(self.steps) - begin == most:
                raise KilledError
            self.steps.append(part)

        checkpoints = Checkpoints(
            self.folder / "checkpoints",
            say=self.said.append,
            every_s=0.0,
            largest_share=math.inf,
            report=report,
        )
        out = self.folder / "frontend.mcap"
        try:
            run_frontend(self.log, out, self.config, checkpoints=checkpoints)
        except KilledError:
            return None
        return content_digest(out)

    def until_done(self, most: int) -> str:
        """The digest of its log, with so many steps between two kills; each time it must come farther."""
        for _ in range(MOST_KILLS):
            if (found := self.run(most)) is not None:
                return found
        raise AssertionError(f"killed {MOST_KILLS} times without an end: {self.said[-1]}")


def undisturbed(log: Path, config: FrontendConfig, folder: Path) -> tuple[str, int]:
    """Digest and number of steps."""
    steps: list[str] = []
    out = folder / "undisturbed.mcap"
    report = Checkpoints(report=lambda part, done, total, shown: steps.append(part))
    run_frontend(log, out, config, checkpoints=report)
    return content_digest(out), len(steps)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return test_depth_times.write(tmp_path_factory.mktemp("checkpoints") / "recording", 0)


@pytest.fixture(scope="module")
def expected(log: Path) -> tuple[str, int]:
    return undisturbed(log, CONFIG, log.parent)


def test_killed_again_and_again_it_ends_with_the_same_bits(
    log: Path, expected: tuple[str, int], tmp_path: Path
) -> None:
    digest, steps = expected
    runs, between = Runs(log, tmp_path), 7
    assert runs.until_done(between) == digest
    parts = {line.split(":")[0] for line in runs.said}
    assert {"tracking", "alpha.final"} <= parts, runs.said  # both have more steps than lie between two kills
    assert len(runs.steps) <= steps + 2 * (len(runs.steps) // between)  # a kill costs what it falls into


def test_killed_in_any_tile_of_the_map_it_ends_with_the_same_bits(log: Path, tmp_path: Path) -> None:
    digest, _ = undisturbed(log, TILED, tmp_path)
    runs = Runs(log, tmp_path, TILED)
    assert runs.until_done(3) == digest
    for part, least in (("alpha.mapping", 1), ("alpha.final", 10)):
        assert len({line for line in runs.said if line.startswith(f"{part}: goes on")}) >= least, runs.said


def test_every_view_of_a_tile_is_where_its_camera_was(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While its shutter was open; those of other tiles at its border as well as its own."""
    asked: list[int] = []
    monkeypatch.setattr(RgbdLog, "moments", lambda _, index: asked.append(index))
    run_frontend(log, tmp_path / "frontend.mcap", TILED)
    topic = topics.KEYFRAME.of("alpha")
    frames = {record.message().frame_index for record in read_log(tmp_path / "frontend.mcap", (topic,))}
    assert {asked.count(frame) for frame in frames} >= {1, 2}


def test_killed_while_tracking_by_rendering_it_ends_with_the_same_bits(log: Path, tmp_path: Path) -> None:
    """The map that frames are tracked by is made again from the images of its keyframes."""
    settings = (
        "frontend.tracking.method=rendering",
        "frontend.tracking.strides=[2, 1, 1, 1]",
        "frontend.tracking.rendering.steps=8",
        "frontend.tracking.rendering.keyframe_steps=6",
        "frontend.keyframes.max_rotation_rad=0.03",  # some keyframes
        "frontend.mapping_enabled=false",
    )
    config = load_config(RunConfig, overrides=settings).frontend
    digest, _ = undisturbed(log, config, tmp_path)
    runs = Runs(log, tmp_path, config)
    assert runs.until_done(5) == digest
    assert {"tracking: goes on at 5/14", "tracking: goes on at 10/14"} <= set(runs.said), runs.said


def test_what_is_damaged_is_named_and_computed_again(
    log: Path, expected: tuple[str, int], tmp_path: Path
) -> None:
    runs = Runs(log, tmp_path)
    assert runs.run(expected[1] - 14) is None
    for path in (tmp_path / "checkpoints").iterdir():
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 4
        path.write_bytes(data)
    assert runs.run() == expected[0]
    assert any("has digest" in line and "computed again" in line for line in runs.said), runs.said


def test_without_room_it_says_so_once_and_goes_on(
    log: Path, expected: tuple[str, int], tmp_path: Path
) -> None:
    (tmp_path / "checkpoints").write_text("a file in the place of the folder")
    runs = Runs(log, tmp_path)
    assert runs.run() == expected[0]
    assert [line for line in runs.said if "without checkpoints" in line] == runs.said
    assert len(runs.said) == 1


def late_depth(folder: Path) -> tuple[Path, FrontendConfig]:
    """Depth of other times than color, and none at first: tracked twice, and backward."""
    return test_depth_times.write(folder / "late", 5, 14_000_000, early=True), test_depth_times.CONFIG


def covered_lens(folder: Path) -> tuple[Path, FrontendConfig]:
    """Lost twice; two submaps that are joined."""
    shots, _ = walk_around(0)
    return test_submaps.write(folder / "cut", test_submaps.covered(shots)), test_submaps.CONFIG


def noisy_depth(folder: Path) -> tuple[Path, FrontendConfig]:
    """Poses refined with the map, and frames registered to it."""
    simulate(folder / "noisy", robots=2, frames=24, size=(160, 120), seed=2, overlap=0.9, workers=1)
    settings = ["frontend.mapping.depth=blended", "frontend.exposure.mode=on", *SMALL]
    return folder / "noisy" / "alpha.mcap", load_config(RunConfig, overrides=settings).frontend


CASES = [
    pytest.param(make, most, marks=() if (make, most) == (late_depth, 2) else pytest.mark.slow)
    for make in (late_depth, covered_lens, noisy_depth)
    for most in (2, 7, 40)
]


@pytest.mark.parametrize(("make", "most"), CASES)
def test_at_every_step_of_any_log(
    make: Callable[[Path], tuple[Path, FrontendConfig]], most: int, tmp_path: Path
) -> None:
    """Of two steps one is saved at least: `keyframes` is a step of every run, and no checkpoint."""
    log, config = make(tmp_path)
    digest, steps = undisturbed(log, config, tmp_path)
    runs = Runs(log, tmp_path, config)
    found = None
    for _ in range(2 * steps):
        if (found := runs.run(most)) is not None:
            break
    assert found == digest
