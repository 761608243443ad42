"""Depth that was taken earlier than its stamps say: the delay is found where it is certain, and depth is moved."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.config.frontend import DelayConfig, FrontendConfig, TrackingConfig
from duagc.pipeline.frontend.depth_delay import certain_delay_ns
from duagc.pipeline.frontend.motion_differences import MotionDifference, estimated_time
from duagc.pipeline.frontend.stage import run_frontend
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import open_rgbd, read_log
from duagc.pipeline.recording.moved_depth import depth_delay_ns
from duagc.schemas import topics
from tests.fixtures.room import CAMERA, pose, render

FRAMES, FRAME_NS = 40, 33_333_333
LATE_NS = 20_000_000
CONFIG = DelayConfig()
FRONTEND = FrontendConfig(tracking=TrackingConfig(strides=(2, 1, 1, 1)), mapping_enabled=False)


def walk(k: float) -> np.ndarray:
    """To and fro, so that the velocity changes."""
    return pose(
        x=0.10 * np.sin(0.33 * k),
        y=0.03 * np.sin(0.5 * k + 1),
        z=-0.9 + 0.05 * np.sin(0.24 * k),
        yaw=0.10 * np.sin(0.28 * k + 2),
        pitch=0.05 * np.sin(0.41 * k),
    )


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Logs by how much earlier than its stamps say depth was taken, ns."""
    rng, images = np.random.default_rng(0), [render(walk(k)) for k in range(FRAMES)]
    late = [render(walk(k - LATE_NS / FRAME_NS))[1] for k in range(FRAMES)]
    grays = [gray + 0.005 * rng.standard_normal(gray.shape) for gray, _ in images]
    depths = {0: [depth_m for _, depth_m in images], LATE_NS: late}
    folder = tmp_path_factory.mktemp("delay")
    return {at: write(folder / str(at), grays, depth_m, rng) for at, depth_m in depths.items()}


def write(
    folder: Path, grays: list[np.ndarray], depths_m: list[np.ndarray], rng: np.random.Generator
) -> Path:
    with RecordingWriter(folder) as recording, recording.robot("alpha", CAMERA, 0.0005) as robot:
        for k, (gray, depth_m) in enumerate(zip(grays, depths_m, strict=True)):
            image = np.repeat(np.rint(np.clip(gray, 0, 1) * 255).astype(np.uint8)[..., None], 3, axis=2)
            raw = np.rint((depth_m + 0.003 * rng.standard_normal(depth_m.shape)) / 0.0005).astype(np.uint16)
            robot.add_frame(k * FRAME_NS, cv2.imencode(".png", image)[1].tobytes(), "png", raw)
    return folder / "alpha.mcap"


def found_ns(path: Path, config: DelayConfig = CONFIG) -> int:
    """The delay of a log by the true path."""
    stamps = np.array([k * FRAME_NS for k in range(FRAMES)])
    with open_rgbd(path) as log:
        return certain_delay_ns(log, [Trajectory(stamps, np.array([walk(k) for k in range(FRAMES)]))], config)


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
        stamps = np.array([k * FRAME_NS for k in range(FRAMES)])
        path = Trajectory(stamps, np.array([walk(k) for k in range(FRAMES)]))
        assert certain_delay_ns(log, [path], CONFIG) == 0
        log.delay_depth(0)
        assert log.frame(8).depth_offset_ns == 0


def test_the_front_end_moves_depth_by_it(logs: dict[int, Path], tmp_path: Path) -> None:
    errors_m = {}
    for enabled in (True, False):
        config = FRONTEND.model_copy(update={"delay": DelayConfig(enabled=enabled)})
        out = tmp_path / f"{enabled}.mcap"
        run_frontend(logs[LATE_NS], out, config)
        frames = [record.message() for record in read_log(out, (topics.ODOMETRY.of("alpha"),))]
        T_first = se3.inverse(walk(0))
        apart = [se3.distance(f.T_map_camera, T_first @ walk(f.frame_index))[0] for f in frames]
        errors_m[enabled] = float(np.sqrt(np.mean(np.square(apart))))
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
