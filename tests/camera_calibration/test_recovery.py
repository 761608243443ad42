"""The whole command on a simulated sequence of 7-Scenes whose cameras the test has put wrong: they are found again."""

import json
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from duagc.converters.datasets.seven_scenes import Options
from duagc.converters.simulate.sensors.noise import gray_noise, kinect_depth
from duagc.converters.simulate.simulated_scenes import SimulatedScene, set_up
from duagc.pipeline.base import determinism, random_streams
from duagc.pipeline.camera_calibration.rig import DEPTH, NAMES, ROTATION
from duagc.pipeline.cli import app
from duagc.pipeline.geometry import depth_error, se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import Recording, open_rgbd

FRAMES, EVERY = 74, 10
BARE = 26  # the walk begins before a bare wall, where tracking gets lost
TRUE = {"fx": 531.0, "fy": 533.0, "cx": 324.5, "cy": 232.5, "k1": 0.08, "k2": -0.30, "k3": 0.30}
TRUE |= {"rx": 0.008, "ry": -0.012, "rz": 0.010, "delay_s": 0.004}
TRUE |= {"c0": 0.010, "c1": -0.012, "c2": 0.006, "c3": -0.015, "c4": 0.004, "c5": 0.005}
ERROR = np.array([TRUE[name] for name in DEPTH])
R_COLOR_DEPTH = so3.exp(np.array([TRUE[name] for name in ROTATION]))
T_DEPTH_COLOR = se3.from_rotation_translation(
    np.eye(3), [Options().baseline_m, 0, 0]
)  # as converted: not turned
DEPTH_CAMERA = Options().depth_camera()
WIDE = PinholeCamera(840, 640, 610.0, 610.0, 419.5, 319.5)  # sees what the lens sees


def rays_of_the_lens() -> np.ndarray:
    """Directions (x, y) [480, 640, 2] of the pixels of the true color camera."""
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    K = np.array([[TRUE["fx"], 0, TRUE["cx"]], [0, TRUE["fy"], TRUE["cy"]], [0, 0, 1]])
    lens = np.array([TRUE["k1"], TRUE["k2"], 0, 0, TRUE["k3"]])
    exact = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    points = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    return cv2.undistortPoints(points, K, lens, None, None, None, exact).reshape(480, 640, 2)


def measured(depth: np.ndarray) -> np.ndarray:
    """What the wrong depth camera has where the depth [480, 640] is true (m, 0 = none)."""
    rays = DEPTH_CAMERA.rays()
    at_infinity = depth_error.terms(np.zeros(depth.shape), rays[..., 0], rays[..., 1]) @ ERROR
    inverse = 1 / np.where(depth > 0, depth, 1) - at_infinity
    inverse /= 1 - depth_error.NO_ERROR_M * ERROR[0]
    return np.where((depth > 0) & (inverse > 0), 1 / np.maximum(inverse, 1e-9), 0)


def write_sequence(folder: Path, stage: SimulatedScene) -> np.ndarray:
    """A robot's walk in the files of the dataset; returns the poses T_world_depth [FRAMES, 4, 4]."""
    folder.mkdir()
    way = stage.wander(1, BARE + FRAMES, 0.6, DEPTH_CAMERA)[0][BARE:]
    rays = rays_of_the_lens().astype(np.float32)
    columns, rows = rays[..., 0] * WIDE.fx + WIDE.cx, rays[..., 1] * WIDE.fy + WIDE.cy
    color_eye, depth_eye = stage.renderer(WIDE), stage.renderer(DEPTH_CAMERA)
    turned = T_DEPTH_COLOR @ se3.from_rotation_translation(R_COLOR_DEPTH.T, np.zeros(3))
    for k, T in enumerate(way):
        before, after = max(k - 1, 0), min(k + 1, FRAMES - 1)
        velocity = se3.log(se3.inverse(way[before]) @ way[after]) * 30 / (after - before)
        rng = random_streams.generator(0, "test.recovery", frame=k)
        color = color_eye.render(T @ se3.exp(TRUE["delay_s"] * velocity) @ turned).color
        color = gray_noise(cv2.remap(color, columns, rows, cv2.INTER_LINEAR), rng)
        depth = kinect_depth(measured(depth_eye.render(T).depth), DEPTH_CAMERA, rng)
        stem = folder / f"frame-{k:06d}"
        cv2.imwrite(f"{stem}.color.png", color[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
        raw = np.rint(depth * 1000).astype(np.uint16)
        cv2.imwrite(f"{stem}.depth.png", raw, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        np.savetxt(f"{stem}.pose.txt", T)
    return way


def command(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def errors(folder: Path, stage: SimulatedScene, way: np.ndarray) -> tuple[float, float]:
    """Median errors of a recording's depth (m) and gray values, against what its camera would have seen."""
    depths, grays = [], []
    with open_rgbd(Recording(folder).log("alpha")) as log:
        eye = stage.renderer(log.camera)
        for k in range(0, FRAMES, EVERY):
            frame, exact = log.frame(k), eye.render(way[k] @ T_DEPTH_COLOR)
            known = (frame.depth > 0) & (exact.depth > 0)
            depths.append(np.median(np.abs(frame.depth - exact.depth)[known]))
            grays.append(np.abs(frame.color.astype(float) - exact.color)[20:-20, 20:-20].mean())
    return float(np.median(depths)), float(np.median(grays))


@pytest.mark.slow
def test_cameras_that_were_put_wrong_are_found_and_put_right(tmp_path: Path) -> None:
    """Within four standard deviations as the command states them; the corrected recording is nearer to the truth."""
    determinism.configure_opencv()
    with tempfile.TemporaryDirectory() as cache:
        stage = set_up("room", "auto", 0, Path(cache), as_meshes=False)
        way = write_sequence(tmp_path / "walk", stage)
        command("convert", "7scenes", tmp_path / "walk", "--out", tmp_path / "raw")
        file = tmp_path / "cameras.toml"
        applied = tmp_path / "applied"
        said = command(
            "calibrate", tmp_path / "raw", "--views", 36, "--out", file, "--apply", applied, "--json"
        )
        assert command("calibrate", tmp_path / "raw", "--views", 36, "--workers", 1, "--json") == said
        found = json.loads(said)
        for name in NAMES:
            value, sigma = (found["values"][name][key] for key in ("value", "sigma"))
            assert abs(value - TRUE[name]) < 4 * sigma, (name, value, sigma)
        command("convert", "7scenes", tmp_path / "walk", "--options", file, "--out", tmp_path / "right")
        depth_before, gray_before = errors(tmp_path / "raw", stage, way)
        for folder in (tmp_path / "right", applied):
            depth, gray = errors(folder, stage, way)
            print(
                f"{folder.name}: depth {1e3 * depth_before:.1f} -> {1e3 * depth:.1f} mm, "
                f"gray {gray_before:.2f} -> {gray:.2f}"
            )
            assert depth < 0.4 * depth_before
            assert gray < 0.4 * gray_before
