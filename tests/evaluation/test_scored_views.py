"""How many views of each set maps are scored at, on a run whose every number is known."""

from dataclasses import fields
from inspect import signature
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from duagc.pipeline.cli.runs import evaluate as evaluate_command
from duagc.pipeline.evaluation import evaluate
from duagc.pipeline.evaluation.rendering import MOST_VIEWS, rendering_sections
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.evaluation.views import ViewScore
from tests.fixtures.fake_run import make


@pytest.fixture(scope="module")
def metrics(tmp_path_factory: pytest.TempPathFactory) -> dict:
    fake = make(tmp_path_factory.mktemp("fake"))
    return evaluate(fake.run, fake.recording, progress=False)


def test_few_views_of_a_set_are_scored_if_asked(metrics: dict, tmp_path: Path) -> None:
    fake = make(tmp_path)
    asked = evaluate(fake.run, fake.recording, progress=False, most_views=1)
    for view_set, views in {"held_out": 2, "peers": 2, "training": 2, "team": 4}.items():
        assert asked["rendering"]["fused"][view_set]["views"] == views
    rows = pq.read_table(fake.run / "metrics.parquet").to_pylist()
    scored = {r["frame_index"] for r in rows if r["view_set"] == "fused/held_out"}
    assert scored == {12, None}  # of 4, 12 and 20; None: means
    assert asked["protocol"]["views"] == "at most 1 of a set, evenly spread"
    assert asked["team"] == metrics["team"]


def test_few_keyframes_tell_how_well_maps_repeat_them(metrics: dict, tmp_path: Path) -> None:
    fake = make(tmp_path)
    fused = evaluate(fake.run, fake.recording, progress=False, most_views=5)["rendering"]["fused"]
    assert fused["held_out"]["views"] == metrics["rendering"]["fused"]["held_out"]["views"]
    assert fused["training"]["views"] == 2 * 2 < metrics["rendering"]["fused"]["training"]["views"]


def test_the_command_scores_as_many_views_as_a_run() -> None:
    command = signature(evaluate_command).parameters["views"].default
    assert command == signature(evaluate).parameters["most_views"].default == MOST_VIEWS


def test_means_of_own_and_of_final_maps_are_over_the_same_robots() -> None:
    """A robot that met no other has no map that was trained again: its fused one is final."""
    score = {
        value: ViewScore(**dict.fromkeys([f.name for f in fields(ViewScore)], value))
        for value in (20.0, 30.0, 31.0)
    }
    met = [
        ("own", "held_out", 4, score[30.0]),
        ("fused", "held_out", 4, score[30.0]),
        ("refined", "held_out", 4, score[31.0]),
    ]
    alone = [(kind, "held_out", 4, score[20.0]) for kind in ("own", "fused")]
    found = rendering_sections({"alpha": met, "alpha-2": alone}, longer=False)
    assert [found.team[kind]["held_out"]["views"] for kind in ("own", "fused", "refined")] == [2, 2, 2]
    assert (found.team["own"]["held_out"]["psnr_db"], found.team["refined"]["held_out"]["psnr_db"]) == (
        25.0,
        25.5,
    )
    assert isinstance(found.robots["alpha-2"]["refined"]["held_out"]["psnr_db"], Absent)
    none = rendering_sections({"alpha": alone, "bravo": alone}, longer=False)
    assert none.team["refined"]["held_out"]["views"] == 0
