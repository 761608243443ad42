"""How long a shutter is open, found by images that were drawn as their camera moved."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import SparseStepsConfig
from duagc.pipeline.frontend.shutter import ShutterSearch
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.kernels.moving_views import draw_moving
from duagc.pipeline.recording import LogWriter
from duagc.pipeline.recording.depth_motion import DepthMotion
from duagc.pipeline.recording.shutter import found_shutter_s, stated_shutter_s
from duagc.pipeline.splat.gaussians import Gaussians
from tests.frontend.test_mapping import CAMERA, POSES, QUICK, build, posed, same

FRAME_S, SHUTTER_S = 1 / 30, 0.03
FRAMES = 24


def a_wall() -> Gaussians:
    """Colored discs on a wall 2 m away, of a few pixels each."""
    rng, n = np.random.default_rng(0), 1200
    return Gaussians(
        ids=np.arange(n),
        anchors=np.zeros(n, dtype=np.int32),
        means=np.stack([rng.uniform(-3, 3, n), rng.uniform(-2, 2, n), rng.normal(2.0, 0.02, n)], axis=1),
        quats_wxyz=np.tile([1.0, 0, 0, 0], (n, 1)),
        log_scales=np.tile(np.log([0.08, 0.08, 0.005]), (n, 1)),
        colors=rng.random((n, 3)),
        opacity_logits=np.full(n, 2.0),
    )


def a_path() -> Trajectory:
    """A camera that looks around, now faster, now slower."""
    k = np.arange(FRAMES)
    turned = np.stack([0.2 * np.sin(0.9 * k), 0.3 * np.sin(0.6 * k)], axis=1)
    poses = se3.exp(np.concatenate([np.zeros((FRAMES, 3)), turned, np.zeros((FRAMES, 1))], axis=1))
    return Trajectory((1e9 * FRAME_S * k).astype(np.int64), poses)


ESTIMATED = QUICK.model_copy(update={"shutter": "estimated"})


def found_s(
    shutter_s: float, error: float, stated_s: float | None = None, config: MappingConfig = ESTIMATED
) -> float:
    """What is found of a log whose images were taken with a shutter, by a map whose colors have errors."""
    path, wall, rasterizer = a_path(), a_wall(), Rasterizer()
    motion = DepthMotion(path)

    def read(index: int, T_map_camera: np.ndarray) -> PosedRgbd:
        stamp_ns = int(path.stamps_ns[index])
        times_ns = stamp_ns + (1e9 * shutter_s * (np.arange(9) - 4) / 9).astype(np.int64)
        seen = draw_moving(
            rasterizer, wall, CAMERA, T_map_camera @ motion.at(stamp_ns, times_ns), depth_kind="blended"
        )
        depth_m = np.where(seen.alpha > 0.5, seen.depth / np.maximum(seen.alpha, 0.5), 0).astype(np.float32)
        color = np.rint(255 * np.clip(seen.color, 0, 1)).astype(np.uint8)
        return PosedRgbd(color, depth_m, T_map_camera)

    log = SimpleNamespace(stated_shutter_s=stated_s, camera=CAMERA, motion_along=DepthMotion)
    frames = [SimpleNamespace(frame_index=i, stamp_ns=int(s)) for i, s in enumerate(path.stamps_ns)]
    noise = np.random.default_rng(1).normal(scale=error, size=wall.colors.shape)
    grown = wall.replace(colors=(wall.colors + noise).astype(np.float32))
    return ShutterSearch(log, config, path, read, depth="blended").run(
        grown, [f for f in frames if f.frame_index % 3], frames[::3]
    )


def test_the_time_is_found_where_images_are_blurred_and_none_where_they_are_sharp() -> None:
    for error in (0.0, 0.3):
        assert found_s(SHUTTER_S, error) == pytest.approx(SHUTTER_S, rel=0.3)
        assert found_s(0.0, error) == 0.0


def test_what_the_log_states_counts() -> None:
    assert found_s(0.0, 0.0, stated_s=0.012) == found_s(0.0, 0.0, stated_s=0.012, config=QUICK) == 0.012
    assert found_s(SHUTTER_S, 0.0, config=QUICK) == 0.0
    assert stated_shutter_s({"exposure_s": "0.02"}, "a.mcap") == 0.02
    assert stated_shutter_s({}, "a.mcap") is None
    for text in ("-1", "long", "nan", "5"):
        with pytest.raises(DuagError, match=r"a\.mcap: exposure_s is .*, expected 0 to 1 seconds"):
            stated_shutter_s({"exposure_s": text}, "a.mcap")


def test_a_run_keeps_the_time(tmp_path: Path) -> None:
    for name, notes in (("a", {}), ("b", {"shutter_s": repr(0.0213)})):
        with LogWriter(tmp_path / f"{name}.mcap", "alpha", notes):
            pass
    assert found_shutter_s(tmp_path / "a.mcap") == 0.0
    assert found_shutter_s(tmp_path / "b.mcap") == 0.0213


def test_moments_change_the_final_optimization_only_in_its_last_part() -> None:
    moments = se3.exp(np.linspace(-0.02, 0.02, 3)[:, None] * np.array([1.0, 0, 0, 0, 1, 0]))
    maps = []
    for given, moving_from in ((None, 0.7), (moments, 1.0), (moments, 0.7)):
        config = QUICK.model_copy(update={"sparse": SparseStepsConfig(moving_from=moving_from)})
        mapper, _ = build(config)
        mapper.add_view(2, posed(POSES[3]))
        mapper.open_shutter([given] * 4)
        mapper.finalize()
        maps.append(mapper.gaussians)
    assert same(maps[0], maps[1])
    assert not same(maps[0], maps[2])
