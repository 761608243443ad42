"""Scales of depth of a team, by features of keyframes that loop closures tie."""

from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from duagc.pipeline.evaluation import depth_scales
from duagc.pipeline.evaluation.network import Session
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.recording import Recording, open_rgbd
from duagc.pipeline.runs.folder import RunFolder


@pytest.mark.parametrize("scale", [1.0, 1.02, 0.95])
def test_depth_that_is_longer_is_found(
    small_run: Path, small_recording: Path, monkeypatch: pytest.MonkeyPatch, scale: float
) -> None:
    @contextmanager
    def scaled(path: Path):
        with open_rgbd(path) as log:
            factor = scale if log.robot == "bravo" else 1.0

            def frame(index: int):
                seen = log.frame(index)
                return replace(seen, depth=seen.depth * factor)

            yield SimpleNamespace(camera=log.camera, frame=frame, move_depth_by=log.move_depth_by)

    monkeypatch.setattr(depth_scales, "open_rgbd", scaled)
    run = RunFolder(small_run)
    found = depth_scales.depth_scales(run, Recording(small_recording), Session(run).loop_closures)
    of_bravo = depth_scales.section(run.robots["bravo"], found)
    assert of_bravo["depth_ratio"] == pytest.approx(scale, abs=0.005)
    assert of_bravo["sigma_depth_ratio"] < 0.01
    assert of_bravo["depth_ratio_closures"] >= depth_scales.FEWEST_CLOSURES
    assert isinstance(depth_scales.section(run.robots["alpha"], found)["depth_ratio"], Absent)
    assert isinstance(depth_scales.section(run.robots["bravo"], {})["depth_ratio"], Absent)


def test_depth_of_another_time_is_moved_as_the_own_front_end_found(
    small_run: Path, small_recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it is read by the front end, and by all else that measures a run."""

    @contextmanager
    def late(path: Path):
        moved_by: list[Path] = []
        with open_rgbd(path) as log:

            def frame(index: int):
                assert moved_by == [small_run / "robots" / log.robot / "frontend.mcap"]
                return log.frame(index)

            yield SimpleNamespace(camera=log.camera, frame=frame, move_depth_by=moved_by.append)

    monkeypatch.setattr(depth_scales, "open_rgbd", late)
    run = RunFolder(small_run)
    found = depth_scales.depth_scales(run, Recording(small_recording), Session(run).loop_closures)
    assert list(found) == ["bravo"]


def test_the_stated_deviation_is_that_of_a_median() -> None:
    """By chance alone the median of so many normal numbers deviates a quarter more than their mean does."""
    draws = 0.02 * np.random.default_rng(0).standard_normal((4000, depth_scales.MOST_CLOSURES))
    found = [depth_scales._median(row.tolist()) for row in draws]
    spread = np.std([np.log(scale.ratio) for scale in found])
    stated = np.sqrt(np.mean([(scale.sigma / scale.ratio) ** 2 for scale in found]))
    assert stated == pytest.approx(spread, rel=0.06)  # a fifth too small without the factor of a median


def test_points_twice_as_far_apart_are_twice_the_scale() -> None:
    points = np.random.default_rng(1).normal(size=(30, 3))
    pair = depth_scales.MatchedPair(0, 1, points, 2.0 * points + [1.0, 0.0, 5.0])
    assert depth_scales._log_ratio(pair) == pytest.approx(np.log(2.0))
