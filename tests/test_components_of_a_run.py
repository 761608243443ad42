"""A whole run of a robot that is carried, lens covered, into another room: two components, both delivered."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.replay import replay
from duagc.pipeline.runner import run
from duagc.pipeline.runs.folder import RunFolder
from tests.fixtures.films import SMALL, walk_around

FIRST, HIDDEN, SECOND = 16, 8, 21  # a camera hidden for less than 0.2 s cannot be elsewhere
SETTINGS = (
    "frontend.mapping.max_gaussians=2000",
    "frontend.mapping.iterations=4",
    "frontend.mapping.final_iterations=4",
    "frontend.mapping.final_iterations_view=0",
)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("components") / "recording"
    here, there = walk_around(0), walk_around(5)
    shots = [*here[0][:FIRST], *here[0][:HIDDEN], *there[0][:SECOND]]
    poses = [*here[1][:FIRST], *here[1][:HIDDEN], *there[1][:SECOND]]
    with RecordingWriter(out) as writer, writer.robot("alpha", SMALL, 0.0005) as robot:
        for k, (shot, T) in enumerate(zip(shots, poses, strict=True)):
            if FIRST <= k < FIRST + HIDDEN:
                shot = replace(shot, color=np.zeros_like(shot.color), depth=np.zeros_like(shot.depth))
            png = cv2.imencode(".png", shot.color[..., ::-1])[1].tobytes()
            depth = np.rint(shot.depth / 0.0005).astype(np.uint16)
            robot.add_frame(k * 33_333_333, png, "png", depth, T_world_camera=T)
    return out


@pytest.fixture(scope="module")
def finished(recording: Path) -> Path:
    out = recording.with_name("run")
    config = load_config(RunConfig, overrides=SETTINGS)
    run(recording, out, config, workers=1, until="report", log=lambda line: None)
    return out


def test_both_places_are_mapped(finished: Path) -> None:
    robots = RunFolder(finished).robots
    assert list(robots) == ["alpha", "alpha-1"]
    assert [robots[name].component for name in robots] == [("alpha",), ("alpha-1",)]
    assert [len(robot.trajectory) for robot in robots.values()] == [SECOND, FIRST]
    assert all(len(robot.fused_map.gaussians) > 0 for robot in robots.values())
    assert [(s.submap, s.frames) for robot in robots.values() for s in robot.submaps] == [
        (2, SECOND),
        (1, FIRST),
    ]


def test_the_metrics_count_what_has_a_pose(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["coverage"] == {
        "alpha": {
            "frames": FIRST + HIDDEN + SECOND,
            "frames_without_pixel": HIDDEN,
            "posed": FIRST + SECOND,
            "coverage": 1.0,
            "submaps": 2,
            "components": 2,
        }
    }
    assert [metrics["team"][key] for key in ("robots", "robots_in_largest_component")] == [1, 1]
    components = metrics["components"]
    assert {name: row["posed"] for name, row in components.items()} == {"alpha": SECOND, "alpha-1": FIRST}
    assert sum(row["coverage"] for row in components.values()) == pytest.approx(1.0)
    for name, row in components.items():
        assert row["ate_rmse_m"] == pytest.approx(metrics["robots"][name]["ate_rmse_m"])
        assert row["ate_rmse_m"] < 5e-3


def test_the_report_lists_submaps_and_lost_frames(finished: Path) -> None:
    page = (finished / "report" / "index.html").read_text()
    assert "<h3>Submaps</h3>" in page
    assert f"{HIDDEN} frames have no pose" in page
    assert "the frame shows nothing" in page


def test_each_component_is_computed_again_from_the_robot_s_log(finished: Path, recording: Path) -> None:
    comparisons = replay(finished, recording, ["alpha-1"], lambda line: None)
    assert {comparison.robot for comparison in comparisons} == {"alpha-1"}
    assert all(comparison.equal for comparison in comparisons)
