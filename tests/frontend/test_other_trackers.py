"""Trackers to compare with, by rendering and by Open3D: they follow a simple path, and say so where they do not."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.config.packages import NO_OPEN3D, check_packages
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.frame_images import RgbdImages
from duagc.pipeline.frontend.open3d_tracker import Open3dTracker
from duagc.pipeline.frontend.other_tracker import OtherTracker
from duagc.pipeline.frontend.rendering_tracker import RenderingTracker
from duagc.pipeline.frontend.stage import run_frontend
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import RgbdFrame, read_log
from duagc.schemas import topics
from tests.fixtures.room import CAMERA, pose, render

FRAMES = 10
FRAME_NS = 33_333_333
SETTINGS = (
    "frontend.tracking.strides=[2, 1, 1, 1]",
    "frontend.tracking.rendering.keyframe_steps=30",
    "frontend.tracking.rendering.steps=40",
    "frontend.tracking.open3d.voxel_m=0.015",
    "frontend.tracking.open3d.blocks=1500",
    "frontend.keyframes.max_rotation_rad=0.04",
)
RENDERING, OPEN3D = "rendering", "open3d"
BOTH = pytest.mark.parametrize("method", [RENDERING, OPEN3D])
LARGEST_M = {"registration": 0.005, RENDERING: 0.02, OPEN3D: 0.06}
"""Error of a path of 127 mm; Open3D slides, and its voxels are coarse here."""


def config(*more: str) -> FrontendConfig:
    return load_config(RunConfig, overrides=[*SETTINGS, *more]).frontend


def walk(k: int) -> np.ndarray:
    """Toward a corner, turning."""
    return pose(x=0.01 * k, y=-0.1, z=0.3 + 0.01 * k, yaw=0.75 - 0.012 * k, pitch=-0.4)


@cache
def frame(k: int) -> RgbdFrame:
    gray, depth_m = render(walk(k))
    color = np.rint(255 * np.clip(gray, 0, 1)).astype(np.uint8)
    return RgbdFrame(k, k * FRAME_NS, np.repeat(color[..., None], 3, axis=2), depth_m)


def images(k: int, **changed: Any) -> RgbdImages:
    return replace(RgbdImages.of(frame(k)), **changed)


def made(method: str, settings: FrontendConfig | None = None, threads: int = 1) -> OtherTracker:
    settings = settings or config()
    if method == OPEN3D:
        return Open3dTracker(CAMERA, settings, frame)
    return RenderingTracker(CAMERA, settings, frame, threads=threads)


def followed(tracker: OtherTracker, first: int = 0, frames: int = FRAMES) -> OtherTracker:
    for k in range(first, frames):
        tracker.track(images(k))
    return tracker


@cache
def undisturbed(method: str) -> OtherTracker:
    return followed(made(method))


def errors(tracker: OtherTracker) -> tuple[float, float]:
    """Largest distance (m) and angle (rad) from the walk, as seen from the first frame."""
    poses = tracker.path().poses
    far = [se3.distance(T, se3.inverse(walk(0)) @ walk(k)) for k, T in enumerate(poses)]
    return float(max(m for m, _ in far)), float(max(rad for _, rad in far))


@BOTH
def test_it_follows_a_simple_path(method: str) -> None:
    tracker = undisturbed(method)
    log = tracker.finish()
    assert [f.status for f in log.frames] == [Status.OK] * FRAMES
    moved_m, turned_rad = errors(tracker)
    assert moved_m < LARGEST_M[method]
    assert turned_rad < 0.02  # of 108 mrad


@BOTH
def test_keyframes_are_tied_one_to_the_next_and_none_is_held_out(method: str) -> None:
    submap = undisturbed(method).finish().submaps[0]
    keyframes = submap.keyframes
    assert len(keyframes) >= 3
    assert not any(is_held_out(keyframe.frame_index) for keyframe in keyframes)
    assert [(p.i, p.j) for p in submap.pairs] == [(k, k + 1) for k in range(len(keyframes) - 1)]
    for pair in submap.pairs:
        T = se3.inverse(keyframes[pair.i].T_map_keyframe) @ keyframes[pair.j].T_map_keyframe
        np.testing.assert_allclose(pair.T_i_j, T, atol=1e-12)


def test_without_steps_rendering_stays_where_it_was() -> None:
    tracker = followed(made(RENDERING, config("frontend.tracking.rendering.steps=0")))
    np.testing.assert_array_equal(tracker.path().poses, np.repeat(np.eye(4)[None], FRAMES, axis=0))


def test_an_image_that_is_darker_is_no_other_place() -> None:
    tracker = followed(made(RENDERING), frames=3)
    dark = np.rint(0.8 * images(3).image).astype(np.uint8)
    tracker.track(images(3, image=dark))
    assert errors(tracker)[0] < 0.02


@BOTH
def test_a_frame_that_is_held_out_changes_no_map(method: str) -> None:
    """The last frame is held out: whatever it shows, the map is as it was before."""
    held_out = next(k for k in range(1, FRAMES) if is_held_out(k))
    tracker = followed(made(method), frames=held_out)
    before = copy.deepcopy(tracker.map_state())
    tracker.track(images(held_out))
    assert len(tracker.finish().frames) == held_out + 1
    if method == OPEN3D:
        assert [k for k, _ in tracker.map_state()] == [k for k, _ in before] == list(range(held_out))
    else:
        np.testing.assert_array_equal(tracker.map_state()[0][0][0].means, before[0][0][0].means)


@BOTH
def test_a_frame_that_shows_nothing_is_lost_and_the_next_one_is_not(method: str) -> None:
    tracker = followed(made(method), frames=3)
    blind = {"depth_m": np.zeros_like(images(3).depth_m)}
    if method == RENDERING:  # it needs no depth, but a pixel
        blind["mask"] = np.zeros(blind["depth_m"].shape, bool)
    tracker.track(images(3, **blind))
    tracker.track(images(3, stamp_ns=4 * FRAME_NS))
    lost, found = tracker.finish().frames[-2:]
    assert lost.status is Status.LOST
    assert lost.reason is (Reason.NO_DEPTH if method == OPEN3D else Reason.NO_PIXEL)
    assert not lost.information.any()
    assert found.status is Status.OK
    assert float(se3.distance(tracker.pose_of(found), se3.inverse(walk(0)) @ walk(3))[0]) < LARGEST_M[method]


def test_where_the_map_shows_nothing_a_frame_is_lost() -> None:
    tracker = followed(made(RENDERING), frames=1)
    turned = np.eye(4)
    turned[:3, :3] = np.diag([-1.0, 1.0, -1.0])
    assert tracker.place(images(1), turned) is Reason.LOW_OVERLAP


@BOTH
def test_it_goes_on_from_its_state(method: str) -> None:
    """With the same bits; those of Open3D are so only in a process that has not used it before."""
    half = followed(made(method), frames=5)
    other = made(method)
    other.go_on(copy.deepcopy(half.state()))
    far = np.abs(followed(other, 5, 7).path().poses - undisturbed(method).path().poses[:7])
    assert far.max() <= (2e-4 if method == OPEN3D else 0.0)


def test_threads_change_no_bit() -> None:
    tracker = followed(made(RENDERING, threads=3), frames=4)
    np.testing.assert_array_equal(tracker.path().poses, undisturbed(RENDERING).path().poses[:4])


def test_without_open3d_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = load_config(RunConfig, overrides=["frontend.tracking.method=open3d"])
    check_packages(settings)
    monkeypatch.setattr("duagc.pipeline.config.packages.find_spec", lambda name: None)
    with pytest.raises(DuagError, match="package open3d not found") as error:
        check_packages(settings)
    assert str(error.value) == NO_OPEN3D
    check_packages(RunConfig())  # nobody else needs it


@pytest.mark.parametrize("method", ["registration", RENDERING, OPEN3D])
def test_the_stage_runs_with_each(method: str, tmp_path: Path) -> None:
    alone = ("frontend.mapping_enabled=false", "frontend.keyframes.local_optimization=false")
    loops = ("frontend.keyframes.loops.enabled=false", "frontend.keyframes.judgment.enabled=false")
    settings = config(f"frontend.tracking.method={method}", *alone, *loops)
    with RecordingWriter(tmp_path / "room") as recording, recording.robot("alpha", CAMERA, 0.0005) as robot:
        for k in range(4):
            png = cv2.imencode(".png", frame(k).color)[1].tobytes()
            robot.add_frame(k * FRAME_NS, png, "png", np.rint(frame(k).depth / 0.0005).astype(np.uint16))
    run_frontend(tmp_path / "room" / "alpha.mcap", tmp_path / "frontend.mcap", settings)
    topic = topics.ODOMETRY.of("alpha")
    found = [record.message() for record in read_log(tmp_path / "frontend.mcap", (topic,))]
    assert [m.status for m in found] == ["ok"] * 4
    T = se3.inverse(walk(0)) @ walk(3)
    assert float(se3.distance(found[3].T_map_camera, T)[0]) < LARGEST_M[method]
