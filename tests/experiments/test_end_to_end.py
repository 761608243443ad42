"""An experiment with real runs: simulated, resumed, and equal to the last byte when everything is computed again."""

from pathlib import Path

import pytest

from duagc.pipeline.batch.engines import LocalEngine
from duagc.pipeline.experiments.carry_out import RESULT, carry_out, read_result
from duagc.pipeline.experiments.pages import PAGE, judge_folder, write_report
from duagc.pipeline.experiments.rule import read_experiment
from tests.experiments.test_rules import FILE

SETTINGS = """
set = [
    "frontend.mapping.max_gaussians=2000",
    "frontend.mapping.iterations=4",
    "frontend.mapping.final_iterations=4",
    "frontend.mapping.final_iterations_view=0",
    "fusion.finetune.steps_per_view=2",
]
"""


@pytest.fixture
def rules(tmp_path: Path) -> Path:
    folder = tmp_path / "rules"
    folder.mkdir()
    text = FILE.replace("[0, 1, 2, 3, 4]", "[1]")
    text = text.replace(
        "frames = 2, width = 32, height = 32 }",
        "frames = 12, width = 160, height = 120 }" + SETTINGS,
    )
    (folder / "mine.toml").write_text(text)
    return folder


def _carry_out(rules: Path, out: Path, store: Path) -> bytes:
    with LocalEngine(1) as engine:
        failed = carry_out(
            read_experiment("mine", rules), "small", out, recordings={}, engine=engine, store=store, log=print
        )
    assert failed == []
    return (out / "mine" / RESULT).read_bytes()


@pytest.mark.slow
def test_an_experiment_computed_twice_is_the_same(rules: Path, tmp_path: Path) -> None:
    first = _carry_out(rules, tmp_path / "a", tmp_path / "store_a")
    assert _carry_out(rules, tmp_path / "b", tmp_path / "store_b") == first
    assert _carry_out(rules, tmp_path / "a", tmp_path / "store_a") == first
    assert "up to date" in (tmp_path / "a" / "mine" / "cells" / "seed_1-lossy-1.log").read_text()
    rows = read_result(tmp_path / "a" / "mine" / RESULT)["rows"]
    assert [row["values"]["exchange.rounds"] is not None for row in rows] == [True, True]
    judged = judge_folder(tmp_path / "a", rules)
    assert judged[0].verdicts[0].word == "not testable here", "one seed shows nothing"
    write_report(tmp_path / "a", judged)
    page = (tmp_path / "a" / PAGE).read_text()
    assert "0 pairs, of which the exact test cannot reach 0.05" in page
    assert "a joint alignment needs at least 2 robots" in page, (
        "what the run says itself: 12 frames join no team"
    )
