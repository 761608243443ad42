"""`duagc bench robustness --true-images`: what plain PSNR a dial leaves to any map of one appearance."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from duagc.pipeline.bench import robustness, true_images
from duagc.pipeline.cli import app

PLAN = robustness.RobustnessPlan(dials=("exposure",), frames=14, size=(32, 32), robots=1)


def moments(*pairs: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Of views [n, 3] as they are, and as they are shown."""
    return np.array([[(a * b).mean(axis=0) for a, b in ((x, x), (x, y), (y, y))] for x, y in pairs])


def views(count: int) -> list[np.ndarray]:
    return [np.random.default_rng(seed).uniform(0.1, 0.6, (400, 3)) for seed in range(count)]


def test_one_gain_of_all_views_is_no_error() -> None:
    gains = np.array([1.3, 0.9, 1.1])
    assert true_images.best_psnr_db(moments(*((x, gains * x) for x in views(3)))) == np.inf


def test_an_error_of_a_map_is_all_that_is_left_of_equal_images() -> None:
    found = true_images.best_psnr_db(moments(*((x, x) for x in views(2))), error=10**-3.6)
    assert found == pytest.approx(36.0, abs=1e-6)


def test_no_other_gain_is_better() -> None:
    shown = [(x, gain * x) for x, gain in zip(views(4), (0.8, 0.95, 1.0, 1.3), strict=True)]
    best = true_images.best_psnr_db(moments(*shown), error=1e-4)

    def mean_db(gain: float) -> float:
        return float(np.mean([-10 * np.log10(np.mean((gain * x - y) ** 2) + 1e-4) for x, y in shown]))

    tried = [mean_db(gain) for gain in np.linspace(0.7, 1.4, 71)]
    assert max(tried) - 1e-6 <= best < max(tried) + 0.5  # a gain of its own for each channel


def test_images_of_the_dial_are_compared_with_those_of_the_clean_walk(tmp_path: Path) -> None:
    (tmp_path / "cells").mkdir()
    measured = {"plan": robustness._plain(PLAN), "row": {"psnr_db": 36.0}}
    (tmp_path / "cells" / "clean.json").write_text(json.dumps(measured))
    rows = true_images.run(PLAN, tmp_path, workers=1)
    assert [(row["dial"], row["views"], row["bound_db"]) for row in rows] == [("exposure", 2, 33.0)]
    assert 20 < rows[0]["as_good_as_clean_db"] < min(36.0, rows[0]["true_images_db"])
    assert f"{rows[0]['true_images_db']:.2f}" in true_images.format_table(rows)


def test_a_clean_cell_of_another_walk_says_nothing(tmp_path: Path) -> None:
    (tmp_path / "cells").mkdir()
    for kept in ({"plan": robustness._plain(PLAN) | {"seed": 7}, "row": {"psnr_db": 36.0}}, {}):
        (tmp_path / "cells" / "clean.json").write_text(json.dumps(kept))
        assert robustness.finished_row(tmp_path, robustness.Cell(robustness.CLEAN, 0.0), PLAN) is None


def test_a_dial_that_changes_what_is_seen_is_refused(tmp_path: Path) -> None:
    options = ["bench", "robustness", "--true-images", "--only", "lens", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, options)
    assert result.exit_code == 2
    assert "exposure" in result.output
    assert not list(tmp_path.iterdir())
