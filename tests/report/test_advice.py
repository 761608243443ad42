"""A run of inexact cameras advises to calibrate them; one of exact cameras, or calibrated ones, does not."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from duagc.pipeline.exchange.verification import Verdict
from duagc.pipeline.report import advice
from duagc.pipeline.report.advice import (
    FEWEST_PAIRS,
    calibration_advice,
    depth_scale_advice,
    joining_advice,
    moved_advice,
    truth_advice,
)


def run_of(calibration: tuple[str, ...] = (), pairs: int = 40, **off_px: float | None) -> Any:
    robots = {
        name: {"feature_agreement_px": off, "feature_agreement_pairs": pairs} for name, off in off_px.items()
    }
    return SimpleNamespace(metrics={"robots": robots}, calibration=list(calibration))


@pytest.fixture
def source(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(advice, "_by_lidar", lambda source, name: name in source.lidar)
    return SimpleNamespace(calibration=[], lidar=())


def test_robots_whose_features_are_apart_are_named(source: Any) -> None:
    said = calibration_advice(run_of(alpha=1.71, bravo=0.62, charlie=2.13), source)
    assert "1.7 px (alpha), 2.1 px (charlie)" in said
    assert "bravo" not in said
    assert "--calibrate" in said


@pytest.mark.parametrize(
    "run",
    [
        run_of(alpha=0.64),
        run_of(alpha=None),
        run_of(alpha=2.0, pairs=FEWEST_PAIRS - 1),
        run_of(alpha=2.0, calibration=("alpha: kept as recorded",)),
    ],
    ids=["exact cameras", "no pairs", "few pairs", "was asked for"],
)
def test_nothing_is_advised(run: Any, source: Any) -> None:
    assert calibration_advice(run, source) == ""


def test_a_calibrated_recording_and_a_lidar_are_left_alone(source: Any) -> None:
    run = run_of(alpha=2.0)
    assert calibration_advice(run, source) != ""
    source.lidar = ("alpha",)
    assert calibration_advice(run, source) == ""
    source.lidar, source.calibration = (), ["alpha: calibrated"]
    assert calibration_advice(run, source) == ""


def test_robots_whose_depth_is_longer_are_named() -> None:
    scales = {"alpha": None, "bravo": 1.021, "charlie": 1.009, "delta": 0.95}
    robots = {
        name: {"depth_scale": {"depth_ratio": s, "sigma_depth_ratio": 0.003}} for name, s in scales.items()
    }
    said = depth_scale_advice(SimpleNamespace(metrics={"robots": robots}))
    assert "bravo measures 1.021 ± 0.003 times the distances, delta measures 0.950 ± 0.003 times" in said
    assert "alpha" not in said
    assert "charlie" not in said
    assert depth_scale_advice(SimpleNamespace(metrics={"robots": {"alpha": {}}})) == ""


@pytest.mark.parametrize(
    ("own_m", "joint_m", "said"),
    [
        (
            0.001,
            1.376,
            "alpha and bravo agree with the ground truth to 1 mm each by itself, and to 1.38 m together",
        ),
        (0.001, 0.09, ""),
        (0.2, 0.5, ""),
        (None, None, ""),
    ],
)
def test_truth_that_fits_each_robot_and_not_the_team_is_said(own_m: Any, joint_m: Any, said: str) -> None:
    errors = {"ate_rmse_m": own_m, "ate_rmse_m_joint": joint_m}
    run = SimpleNamespace(metrics={"robots": {"alpha": errors, "bravo": errors, "charlie": {}}})
    assert truth_advice(run).startswith(said)
    assert bool(truth_advice(run)) == bool(said)


def test_robots_between_whose_views_something_moved_are_named() -> None:
    def decided(robot: str, peer: str, verdict: Verdict) -> SimpleNamespace:
        return SimpleNamespace(robot=robot, peer=peer, verdict=verdict.value)

    decisions = [decided("bravo", "alpha", Verdict.SOMETHING_MOVED)] * 3
    decisions += [decided("bravo", "charlie", Verdict.KEPT), decided("alpha", "charlie", Verdict.MOVED)]
    said = moved_advice(SimpleNamespace(loop_closures=decisions))
    assert "the views of alpha and bravo (3)" in said
    assert "charlie" not in said
    assert moved_advice(SimpleNamespace(loop_closures=decisions[3:])) == ""


def test_maps_that_were_not_joined_are_named(tmp_path: Path) -> None:
    components = {"alpha": ("alpha", "bravo"), "alpha-2": ("alpha-2",), "bravo": ("alpha", "bravo")}
    robots = {name: SimpleNamespace(component=names, folder=tmp_path) for name, names in components.items()}
    run: Any = SimpleNamespace(robots=robots)
    assert joining_advice(run) == "", "nothing is fused yet"
    (tmp_path / "fused.mcap").touch()
    assert "Not in one frame of the world: alpha, bravo; alpha-2." in joining_advice(run)
    del robots["alpha-2"]
    assert joining_advice(run) == ""
