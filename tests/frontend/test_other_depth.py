"""The front end on depth of a stereo pair and of a LiDAR in a simulated room, with the sigma of every pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.layouts.stereo import StereoRig
from duagc.converters.simulate.render import bake
from duagc.converters.simulate.render.renderer import Renderer
from duagc.converters.simulate.scenes.catalog import build
from duagc.converters.simulate.settings import camera_of
from duagc.converters.simulate.trajectories import loops
from duagc.converters.writer import RecordingWriter
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.evaluation.image_metrics import depth_error
from duagc.pipeline.frontend.stage import run_frontend
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.trajectory import align
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.recording import RgbdLog, read_log

CAMERA = camera_of((240, 180))
FRAMES = 20
BASELINE_M = 0.12
RANGE_SIGMA_M = 0.02
R_CAMERA_LIDAR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
T_CAMERA_LIDAR = se3.from_rotation_translation(R_CAMERA_LIDAR, [0.02, -0.2, -0.05])
WIDE = PinholeCamera(
    1000, 600, 400.0, 400.0, 499.5, 299.5
)  # in the LiDAR's place: its beams are pixels of it


@dataclass(frozen=True)
class Walk:
    """Logs of one robot by what its depth comes from, true poses [n, 4, 4] and true depths."""

    logs: dict[str, Path]
    poses: np.ndarray
    depths: list[np.ndarray]


def beams(rings: int, columns: int) -> np.ndarray:
    """Pixels [n, 2] of the wide camera that a LiDAR of these rings, 30 degrees in all, measures."""
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(-15, 15, rings)), np.radians(np.arange(-45, 45, 360 / columns)), indexing="ij"
    )
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1).reshape(-1, 3)
    return np.rint(WIDE.project(rays @ R_CAMERA_LIDAR.T)).astype(int)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    """A room filmed by a stereo rig with a LiDAR on top, gray values and ranges with noise."""
    room = build("room", 0)
    eye, wide = Renderer(room, bake.bake(room, 0.02), CAMERA), Renderer(room, None, WIDE)
    poses = loops.plan(room, 1, 160, 0.6, camera=CAMERA)[0][:FRAMES]
    pixels, rng, rig = beams(16, 720), np.random.default_rng(1), StereoRig(CAMERA, BASELINE_M)
    rays = WIDE.rays()[pixels[:, 1], pixels[:, 0]]
    units = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    views = [eye.render(T) for T in poses]
    rights = [eye.render(T @ se3.exp([BASELINE_M, 0, 0, 0, 0, 0])) for T in poses]
    out = tmp_path_factory.mktemp("walk")
    for kind in ("stereo", "lidar"):
        with RecordingWriter(out / kind) as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
            if kind == "lidar":
                robot.set_lidar(T_CAMERA_LIDAR, RANGE_SIGMA_M)
            for k, (T, view, right) in enumerate(zip(poses, views, rights, strict=True)):
                left, other = (
                    np.clip(np.rint(v.color + rng.normal(0, 2.5, v.color.shape)), 0, 255).astype(np.uint8)
                    for v in (view, right)
                )
                png, stamp_ns = cv2.imencode(".png", left[..., ::-1])[1].tobytes(), k * 33_333_333
                if kind == "lidar":
                    z, _ = wide.depth(T @ se3.from_rotation_translation(np.eye(3), T_CAMERA_LIDAR[:3, 3]))
                    z = z[pixels[:, 1], pixels[:, 0], None]
                    points = rays * z + units * rng.normal(0, RANGE_SIGMA_M, z.shape)
                    robot.add_points(stamp_ns, points[z[:, 0] > 0] @ R_CAMERA_LIDAR)
                    robot.add_frame(stamp_ns, png, "png", None, T_world_camera=T)
                    continue
                gray = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, other))
                depth_m, sigma_m = rig.depth(*gray)
                raw = np.rint(depth_m / 0.001).astype(np.uint16)
                robot.add_frame(stamp_ns, png, "png", raw, T_world_camera=T, depth_sigma_m=sigma_m)
    logs = {kind: out / kind / "alpha.mcap" for kind in ("stereo", "lidar")}
    return Walk(logs, poses, [view.depth for view in views])


def followed(walk: Walk, kind: str, out: Path, mapping: bool) -> tuple[list, list, float]:
    """Tracked frames, the final map if there is one, and the ATE in meters."""
    config = FrontendConfig(mapping_enabled=mapping)
    small = config.mapping.model_copy(update={"max_gaussians": 20_000})
    run_frontend(walk.logs[kind], out, config.model_copy(update={"mapping": small}))
    messages = [(record.topic, record.message()) for record in read_log(out)]
    odometry = [m for topic, m in messages if topic == "/alpha/odometry" and m.status != "lost"]
    found = np.array([m.T_map_camera for m in odometry])
    true = np.array([walk.poses[m.frame_index] for m in odometry])
    T_world_map = align(true[:, :3, 3], found[:, :3, 3])
    apart = true[:, :3, 3] - se3.transform(T_world_map, found[:, :3, 3])
    maps = [m.gaussians for topic, m in messages if topic == "/alpha/map"]
    return odometry, maps[:1], float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


@pytest.fixture(scope="module")
def mapped(walk: Walk, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[list, list, float]]:
    out = tmp_path_factory.mktemp("mapped")
    return {kind: followed(walk, kind, out / f"{kind}.mcap", True) for kind in walk.logs}


@pytest.mark.parametrize(
    ("kind", "most_m", "most_depth_m"), [("stereo", 0.006, 0.15), ("lidar", 0.004, 0.15)]
)
def test_it_tracks_and_maps(walk: Walk, mapped: dict, kind: str, most_m: float, most_depth_m: float) -> None:
    odometry, (gaussians,), error_m = mapped[kind]
    assert len(odometry) == FRAMES
    assert error_m < most_m
    errors, covered = [], []
    for k in (3, 10, 17):
        render = Rasterizer().forward(gaussians, CAMERA, se3.inverse(odometry[k].T_map_camera))
        depth_error_m, completeness = depth_error(render, walk.depths[k].astype(np.float32))
        errors.append(depth_error_m)
        covered.append(completeness)
    print(kind, error_m, errors, covered)
    assert np.mean(errors) < most_depth_m
    assert np.mean(covered) > 0.95  # a map with holes is measured where it is easy


def test_stereo_is_tracked_better_by_its_sigma_than_by_a_sensor_model(
    walk: Walk, mapped: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    odometry, _, error_m = mapped["stereo"]  # maps change no pose: tests/bench/test_frontend.py
    frame = RgbdLog.frame
    monkeypatch.setattr(
        RgbdLog, "frame", lambda log, k, **options: replace(frame(log, k, **options), depth_sigma=None)
    )
    model, _, without_m = followed(walk, "stereo", tmp_path / "model.mcap", False)
    assert len(odometry) == FRAMES
    print(error_m, without_m, len(model))
    assert error_m < 0.006
    assert without_m > 2 * error_m or len(model) < FRAMES
