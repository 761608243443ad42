"""Depth that was taken earlier than its stamps say: the delay is found where it is certain, and depth is moved."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline.config.frontend import FrontendConfig, TrackingConfig
from duagc.pipeline.config.motion_times import DelayConfig
from duagc.pipeline.frontend.depth_delay import certain_delay_ns
from duagc.pipeline.frontend.frame_pairs import FramePairs
from duagc.pipeline.frontend.motion_differences import MotionDifference, estimated_time
from duagc.pipeline.frontend.stage import run_frontend
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import open_rgbd
from duagc.pipeline.recording.moved_depth import depth_delay_ns
from tests.fixtures.carried_camera import FRAME_NS, rms_error_m, true_path, walk, write
from tests.fixtures.room import CAMERA, render

FRAMES = 40
LATE_NS = 20_000_000
CONFIG = DelayConfig()
FRONTEND = FrontendConfig(tracking=TrackingConfig(strides=(2, 1, 1, 1)), mapping_enabled=False)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Logs by how much earlier than its stamps say depth was taken, ns."""
    folder = tmp_path_factory.mktemp("delay")

    def images(late_ns: int) -> list[tuple[np.ndarray, np.ndarray]]:
        return [(render(walk(k))[0], render(walk(k - late_ns / FRAME_NS))[1]) for k in range(FRAMES)]

    return {late_ns: write(folder / str(late_ns), CAMERA, images(late_ns)) for late_ns in (0, LATE_NS)}


def found_ns(path: Path, config: DelayConfig = CONFIG) -> int:
    """The delay of a log by the true path."""
    with open_rgbd(path) as log:
        return certain_delay_ns(FramePairs(log, [true_path(FRAMES)]), config)


def test_a_delay_is_found(logs: dict[int, Path]) -> None:
    assert found_ns(logs[LATE_NS]) == pytest.approx(LATE_NS, abs=3_000_000)


def test_none_is_found_where_there_is_none_or_it_is_not_certain(logs: dict[int, Path]) -> None:
    assert found_ns(logs[0]) == 0
    assert found_ns(logs[LATE_NS], CONFIG.model_copy(update={"sigmas": 1000.0})) == 0
    assert found_ns(logs[LATE_NS], CONFIG.model_copy(update={"least_s": 0.05})) == 0
    assert found_ns(logs[LATE_NS], CONFIG.model_copy(update={"min_pairs": 1000})) == 0
    assert found_ns(logs[LATE_NS], CONFIG.model_copy(update={"enabled": False})) == 0


def test_what_the_stamps_say_is_no_delay(logs: dict[int, Path]) -> None:
    with open_rgbd(logs[LATE_NS]) as log:
        log.delay_depth(LATE_NS)
        assert log.frame(8).depth_offset_ns == FRAME_NS - LATE_NS  # the next depth is nearer now
        assert certain_delay_ns(FramePairs(log, [true_path(FRAMES)]), CONFIG) == 0
        log.delay_depth(0)
        assert log.frame(8).depth_offset_ns == 0


def test_the_front_end_moves_depth_by_it(logs: dict[int, Path], tmp_path: Path) -> None:
    errors_m = {}
    for enabled in (True, False):
        config = FRONTEND.model_copy(update={"delay": DelayConfig(enabled=enabled)})
        out = tmp_path / f"{enabled}.mcap"
        run_frontend(logs[LATE_NS], out, config)
        errors_m[enabled] = rms_error_m(out)
    assert depth_delay_ns(tmp_path / "False.mcap") == 0
    assert depth_delay_ns(tmp_path / "True.mcap") == pytest.approx(LATE_NS, abs=4_000_000)
    assert errors_m[True] < 0.5 * errors_m[False]
    with open_rgbd(logs[LATE_NS]) as log:
        log.move_depth_by(tmp_path / "True.mcap")
        moved = log.frame(9)
        assert moved.depth_moved
        assert moved.depth_offset_ns > 0
        seen = (moved.depth > 0) & (np.abs(moved.depth - render(walk(9))[1]) < 0.02)
        assert seen.mean() > 0.9
        log.move_depth_by(tmp_path / "False.mcap")
        assert log.frame(9).depth_offset_ns == 0


def test_pairs_that_tell_nothing_leave_it_open() -> None:
    nothing = [replace(d, information=np.zeros((6, 6))) for d in differences(0.02, np.zeros(6))]
    found = estimated_time(nothing, CONFIG)
    assert found is not None
    assert found.sigma_s == pytest.approx(1.0)


def differences(delay_s: float, turned: np.ndarray, wrong: int = 0) -> list[MotionDifference]:
    """Of pairs of a camera that is carried, with a noise of 1 mm and 1 mrad; the first ones wrong."""
    rng = np.random.default_rng(1)
    found = []
    for k in range(40):
        change = rng.normal(scale=0.4, size=6)
        by_cameras = np.eye(6) - se3.adjoint(se3.exp(rng.normal(scale=0.1, size=6)))
        off = delay_s * change + by_cameras @ turned + rng.normal(scale=1e-3, size=6)
        off += rng.normal(scale=0.05, size=6) if k < wrong else 0
        found.append(MotionDifference(off, change, by_cameras, 1e6 * np.eye(6)))
    return found


def test_wrong_pairs_and_a_turned_camera_are_no_delay() -> None:
    turned = np.array([0.01, -0.005, 0.0, 0.02, -0.01, 0.01])
    found = estimated_time(differences(0.02, turned, wrong=8), CONFIG)
    assert found is not None
    assert found.time_s == pytest.approx(0.02, abs=1e-3)
    assert found.sigma_s < 0.002
    found = estimated_time(differences(0.0, turned), CONFIG)
    assert found is not None
    assert abs(found.time_s) < 1e-3
