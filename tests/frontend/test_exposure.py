"""Exposures of frames, found from what frames show of the same surfaces."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.config.exposure import ExposureConfig
from duagc.pipeline.config.frontend import FrontendConfig, KeyframeConfig, TrackingConfig
from duagc.pipeline.config.information import InformationConfig
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.evaluation.image_metrics import psnr
from duagc.pipeline.frontend.color_blocks import ColorBlocks
from duagc.pipeline.frontend.exposure import ExposureEstimation
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.stage import run_frontend
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.exposure import Exposure, ExposureTrack, by_table, unit_color, unit_table
from duagc.pipeline.information.stage import run_information
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.recording import RgbdFrame, read_exposures, read_log
from duagc.schemas import topics

CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 79.5, 59.5)
WALLS = (
    (np.array([0.0, 0.0, -1.0]), 3.0),
    (np.array([0.0, -1.0, 0.0]), 1.0),
    (np.array([-1.0, 0.0, 0.0]), 1.5),
)
EVERY = 5  # frames of a keyframe; none of these keyframes is held out
CONFIG = ExposureConfig(width_px=40)


def pose(k: int) -> np.ndarray:
    return se3.exp(0.2 * np.array([0.12 * k, -0.02 * k, 0.05 * k, 0.01 * k, 0.03 * k, 0.0]))


def shot(T_map_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colors 0..1 and depth of three textured walls, each n . X = -d in the map."""
    rays, origin = CAMERA.rays() @ T_map_camera[:3, :3].T, T_map_camera[:3, 3]
    with np.errstate(divide="ignore"):
        hits = np.stack([-(d + origin @ n) / (rays @ n) for n, d in WALLS])
    z = np.where(hits > 0, hits, np.inf).min(axis=0)
    phase = (origin + rays * z[..., None]) @ np.array([[3.0, 1.0, 0.0], [0.0, 2.0, 3.0], [2.0, 0.0, 2.0]])
    return 0.4 + 0.2 * np.sin(phase), z.astype(np.float32)


def frame(index: int, gain: np.ndarray, offset: float = 0.0, **changed: object) -> RgbdFrame:
    color, depth_m = shot(pose(index))
    taken = np.rint(255 * np.clip(gain * color + offset, 0, 1)).astype(np.uint8)
    return RgbdFrame(index, index * 10**8, taken, depth_m, **changed)  # type: ignore[arg-type]


def estimated(frames: list[RgbdFrame], config: ExposureConfig = CONFIG) -> ExposureTrack:
    """Every fifth frame is a keyframe, and sees the one before it and the first."""
    keyframes = [f.index for f in frames if f.index % EVERY == 0]
    tracked = []
    for f in frames:
        k = f.index // EVERY
        T = se3.inverse(pose(keyframes[k])) @ pose(f.index)
        tracked.append(
            TrackedFrame(f.index, f.stamp_ns, k, T, np.eye(6), Status.OK, 1.0, 0.0, 0.0, Reason.NONE)
        )
    poses, last = np.array([pose(k) for k in keyframes]), range(1, len(keyframes))
    pairs = [(k - 1, k) for k in last] + [(0, k) for k in last]
    blocks = [ColorBlocks.of(f, CAMERA, config.width_px) for f in frames]
    return ExposureEstimation(blocks.__getitem__, config).run(keyframes, poses, pairs, tracked)


def wandering(count: int) -> np.ndarray:
    """Gains [count, 3] within 30 %, whose white balance drifts."""
    t = np.arange(count)
    return np.stack([np.exp(0.26 * np.sin(0.4 * t)), 1 + 0.01 * t, np.exp(-0.26 * np.sin(0.3 * t))], axis=1)


def test_gains_that_wander_are_found_but_for_one_factor() -> None:
    gains = wandering(20)
    track = estimated([frame(k, gains[k]) for k in range(20)])
    ratio = track.gain / gains[track.frame_index]
    assert np.std(np.log(ratio), axis=0) == pytest.approx(0.0, abs=0.01)
    assert np.mean(np.log(track.gain), axis=0) == pytest.approx(0.0, abs=1e-3)  # the map has their mean
    assert np.abs(track.offset).max() < 0.01


def test_held_out_frames_take_no_part() -> None:
    gains = wandering(20)
    frames = [frame(k, gains[k]) for k in range(20)]
    track = estimated(frames)
    assert not any(is_held_out(k) for k in track.frame_index.tolist())
    spoiled = [frame(k, 2 * gains[k]) if is_held_out(k) else frames[k] for k in range(20)]
    assert np.array_equal(estimated(spoiled).gain, track.gain)
    between = track.at(4)
    assert between is not None
    assert between.gain == pytest.approx(np.sqrt(track.at(3).gain * track.at(5).gain))  # type: ignore[union-attr]


def test_constant_exposure_is_none() -> None:
    noise = np.random.default_rng(0)
    frames = []
    for k in range(20):
        f = frame(k, np.ones(3))
        noisy = np.clip(f.color + np.rint(noise.normal(0, 3, f.color.shape)), 0, 255).astype(np.uint8)
        frames.append(RgbdFrame(k, f.stamp_ns, noisy, f.depth))
    track = estimated(frames)
    assert len(track.frame_index) == 0
    assert track.at(3) is None
    asked = estimated(frames, CONFIG.model_copy(update={"mode": "on"}))
    assert len(asked.frame_index) == 18
    assert 0.4 * asked.gain + asked.offset == pytest.approx(0.4, abs=0.002)  # of middle colors


def test_off_is_off() -> None:
    gains = wandering(13)
    frames = [frame(k, gains[k]) for k in range(13)]
    assert len(estimated(frames, CONFIG.model_copy(update={"mode": "off"})).frame_index) == 0


def test_masked_and_clipped_pixels_say_nothing() -> None:
    gains = wandering(13)
    frames = []
    for k in range(13):
        f = frame(k, gains[k])
        mask = np.ones(f.depth.shape, dtype=bool)
        mask[:30] = False
        color = f.color.copy()
        color[:30] = 40 * (k % 3)
        color[60:70, 20:60] = 255
        frames.append(RgbdFrame(k, f.stamp_ns, color, f.depth, mask))
    track = estimated(frames)
    assert np.std(np.log(track.gain / gains[track.frame_index]), axis=0) == pytest.approx(0.0, abs=0.015)


def test_what_two_frames_do_not_share_is_not_compared() -> None:
    first = ColorBlocks.of(frame(0, np.ones(3)), CAMERA, 40)
    own, other = first.shared_with(first, np.eye(4))
    assert len(own) > 500
    assert own == pytest.approx(other, abs=1e-6)
    behind = se3.exp(np.array([0.0, 0, 0, 0, np.pi, 0]))
    assert len(first.shared_with(first, behind)[0]) == 0
    nearer = se3.exp(np.array([0.0, 0, 0.5, 0, 0, 0]))
    assert len(first.shared_with(first, nearer)[0]) < 0.1 * len(own)


def test_an_image_in_the_colors_of_the_map_and_back() -> None:
    exposure = Exposure(np.array([0.7, 1.0, 1.4]), np.array([0.02, 0.0, -0.02]), np.full(3, 1.4))
    color, _ = shot(pose(0))
    taken = np.rint(255 * exposure.in_image(color, np.ones(color.shape[:2]))).astype(np.uint8)
    assert exposure.in_map(taken) == pytest.approx(color, abs=1.5 / 255)
    nothing = np.zeros((2, 2))
    assert not exposure.in_image(np.zeros((2, 2, 3)), nothing).any()  # the background stays black


def test_what_is_saturated_is_white_in_every_frame() -> None:
    track = ExposureTrack.of([0, 1], np.array([[0.8] * 3, [1.25] * 3]), np.zeros((2, 3)))
    assert track.white == pytest.approx(1.25)
    white = np.full((2, 2, 3), 255, np.uint8)
    for k in (0, 1):
        exposure = track.at(k)
        assert exposure is not None
        assert exposure.in_map(white) == pytest.approx(1.25)
        assert exposure.in_image(exposure.in_map(white), np.ones((2, 2))).min() >= 1


def gains_of_log(k: int) -> np.ndarray:
    return np.array([np.exp(0.25 * np.sin(0.7 * k)), 1.0, np.exp(-0.25 * np.sin(0.7 * k))])


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A walk through the walls, once with gains that wander and once without."""
    out = {}
    for name in ("wandering", "constant"):
        folder = tmp_path_factory.mktemp(name) / "walls"
        with RecordingWriter(folder) as recording, recording.robot("alpha", CAMERA, 0.0005) as robot:
            for k in range(14):
                f = frame(k, gains_of_log(k) if name == "wandering" else np.ones(3))
                png = cv2.imencode(".png", f.color[..., ::-1])[1].tobytes()
                robot.add_frame(f.stamp_ns, png, "png", np.rint(f.depth / 0.0005).astype(np.uint16))
        run_frontend(folder / "alpha.mcap", folder / "frontend.mcap", STAGE)
        out[name] = folder
    return out


STAGE = FrontendConfig(
    tracking=TrackingConfig(strides=(2, 1, 1, 1)),
    keyframes=KeyframeConfig(min_overlap=0.97),
    exposure=CONFIG,
    mapping=MappingConfig(max_gaussians=3000, iterations=8, final_iterations=30, final_iterations_view=0),
)


def test_the_stage_logs_exposures_where_they_differ(logs: dict[str, Path]) -> None:
    assert len(read_exposures(logs["constant"] / "frontend.mcap", "alpha").frame_index) == 0
    track = read_exposures(logs["wandering"] / "frontend.mcap", "alpha")
    assert {4, 12}.isdisjoint(track.frame_index.tolist())
    assert len(track.frame_index) == 12
    true = np.array([gains_of_log(k) for k in track.frame_index.tolist()])
    assert np.std(np.log(track.gain / true), axis=0) == pytest.approx(0.0, abs=0.02)


def test_a_map_of_wandering_exposures_is_nearly_as_good_as_one_of_a_constant_one(
    logs: dict[str, Path],
) -> None:
    """Also what information and fusion take from the log is in the colors of the map."""
    scores, sigmas = {}, {}
    for name, folder in logs.items():
        track = read_exposures(folder / "frontend.mcap", "alpha")
        gaussians = [r.message() for r in read_log(folder / "frontend.mcap", (topics.MAP.of("alpha"),))][
            -1
        ].gaussians
        color, _ = shot(pose(4))  # held out
        render = Rasterizer().forward(gaussians, CAMERA, se3.inverse(pose(4)))
        true = np.array([gains_of_log(k) for k in track.frame_index.tolist()])
        scale = np.exp(np.log(track.gain / true).mean(axis=0)) if len(true) else np.ones(3)
        scores[name] = psnr(scale * render.color, color)
        information = run_information(
            folder / "alpha.mcap",
            folder / "frontend.mcap",
            folder / "information.mcap",
            config=InformationConfig(),
            moving=STAGE.moving,
            thickness_floor_m=1e-3,
        )
        sigmas[name] = information.color_sigma
    assert scores["wandering"] > max(scores["constant"] - 4, 43)
    assert sigmas["wandering"] < sigmas["constant"] + 0.005


def test_frames_are_compared_in_as_many_blocks_as_are_asked_for() -> None:
    """More than OpenCV takes as rows of one image."""
    camera = PinholeCamera(320, 240, 260.0, 260.0, 159.5, 119.5)
    color = np.random.default_rng(0).integers(20, 200, (240, 320, 3)).astype(np.uint8)
    blocks = ColorBlocks.of(RgbdFrame(0, 0, color, np.full((240, 320), 2, np.float32)), camera, width_px=320)
    own, other = blocks.shared_with(blocks, np.eye(4))
    assert len(own) > 70_000
    np.testing.assert_allclose(own, other, atol=1e-3)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.04])
def test_holes_all_over_the_depth_leave_the_gain(share: float) -> None:
    """Stereo depth has scattered pixels without a value: in every block there are some."""
    rng, gains = np.random.default_rng(1), wandering(13)
    frames = []
    for k in range(13):
        f = frame(k, gains[k])
        depth_m = np.where(rng.random(f.depth.shape) < share, np.float32(0), f.depth)
        frames.append(RgbdFrame(k, f.stamp_ns, f.color, depth_m))
    track = estimated(frames)
    assert len(track.frame_index) == sum(not is_held_out(k) for k in range(13))
    assert np.std(np.log(track.gain / gains[track.frame_index]), axis=0) == pytest.approx(0.0, abs=0.015)


def test_depth_with_one_large_hole_is_read_as_before() -> None:
    f = frame(0, np.ones(3))
    half = f.depth.copy()
    half[:, 80:] = 0
    whole, blocks = ColorBlocks.of(f, CAMERA, 40), ColorBlocks.of(replace(f, depth=half), CAMERA, 40)
    np.testing.assert_array_equal(blocks.inverse_depth[:, :20], whole.inverse_depth[:, :20])
    assert np.isnan(blocks.inverse_depth[:, 20:]).all()


@pytest.mark.parametrize("exposed", [False, True])
def test_what_a_training_takes_of_an_image_is_the_image_in_the_colors_of_the_map(exposed: bool) -> None:
    random = np.random.default_rng(1)
    exposure = (
        Exposure(np.array([0.8, 1.0, 1.3]), np.array([0.02, 0.0, -0.03]), np.ones(3)) if exposed else None
    )
    color, alpha = random.integers(0, 256, (6, 8, 3), np.uint8), random.random((6, 8), np.float32)
    table = unit_table(exposure)
    assert np.array_equal(table[color, np.arange(3)], unit_color(color, exposure))
    assert np.array_equal(by_table(color, table), unit_color(color, exposure))
    if exposure is not None:
        shown = unit_color(color, exposure)
        gain, offset = exposure.gain.astype(np.float32), exposure.offset.astype(np.float32)
        in_image = gain * shown + offset * alpha[..., None]
        assert np.array_equal(exposure.in_image(shown, alpha), in_image)
