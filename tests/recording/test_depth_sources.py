"""Depth of another camera or a LiDAR, as the color camera would see it."""

from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import LogWriter, open_rgbd
from duagc.pipeline.recording.register_depth import register_depth
from duagc.schemas import topics
from tests.fixtures.recording_logs import CALIBRATION, COLOR, png

WIDE = PinholeCamera(64, 48, 56.0, 56.0, 31.5, 23.5)
DEPTH_CAMERA = PinholeCamera(60, 44, 50.0, 51.0, 29.0, 22.5)
T_CAMERA_DEPTH = se3.exp([0.025, -0.004, 0.01, 0.01, -0.02, 0.015])
WALL = (np.array([0.2, -0.1, -1.0]), 2.0)  # n . X = -d in the color camera


def plane_depth(camera: PinholeCamera, T_plane_camera: np.ndarray) -> np.ndarray:
    """Depth image of the wall, given in the color camera, from a camera at T_plane_camera."""
    n, d = WALL
    rays = camera.rays() @ T_plane_camera[:3, :3].T
    return -(d + T_plane_camera[:3, 3] @ n) / (rays @ n)


def test_depth_of_another_camera_is_exact_on_a_wall() -> None:
    raw = plane_depth(DEPTH_CAMERA, T_CAMERA_DEPTH).astype(np.float32)
    seen = register_depth(raw, DEPTH_CAMERA, T_CAMERA_DEPTH, WIDE)
    truth = plane_depth(WIDE, np.eye(4))
    inner = seen[6:-6, 6:-6]
    assert (inner > 0).all()  # no gaps
    # a sample falls up to half a pixel off the center, where the wall is up to 0.2 / 56 / 2 of its depth away
    np.testing.assert_allclose(inner, truth[6:-6, 6:-6], rtol=3e-3)
    assert abs(float(np.mean(inner - truth[6:-6, 6:-6]))) < 5e-4


def test_the_nearer_surface_hides_the_farther() -> None:
    """A card before the wall: what lies behind it, seen by the depth camera only, does not shine through."""
    raw = np.full((DEPTH_CAMERA.height, DEPTH_CAMERA.width), 3.0, np.float32)
    raw[:, 30:] = 1.0
    aside = se3.exp([-0.3, 0, 0, 0, 0, 0])
    seen = register_depth(raw, DEPTH_CAMERA, aside, DEPTH_CAMERA)
    row = seen[20]
    near = np.flatnonzero(np.abs(row - 1) < 0.01)
    assert np.array_equal(near, np.arange(near[0], near[-1] + 1))
    assert not np.any((row > 1.05) & (row < 2.9))  # nothing between the two


def test_unregistered_depth_is_read_by_its_calibration_and_transform(tmp_path: Path) -> None:
    path = tmp_path / "alpha.mcap"
    raw = np.rint(plane_depth(DEPTH_CAMERA, T_CAMERA_DEPTH) * 5000).astype(np.uint16)
    picture = png(np.zeros((WIDE.height, WIDE.width, 3), np.uint8))

    def write(without: str = "", transforms: int = 1) -> Path:
        with LogWriter(path, "alpha") as log:
            log.channel("/alpha/depth_camera/depth", topics.RAW_DEPTH.schema, {"depth_scale": "0.0002"})
            rows = [
                (CALIBRATION, m.pack_calibration(0, "alpha", WIDE)),
                (COLOR, m.pack_color(0, "alpha", picture, "png")),
                ("/alpha/depth_camera/calibration", m.pack_calibration(0, "alpha", DEPTH_CAMERA)),
                ("/alpha/depth_camera/depth", m.pack_depth(0, "alpha", raw)),
            ]
            for k in range(transforms):
                T = T_CAMERA_DEPTH @ se3.exp([0.1 * k, 0, 0, 0, 0, 0])
                transform = m.pack_transform(0, "alpha/camera", "alpha/depth_camera", T)
                rows.append(("/alpha/depth_camera/transform", transform))
            for topic, message in rows:
                if topic != without:
                    log.write(topic, message, 0)
        return path

    with open_rgbd(write()) as log:
        frame = log.frame(0)
    truth = plane_depth(WIDE, np.eye(4))
    np.testing.assert_allclose(frame.depth[6:-6, 6:-6], truth[6:-6, 6:-6], rtol=3e-3)
    for without in ("/alpha/depth_camera/calibration", "/alpha/depth_camera/transform"):
        with pytest.raises(DuagError, match=f"{without} has no message"):
            open_rgbd(write(without))
    with pytest.raises(DuagError, match="/alpha/depth_camera/transform changes"):
        open_rgbd(write(transforms=2))


def test_points_without_coordinates_are_one_line() -> None:
    message = m.pack_points(0, "alpha/lidar", np.zeros((2, 3)))
    assert m.unpack_points(message, "here").shape == (2, 3)
    del message.fields[2]
    with pytest.raises(DuagError, match=r"here has fields \['x', 'y'\]"):
        m.unpack_points(message, "here")
