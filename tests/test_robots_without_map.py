"""A robot of whose log no map can be begun: the others are mapped, and what is missing is said."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import pytest

from duagc.converters.simulate.settings import Cover
from duagc.converters.simulate.team import simulate
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.unmapped import NothingToMapError, Unmapped
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.evaluation.coverage import lost_stretches
from duagc.pipeline.runner import run
from duagc.pipeline.runs.folder import RunFolder
from tests.fixtures.small_run import SMALL

FRAMES = 12


def covered(out: Path, *robots: str, size: tuple[int, int] = (160, 120)) -> Path:
    """A recording of a team of two in which these robots see nothing."""
    covers = tuple(Cover(robot, 0, FRAMES) for robot in robots)
    simulate(out, robots=2, frames=FRAMES, size=size, seed=1, covers=covers, workers=1)
    return out


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A run whose robot bravo sees nothing, and what it said."""
    folder, said = tmp_path_factory.mktemp("unmapped"), list[str]()
    recording, config = covered(folder / "recording", "bravo"), load_config(RunConfig, overrides=SMALL)
    run(recording, folder / "run", config, store=folder / "store", log=said.append)
    return folder / "run", said


def test_the_others_are_mapped(finished: tuple[Path, list[str]]) -> None:
    folder, said = finished
    assert list(RunFolder(folder).robots) == ["alpha"]
    assert [line for line in said if "bravo.mcap" in line and line.endswith("goes on without bravo")]
    assert (folder / "robots" / "alpha" / "fused.mcap").is_file()
    assert not (folder / "robots" / "bravo").exists()
    assert (folder / "run.rrd").is_file()


def test_the_metrics_count_it(finished: tuple[Path, list[str]]) -> None:
    metrics = json.loads((finished[0] / "metrics.json").read_text())
    row = {
        "frames": FRAMES,
        "frames_without_pixel": FRAMES,
        "posed": 0,
        "coverage": None,
        "submaps": 0,
        "components": 0,
    }
    assert metrics["coverage"]["bravo"] == row
    assert metrics["team"]["robots"] == 2
    assert list(metrics["robots"]) == list(metrics["components"]) == ["alpha"]
    lost = lost_stretches(RunFolder(finished[0]))
    assert [(s.robot, s.first, s.last, s.reason) for s in lost] == [("bravo", 0, FRAMES - 1, "no_pixel")]
    assert "bravo" in (finished[0] / "report" / "index.html").read_text()


def test_a_finished_run_of_it_is_up_to_date(finished: tuple[Path, list[str]]) -> None:
    folder, said = finished[0], list[str]()
    config = load_config(RunConfig, overrides=SMALL)
    run(folder.with_name("recording"), folder, config, store=folder.with_name("store"), log=said.append)
    assert said == [f"{folder}: up to date"]


def test_no_robot_with_a_map_is_an_error(tmp_path: Path) -> None:
    said = list[str]()
    recording, config = (
        covered(tmp_path / "recording", "alpha", "bravo"),
        load_config(RunConfig, overrides=SMALL),
    )
    with pytest.raises(DuagError, match=r"alpha\.mcap: found no frame of 160 x 120 pixels .*\(no_pixel\)"):
        run(recording, tmp_path / "run", config, log=said.append)
    assert not [line for line in said if "goes on without" in line]
    assert not (tmp_path / "run").exists()


def test_images_that_are_too_small_are_named_as_the_cause(tmp_path: Path) -> None:
    recording, config = (
        covered(tmp_path / "recording", size=(48, 36)),
        load_config(RunConfig, overrides=SMALL),
    )
    with pytest.raises(DuagError, match=r"found images of 48 x 36 pixels, .* expected larger ones"):
        run(recording, tmp_path / "run", config, log=lambda line: None)


def test_a_changed_manifest_is_an_error() -> None:
    with pytest.raises(DuagError, match=r"manifest\.json: found .* expected a table of duration_s"):
        Unmapped.of({"frames": 3}, "manifest.json")


def test_the_error_reaches_another_process() -> None:
    unmapped = Unmapped(3, 1, 0.1, ("no_depth",), "found nothing")
    error = pickle.loads(pickle.dumps(NothingToMapError(Path("alpha.mcap"), unmapped)))
    assert str(error) == "alpha.mcap: found nothing"
    assert error.unmapped == unmapped
