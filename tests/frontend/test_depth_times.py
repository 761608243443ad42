"""Depth of other times than color: it is moved, and frames from before it started are followed backward."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.config.frontend import FrontendConfig, TrackingConfig
from duagc.pipeline.frontend import leading_frames
from duagc.pipeline.frontend.current_frame import CurrentFrame
from duagc.pipeline.frontend.depth_quality import largest_depth_offset_s
from duagc.pipeline.frontend.frame_images import RgbdImages
from duagc.pipeline.frontend.stage import run_frontend
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import read_log
from duagc.schemas import topics
from tests.fixtures.room import CAMERA, pose, render

FRAMES, WITHOUT = 14, 7
FRAME_NS = 33_333_333
CONFIG = FrontendConfig(tracking=TrackingConfig(strides=(2, 1, 1, 1)), mapping_enabled=False)


def walk(k: float) -> np.ndarray:
    return pose(x=-0.2 + 0.01 * k, y=0.003 * k, z=-0.9, yaw=0.2 - 0.01 * k)


def write(folder: Path, without: int, late_ns: int = 0, stated: bool = True, early: bool = False) -> Path:
    """The walk, its first frames without depth; depth comes late by some time, of every other frame early by it."""
    with RecordingWriter(folder) as recording, recording.robot("alpha", CAMERA, 0.0005) as robot:
        for k in range(FRAMES):
            gray = render(walk(k))[0]
            offset_ns = -late_ns if early and k % 2 and k else late_ns
            depth_m = render(walk(k + offset_ns / FRAME_NS))[1]
            image = np.repeat(np.rint(np.clip(gray, 0, 1) * 255).astype(np.uint8)[..., None], 3, axis=2)
            raw = np.rint(depth_m / 0.0005).astype(np.uint16) if k >= without else None
            robot.add_frame(
                k * FRAME_NS,
                cv2.imencode(".png", image)[1].tobytes(),
                "png",
                raw,
                depth_stamp_ns=k * FRAME_NS + offset_ns if raw is not None and stated else None,
            )
    return folder / "alpha.mcap"


def errors_m(frames: list) -> np.ndarray:
    """How far the frames are from the true walk, by that after the leading ones."""
    T_first = se3.inverse(frames[WITHOUT].T_map_camera)
    true = [se3.inverse(walk(WITHOUT)) @ walk(k) for k in range(FRAMES)]
    return np.array([se3.distance(T_first @ f.T_map_camera, T)[0] for f, T in zip(frames, true, strict=True)])


def tracked(log: Path) -> list:
    run_frontend(log, log.with_name("frontend.mcap"), CONFIG)
    topic = topics.ODOMETRY.of("alpha")
    return [record.message() for record in read_log(log.with_name("frontend.mcap"), (topic,))]


@pytest.mark.parametrize("late_ns", [0, 12_000_000])
def test_they_have_poses_as_good_as_color_gives(tmp_path: Path, late_ns: int) -> None:
    frames = tracked(write(tmp_path / "rec", WITHOUT, late_ns))
    assert [f.status for f in frames] == ["ok"] * FRAMES
    assert [f.stamp_ns for f in frames] == [k * FRAME_NS for k in range(FRAMES)]
    # three frames before the first depth are near enough to it in time
    assert [f.reason for f in frames] == ["no_depth"] * (WITHOUT - 3 + (late_ns > 0)) + [""] * (
        FRAMES - WITHOUT + 3 - (late_ns > 0)
    )
    assert errors_m(frames).max() < 0.004


def test_a_log_with_depth_from_the_start_has_none(tmp_path: Path) -> None:
    frames = tracked(write(tmp_path / "rec", 0))
    assert [f.reason for f in frames] == [""] * FRAMES


def test_depth_that_is_late_and_early_in_turn_is_moved(tmp_path: Path) -> None:
    """Taken as of the images it makes the camera stagger; moved by its own motion it does not."""
    moved = errors_m(tracked(write(tmp_path / "moved", 0, 14_000_000, early=True)))
    taken = errors_m(tracked(write(tmp_path / "taken", 0, 14_000_000, stated=False, early=True)))
    assert np.sqrt(np.mean(moved**2)) < 0.5 * np.sqrt(np.mean(taken**2))


def covered_log(folder: Path, late_ns: int, covered: range) -> Path:
    """A walk whose lens is covered for some frames; depth is always taken some time after the images."""
    with RecordingWriter(folder) as recording, recording.robot("alpha", CAMERA, 0.0005) as robot:
        for k in range(covered.stop + 8):
            gray, depth_m = render(walk(k))[0], render(walk(k + late_ns / FRAME_NS))[1]
            seen = k not in covered
            image = np.repeat(
                np.rint(np.clip(gray * seen, 0, 1) * 255).astype(np.uint8)[..., None], 3, axis=2
            )
            robot.add_frame(
                k * FRAME_NS,
                cv2.imencode(".png", image)[1].tobytes(),
                "png",
                np.rint(depth_m * seen / 0.0005).astype(np.uint16),
                depth_stamp_ns=k * FRAME_NS + late_ns,
            )
    return folder / "alpha.mcap"


def test_a_frame_that_was_found_afterwards_has_its_depth_moved(tmp_path: Path) -> None:
    """The first frame after a loss is only confirmed by the next ones: while it was lost nothing moved its depth."""
    frames = tracked(covered_log(tmp_path / "rec", 10_000_000, range(14, 20)))
    assert [f.status for f in frames[14:21]] == ["lost"] * 6 + ["relocalized"]
    T_found = se3.inverse(frames[21].T_map_camera) @ frames[20].T_map_camera
    assert se3.distance(T_found, se3.inverse(walk(21)) @ walk(20))[0] < 0.001


def slow_log(folder: Path, late_ns: int, stated: bool, frames: int, *, sparse: int = 0) -> Path:
    """Ten images a second; depth is always taken some time after them, of the first few in a few rows."""
    with RecordingWriter(folder) as recording, recording.robot("alpha", CAMERA, 0.0005) as robot:
        for k in range(frames):
            gray, depth_m = render(walk(3 * k))[0], render(walk(3 * (k + late_ns / 1e8)))[1]
            depth_m[3 if k < sparse else len(depth_m) :] = 0
            image = np.repeat(np.rint(np.clip(gray, 0, 1) * 255).astype(np.uint8)[..., None], 3, axis=2)
            stamp_ns = k * 100_000_000
            robot.add_frame(
                stamp_ns,
                cv2.imencode(".png", image)[1].tobytes(),
                "png",
                np.rint(depth_m / 0.0005).astype(np.uint16),
                depth_stamp_ns=stamp_ns + late_ns if stated else None,
            )
    return folder / "alpha.mcap"


def test_depth_that_is_never_near_in_time_makes_a_map(tmp_path: Path) -> None:
    frames = tracked(slow_log(tmp_path / "rec", 40_000_000, stated=True, frames=10))
    assert [f.status for f in frames] == ["ok"] * 10
    T_first = se3.inverse(frames[0].T_map_camera)
    for k, found in enumerate(frames):
        T_true = se3.inverse(walk(0)) @ walk(3 * k)
        assert se3.distance(T_first @ found.T_map_camera, T_true)[0] < 0.01


def test_frames_before_the_first_keyframe_have_depth_as_near_as_their_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    near: list[bool] = []
    prepared = leading_frames._Backward.prepared

    def asked(tracker: leading_frames._Backward, images: RgbdImages) -> CurrentFrame:
        near.append(tracker._is_near(images.depth_offset_ns))
        return prepared(tracker, images)

    monkeypatch.setattr(leading_frames._Backward, "prepared", asked)
    frames = tracked(slow_log(tmp_path / "rec", 40_000_000, stated=True, frames=4, sparse=1))
    assert [f.status for f in frames] == ["ok"] * 4
    assert near == [True]


def test_how_near_depth_must_be_is_by_the_log() -> None:
    def limit_s(*offsets_ms: int) -> float:
        """Of ten frames between each two that are held out, where depth would be perfect."""
        pairs = iter([(0, ms * 1_000_000) for ms in offsets_ms])
        of_log = [
            (0, 0) if is_held_out(k) else next(pairs, (0, None)) for k in range(2 * len(offsets_ms) + 20)
        ]
        return largest_depth_offset_s(of_log, 0.03)

    offsets = (1, -2, 3, 40, 90, -100, 70, 80, 20, 60)
    assert limit_s(*offsets) == 0.03
    assert limit_s(*(200 + ms for ms in offsets)) > 0.1
    assert limit_s(*[-40] * 20) == pytest.approx(0.05)
    assert limit_s() == 0.03
