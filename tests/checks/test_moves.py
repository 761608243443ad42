"""Pairs of frames of a log: fast motion along a plane, where registration alone finds one of many minima."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from duagc.pipeline.checks.moves import moves
from duagc.pipeline.config.checks import MotionChecks
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording.rgbd_frame import RgbdFrame

CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 79.5, 59.5)
DEPTH_M, STEP_PX = 1.5, 6


def fast_log(
    frames: int, *, camera: PinholeCamera = CAMERA, step_px: int = STEP_PX, shelf_px: int = 0
) -> SimpleNamespace:
    """A camera that goes along a ceiling, 7 cm a frame, or along a shelf whose boards repeat."""
    shape = camera.height, camera.width + step_px * frames
    noise = np.random.default_rng(4).standard_normal(shape).astype(np.float32)
    smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0))
    wall = 128 + 20 * smooth / smooth.std()
    if shelf_px:
        wall += 60 * np.cos(2 * np.pi / shelf_px * np.arange(shape[1]))
    wall = np.clip(wall, 0, 255).astype(np.uint8)
    depth = np.full((camera.height, camera.width), DEPTH_M, np.float32)
    stamps = [1 + round(i * 1e9 / 30) for i in range(frames)]

    def frame(i: int) -> RgbdFrame:
        gray = wall[:, step_px * i : step_px * i + camera.width]
        return RgbdFrame(i, stamps[i], np.repeat(gray[..., None], 3, axis=2), depth)

    return SimpleNamespace(
        camera=camera, frame=frame, pairing=SimpleNamespace(pairs=[(ns, ns) for ns in stamps])
    )


def test_fast_motion_along_a_plane_has_its_length() -> None:
    found = moves(fast_log(30), MotionChecks())  # type: ignore[arg-type]
    step_m = STEP_PX * DEPTH_M / CAMERA.fx
    for move in found:
        assert move.T_first_second is not None
        frames = round((move.second_ns - move.first_ns) * 30 / 1e9)
        assert np.linalg.norm(move.T_first_second[:3, 3]) == pytest.approx(frames * step_m, rel=0.05)
    assert max(move.second_ns - move.first_ns for move in found) > 0.1e9


def test_where_things_repeat_features_tell_how_far_a_fast_camera_went() -> None:
    camera = PinholeCamera(320, 240, 260.0, 260.0, 159.5, 119.5)
    found = moves(fast_log(8, camera=camera, step_px=40, shelf_px=60), MotionChecks())  # type: ignore[arg-type]
    for move in found:
        assert move.T_first_second is not None
        frames = round((move.second_ns - move.first_ns) * 30 / 1e9)
        expected_m = frames * 40 * DEPTH_M / camera.fx
        assert np.linalg.norm(move.T_first_second[:3, 3]) == pytest.approx(expected_m, rel=0.05)
