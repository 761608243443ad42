"""Depth beyond the range of the depth camera: a floor that is measured up to 3 m, and a wall at 6 m that is not."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.mapping import FarDepthConfig, MappingConfig
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.frontend.far_depth import FarDepth
from duagc.pipeline.frontend.mapping import Mapper
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.recording import read_log
from duagc.schemas import topics
from tests.frontend.test_checkpoints import SMALL, Runs, undisturbed

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 159.5, 119.5)
RANGE_M, WALL_M, FLOOR_M = 3.0, 6.0, 0.6
POSES = [se3.exp(np.array([0.16 * k, 0.02 * k, 0.03 * k, 0.0, 0.01 * k, 0.0])) for k in range(5)]
WAVES = np.random.default_rng(3).normal(size=(40, 3)) * [9.0, 9.0, 9.0]
PHASES = np.random.default_rng(4).uniform(0, 2 * np.pi, 40)


def shot(
    T: np.ndarray, gain: float = 1.0, contrast: float = 1.0, camera: PinholeCamera = CAMERA
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Color, depth as measured, and true depth."""
    rays = camera.rays() @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        floor, wall = (FLOOR_M - T[1, 3]) / rays[..., 1], (WALL_M - T[2, 3]) / rays[..., 2]
    z = np.minimum(np.where(floor > 0, floor, np.inf), wall)
    points = T[:3, 3] + rays * z[..., None]
    gray = 110 + 12 * contrast * np.sin(points @ WAVES.T + PHASES).sum(axis=-1)
    color = np.rint(np.clip(gain * gray, 0, 255)).astype(np.uint8)[..., None].repeat(3, axis=2)
    return color, np.where(z <= RANGE_M, z, 0).astype(np.float32), z


def found(
    count: int = 5, hole: bool = False, gains: tuple[float, ...] = (1.0,) * 5, contrast: float = 1.0
) -> np.ndarray | None:
    """Depth of the middle keyframe, of so many."""
    far = FarDepth(CAMERA, FarDepthConfig())
    for T, gain in zip(POSES[:count], gains, strict=False):
        color, depth_m, _ = shot(T, gain, contrast)
        if hole:
            depth_m[205:235, 100:200] = 0
        far.add(color, depth_m, T)
    return far.of(min(2, count - 1))


@pytest.mark.parametrize("gains", [(1.0,) * 5, (0.7, 1.1, 0.9, 0.8, 1.2)])
def test_what_is_too_far_is_found_whatever_the_exposure(gains: tuple[float, ...]) -> None:
    _, measured, true = shot(POSES[2])
    far_m = found(gains=gains)
    assert far_m is not None
    assert far_m.shape == measured.shape
    assert not far_m[measured > 0].any()
    missing, known = measured == 0, far_m > 0
    assert known.sum() > 0.7 * missing.sum()
    assert np.median(np.abs(far_m[known] / true[known] - 1)) < 0.06
    assert np.percentile(np.abs(far_m[known] / true[known] - 1), 90) < 0.3


def test_holes_of_another_kind_stay() -> None:
    far_m = found(hole=True)
    assert far_m is not None
    assert not far_m[205:235, 100:200].any()
    assert (far_m > 0).sum() > 0.5 * (shot(POSES[2])[1] == 0).sum()


def test_what_looks_alike_everywhere_is_not_found() -> None:
    assert found(contrast=0.01) is None


def test_one_keyframe_or_two_are_too_few() -> None:
    assert found(count=1) is None
    assert found(count=2) is None


def test_where_all_is_measured_nothing_is_looked_for() -> None:
    far = FarDepth(CAMERA, FarDepthConfig())
    for T in POSES:
        color, _, z = shot(T)
        far.add(color, z.astype(np.float32), T)
    assert far.of(2) is None


def test_a_map_is_seeded_there_and_is_not_trained_on_it() -> None:
    color, depth_m, _ = shot(POSES[2])
    far_m = found()
    mappers = [Mapper(CAMERA, MappingConfig(max_gaussians=4000, iterations=0), seed=0) for _ in range(2)]
    for mapper, more in zip(mappers, ({}, {"far_m": far_m}), strict=True):
        mapper.add_keyframe(0, PosedRgbd(color, depth_m, np.eye(4)), **more)
    near, all_of_it = (mapper.gaussians for mapper in mappers)
    assert near.means[:, 2].max() < RANGE_M + 0.1
    far = all_of_it.means[:, 2] > 1.5 * RANGE_M
    assert far.sum() > 200
    assert np.median(np.abs(all_of_it.means[far, 2] / WALL_M - 1)) < 0.1
    view = mappers[1]._views[0]
    assert np.array_equal(view.training(0).depth_m, depth_m)
    assert np.array_equal(view.depth_m, depth_m)


def write(folder: Path) -> Path:
    """A log of a robot that walks along the wall, and up and down, and looks at floor and wall."""
    camera = CAMERA.halved()
    with RecordingWriter(folder) as recording, recording.robot("alpha", camera, 0.0005) as robot:
        for k in range(12):
            height, pitch = 0.1 * np.sin(0.5 * k), -0.15 + 0.02 * np.sin(0.4 * k)
            T = se3.exp(np.array([0.04 * k, height, 0.01 * k, pitch, 0.003 * k, 0]))
            color, depth_m, _ = shot(T, camera=camera)
            raw = np.rint(depth_m / 0.0005).astype(np.uint16)
            robot.add_frame(33_333_333 * k, cv2.imencode(".png", color)[1].tobytes(), "png", raw)
    return folder / "alpha.mcap"


def test_the_stage_seeds_there_also_when_it_was_killed(tmp_path: Path) -> None:
    overrides = [*SMALL, "frontend.mapping.max_gaussians=6000", "frontend.keyframes.min_overlap=0.93"]
    overrides += ["frontend.mapping.iterations=2", "frontend.mapping.final_iterations=4"]
    config = load_config(RunConfig, overrides=overrides).frontend
    log = write(tmp_path / "recording")
    digest, _ = undisturbed(log, config, tmp_path)
    (map_message,) = (r.message() for r in read_log(tmp_path / "undisturbed.mcap", (topics.MAP.of("alpha"),)))
    assert (map_message.gaussians.means[:, 2] > 1.5 * RANGE_M).sum() > 100
    killed = Runs(log, tmp_path, config)
    assert killed.until_done(17) == digest
    assert [line for line in killed.said if line.startswith("alpha.final: goes on")], killed.said
