"""Depth in coarse steps of disparity becomes the surface again."""

from pathlib import Path

import numpy as np
import pytest

from duagc.converters.simulate.sensors.noise import quantized
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import depth_sources, open_rgbd
from duagc.pipeline.recording.depth_steps import COARSE_PER_M, inverse_step_per_m, without_steps
from duagc.pipeline.recording.pairing import pair
from tests.fixtures.recording_logs import png, write_camera

CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 79.5, 59.5)
STEP = 0.01


def slanted(tilt: float = 0.6) -> np.ndarray:
    """A wall 2 m away, turned about the vertical and a little about the horizontal."""
    rays = CAMERA.rays()
    return (2.0 / (1.0 + tilt * rays[..., 0] + 0.2 * rays[..., 1])).astype(np.float32)


def in_units(depth_m: np.ndarray, unit_m: float = 0.001) -> np.ndarray:
    return (np.rint(depth_m / unit_m) * unit_m).astype(np.float32)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_a_slanted_wall_is_a_plane_again() -> None:
    truth = slanted()
    seen = in_units(quantized(truth, STEP))
    found = without_steps(seen, STEP)
    assert rms(found - truth) < 0.35 * rms(seen - truth)
    normals = [np.diff(depth, axis=1) for depth in (truth, seen, found)]
    assert rms(normals[2] - normals[0]) < 0.35 * rms(normals[1] - normals[0])


def test_no_pixel_moves_by_more_than_half_a_step_and_none_is_invented() -> None:
    truth = slanted()
    truth[:, 70:] -= 0.5  # a nearer surface
    seen = in_units(quantized(truth, STEP))
    seen[40:50, 20:90] = 0
    found = without_steps(seen, STEP)
    known = seen > 0
    np.testing.assert_array_equal(found > 0, known)
    assert np.abs(1 / found[known] - 1 / seen[known]).max() <= STEP / 2 * 1.001
    edge = np.abs(found[:40, 70] - found[:40, 69])
    assert edge.min() > 0.4  # the edge stays an edge


def test_a_wall_that_faces_the_camera_stays() -> None:
    seen = np.full((60, 80), 1.25, np.float32)
    np.testing.assert_allclose(without_steps(seen, STEP), seen, rtol=1e-6)


@pytest.mark.parametrize("step", [0.004, 0.01, 0.02])
@pytest.mark.parametrize("unit_m", [0.001, 0.0002])
def test_the_step_is_found(step: float, unit_m: float) -> None:
    images = [in_units(quantized(slanted(tilt), step), unit_m) for tilt in (0.3, 0.5, 0.7)]
    assert inverse_step_per_m(images, unit_m) == pytest.approx(step, rel=0.02)


def test_depth_without_steps_has_none() -> None:
    rng = np.random.default_rng(5)
    smooth = slanted()
    noisy = smooth + rng.normal(0, 0.01, smooth.shape).astype(np.float32)
    few = np.where(rng.random(smooth.shape) < 0.003, smooth, np.float32(0))  # gaps without a lattice
    for image in (smooth, noisy, few, np.zeros_like(smooth)):
        assert inverse_step_per_m([in_units(image)], 0.001) < 0.2 * COARSE_PER_M
    assert inverse_step_per_m([], 0.001) == 0


@pytest.mark.parametrize(("step", "smoothed"), [(STEP, True), (0.0029, False)])
def test_a_log_is_read_without_coarse_steps(tmp_path: Path, step: float, smoothed: bool) -> None:
    seen = in_units(quantized(slanted(), step))
    raw = np.rint(seen * 1000).astype(np.uint16)
    path = write_camera(
        tmp_path / "alpha.mcap",
        cameras={0: CAMERA},
        color=lambda _: png(np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)),
        depth=lambda _: raw,
    )
    with open_rgbd(path) as log:
        found = log.frame(1).depth
    expected = without_steps(seen, inverse_step_per_m([seen], 0.001)) if smoothed else seen
    np.testing.assert_array_equal(found, expected)
    assert np.array_equal(found, seen) != smoothed


@pytest.mark.parametrize("dropped", [(), (0, 3)], ids=["all", "without two"])
@pytest.mark.parametrize("images", [1, 5, 40, 200, 1000])
def test_images_of_held_out_frames_say_nothing_of_steps(
    monkeypatch: pytest.MonkeyPatch, images: int, dropped: tuple[int, ...]
) -> None:
    """Frames are those of the color images, whatever depth images are missing."""
    looked_at: list[int] = []

    class Log:
        def entries_by_time(self, topic: str) -> dict[int, int]:
            return {k: k for k in range(images) if topic == "/alpha/camera/color" or k not in dropped}

        def record_at(self, _topic: str, entry: int) -> int:
            looked_at.append(entry)
            return entry

    monkeypatch.setattr(depth_sources, "_depth_image", lambda *_: np.ones((4, 4), np.float32))
    camera = PinholeCamera(4, 4, 4.0, 4.0, 1.5, 1.5)
    monkeypatch.setattr(depth_sources, "pair_topics", lambda log, *of: pair(*map(log.entries_by_time, of), 0))
    surfaces = depth_sources._Surfaces(Log(), "depth", 0.001, camera, robot="alpha")
    surfaces.of(np.ones((4, 4), np.float32))
    mapped = [k for k in range(images) if k % 8 != 4 and k not in dropped]
    assert len(looked_at) == min(depth_sources.SOME_IMAGES, len(mapped))
    assert not any(is_held_out(k) for k in looked_at)
