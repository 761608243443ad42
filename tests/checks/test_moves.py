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


def fast_log(frames: int) -> SimpleNamespace:
    """A camera that goes along a ceiling, 7 cm a frame."""
    noise = np.random.default_rng(4).standard_normal((120, 160 + STEP_PX * frames)).astype(np.float32)
    smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0))
    wall = np.clip(128 + 20 * smooth / smooth.std(), 0, 255).astype(np.uint8)
    depth = np.full((120, 160), DEPTH_M, np.float32)
    stamps = [1 + round(i * 1e9 / 30) for i in range(frames)]

    def frame(i: int) -> RgbdFrame:
        gray = wall[:, STEP_PX * i : STEP_PX * i + 160]
        return RgbdFrame(i, stamps[i], np.repeat(gray[..., None], 3, axis=2), depth)

    return SimpleNamespace(
        camera=CAMERA, frame=frame, pairing=SimpleNamespace(pairs=[(ns, ns) for ns in stamps])
    )


def test_fast_motion_along_a_plane_has_its_length() -> None:
    found = moves(fast_log(30), MotionChecks())  # type: ignore[arg-type]
    step_m = STEP_PX * DEPTH_M / CAMERA.fx
    for move in found:
        assert move.T_first_second is not None
        frames = round((move.second_ns - move.first_ns) * 30 / 1e9)
        assert np.linalg.norm(move.T_first_second[:3, 3]) == pytest.approx(frames * step_m, rel=0.05)
    assert max(move.second_ns - move.first_ns for move in found) > 0.1e9
