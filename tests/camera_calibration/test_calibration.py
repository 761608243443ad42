"""Cameras that are known, estimated from what they see; and recordings that do not determine them."""

from copy import copy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.camera_calibration import calibrate as calibration
from duagc.pipeline.camera_calibration.adjustment import (
    Quality,
    _features,
    _of_planes,
    _planes,
    adjust,
    overlapping,
)
from duagc.pipeline.camera_calibration.calibrate import Judged, calibrate
from duagc.pipeline.camera_calibration.rig import NAMES, CameraRig
from duagc.pipeline.camera_calibration.tracked import READ_AT_ONCE, Tracked, track_log
from duagc.pipeline.camera_calibration.undetermined import UndeterminedError
from duagc.pipeline.camera_calibration.views import (
    NORMALS_LEVEL,
    Views,
    _landmarks,
    _velocities,
    load_views,
)
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import Recording, RgbdFrame, RgbdLog
from duagc.pipeline.recording.rolling_shutter import Readout
from duagc.pipeline.registration.pyramid import RgbdPyramid

CAMERA = PinholeCamera(320, 240, 262.0, 262.0, 160.0, 118.0)
TRUE = CameraRig(
    CAMERA,
    np.array([266.0, 265.0, 163.0, 121.0, 0.08, -0.30, 0.25]),
    so3.exp(np.array([0.006, -0.008, 0.01])),
    0.004,
    np.array([0.012, -0.015, 0.006, -0.018, 0.005, 0.008]),
)
ROOM_HALF_M = np.array([2.4, 1.6, 2.0])
VIEWS, LANDMARKS = 14, 500


def distance(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Along rays [n, 3] from inside the room, with a pillar in it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = np.where(rays > 0, (ROOM_HALF_M - origin) / rays, (-ROOM_HALF_M - origin) / rays).min(axis=1)
        a, b = ((np.array([0.3, 0.4, 0.5]) + s * np.array([0.3, 1.2, 0.25]) - origin) / rays for s in (-1, 1))
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return np.where((enter < leave) & (enter > 0), enter, walls)


def pose(k: int) -> np.ndarray:
    turn = np.array([0.25 * np.sin(1.3 * k), -0.5 + 0.08 * k, 0.15 * np.cos(k)])
    return se3.from_rotation_translation(so3.exp(turn), [0.8 - 0.1 * k, 0.3 * np.sin(k), -1.5 + 0.05 * k])


def make_views(
    seed: int,
    noise_per_m: float = 0.001,
    count: int = 150,
    landmarks_count: int = LANDMARKS,
    *,
    readout: Readout = READ_AT_ONCE,
) -> Views:
    """Views of the room as the true cameras see it, with noise of 1/z and samples, at poses that are a little wrong."""
    rng = np.random.default_rng(seed)
    T = np.array([pose(k) for k in range(VIEWS)])
    velocity = rng.normal(size=(VIEWS, 6)) * 0.4
    rays = CAMERA.rays()
    x, y = rays[..., 0], rays[..., 1]
    error = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1) @ TRUE.depth_error
    inverse, normals, samples, depths = [], [], [], []
    share = np.arange(CAMERA.height) / (CAMERA.height - 1) - 0.5
    T_row = T[:, None] @ se3.exp(readout.depth_s * share[:, None] * velocity[:, None])
    for k in range(VIEWS):
        depth = np.stack(
            [distance(M[:3, 3], row @ M[:3, :3].T) for M, row in zip(T_row[k], rays, strict=True)]
        )
        depths.append(depth)
        measured = (1 / depth - error) / (1 - 2 * TRUE.depth_error[0])
        measured = 1 / (1 / measured + rng.normal(size=depth.shape) * noise_per_m)
        noisy = (1 / measured).astype(np.float32)
        pyramid = RgbdPyramid.build(np.zeros(depth.shape, np.float32), noisy, CAMERA, NORMALS_LEVEL + 1)
        inverse.append(pyramid.levels[0].inverse_depth)
        normals.append(pyramid.levels[NORMALS_LEVEL].normals)
        v, u = np.nonzero(np.abs(normals[-1]).sum(axis=-1) > 0)
        picked = rng.choice(len(v), count, replace=False)
        samples.append(np.stack([u[picked], v[picked]], axis=-1) << NORMALS_LEVEL)
    late_s = np.random.default_rng(100 + seed).uniform(-0.01, 0.01, VIEWS)
    to_camera = se3.inverse(T)
    points, seen_by, landmarks, pixels = [], [], [], []
    for m in range(landmarks_count):
        k, u, v = rng.integers(VIEWS), rng.integers(5, 315), rng.integers(5, 235)
        points.append(se3.transform(T_row[k, v], (rays[v, u] * depths[k][v, u])[None])[0])
        q = se3.transform(to_camera, points[m][None])
        read_s = np.zeros(VIEWS)
        for _ in range(6):  # the row that sees a point is that which is read when it does
            to_exposure = se3.exp(-(TRUE.delay_s + late_s + read_s)[:, None] * velocity)
            p = (se3.transform(to_exposure, q) @ TRUE.R_color_depth.T)[:, 0]
            pixel = TRUE.project(p)[0]
            read_s = readout.color_s * (np.clip(pixel[:, 1] / (CAMERA.height - 1), 0, 1) - 0.5)
        seen = (q[:, 0, 2] >= 0.1) & ((pixel >= 0) & (pixel < (320, 240))).all(axis=1)
        seen &= np.hypot(*(p[:, :2] / p[:, 2:]).T) < 0.75
        for i in np.flatnonzero(seen).tolist():
            ray = (points[m] - T[i, :3, 3])[None]
            if distance(T[i, :3, 3], ray)[0] > 0.999:
                seen_by.append(i)
                landmarks.append(m)
                pixels.append(pixel[i] + rng.normal(size=2) * 0.1)
    wrong = T @ se3.exp(rng.normal(size=(VIEWS, 6)) * 0.003)
    return Views(
        f"room {seed}",
        CAMERA,
        wrong,
        velocity,
        np.array(inverse),
        np.array(normals),
        np.array(samples),
        np.array(seen_by, np.int64),
        np.array(landmarks, np.int64),
        np.reshape(pixels, (-1, 2)),
        np.reshape(points, (-1, 3)) + rng.normal(size=(landmarks_count, 3)) * 0.01,
        np.arange(VIEWS),
        late_s,
        readout,
    )


@pytest.fixture(scope="module")
def views() -> Views:
    return make_views(0)


ROLLING = Readout(color_s=0.03, depth_s=0.025)


@pytest.fixture(scope="module")
def rolling_views() -> Views:
    return make_views(1, readout=ROLLING)


@pytest.mark.parametrize("which", ["views", "rolling_views"])
def test_derivatives_are_those_of_the_residuals(which: str, request: pytest.FixtureRequest) -> None:
    """By differences; those of depth roughly, for sigma(z), which divides it, is held."""
    views: Views = request.getfixturevalue(which)
    step = 1e-6
    features = _features(views, TRUE)
    for k in range(len(NAMES)):
        e = np.zeros(len(NAMES))
        e[k] = step
        ahead, behind = (_features(views, TRUE.moved(s * e)) for s in (1, -1))
        by_image = (ahead.off_px - behind.off_px) / (2 * step)
        by_depth = np.where(features.used, (ahead.distance - behind.distance) / (2 * step), 0)
        np.testing.assert_allclose(features.by_rig[:, :2, k], by_image, rtol=2e-3, atol=1e-3)
        off = np.abs(features.by_rig[:, 2, k] - by_depth)[features.used]
        assert np.median(off) <= 0.1 * np.median(np.abs(by_depth[features.used]))
    for k in range(6):
        e = np.zeros(6)
        e[k] = step
        ahead, behind = copy(views), copy(views)
        ahead.T_map_camera = views.T_map_camera @ se3.exp(e)
        behind.T_map_camera = views.T_map_camera @ se3.exp(-e)
        by_image = (_features(ahead, TRUE).off_px - _features(behind, TRUE).off_px) / (2 * step)
        np.testing.assert_allclose(features.by_view[:, :2, k], by_image, rtol=1e-3, atol=1e-2)
    pairs = overlapping(views)
    planes = _planes(views, pairs, TRUE)
    assert planes.used.mean() > 0.3
    for k in range(6):
        e = np.zeros(len(NAMES))
        e[11 + k] = step
        ahead, behind = (_planes(views, pairs, TRUE.moved(s * e)) for s in (1, -1))
        by_depth = (ahead.distance - behind.distance) / (2 * step)
        both = planes.used & ahead.used & behind.used
        off = np.abs(planes.by_depth[..., k] - by_depth)[both]
        assert np.median(off) < 0.15 * np.median(np.abs(by_depth[both]))  # points move to other pixels


def test_noise_of_depth_pushes_no_coefficient() -> None:
    """At the true poses and cameras only chance pulls at the error of depth, though depth is in its derivative."""
    noisy = make_views(0, noise_per_m=0.006, count=2500, landmarks_count=0)
    noisy.T_map_camera = np.array([pose(k) for k in range(VIEWS)])
    H, g = _of_planes(noisy, overlapping(noisy), TRUE, len(NAMES))
    pull = g[-6:] / np.sqrt(np.diag(H)[-6:])
    assert np.abs(pull).max() < 4, pull


def test_known_cameras_are_found(views: Views) -> None:
    """From one walk through the room within their standard deviations; and they hold on another walk."""
    found = adjust([make_views(1)], CameraRig.of(CAMERA), True)
    assert found.covariance is not None
    sigma = np.sqrt(np.diag(found.covariance))
    off = np.abs(found.rig.values() - TRUE.values())
    for name, value, limit in zip(NAMES, off, np.maximum(4 * sigma, 1e-3), strict=True):
        assert value < limit, name
    # the numbers together are known much better than each
    p = np.column_stack([np.random.default_rng(0).uniform(-0.45, 0.45, (200, 2)), np.ones(200)])
    true = TRUE.project(p @ TRUE.R_color_depth.T)[0]
    moved = found.rig.project(p @ found.rig.R_color_depth.T)[0] - true
    before = CameraRig.of(CAMERA).project(p)[0] - true
    assert np.median(np.linalg.norm(moved, axis=-1)) < 0.15 * np.median(np.linalg.norm(before, axis=-1))
    as_recorded = adjust([copy(views)], CameraRig.of(CAMERA), False).quality[0]
    held_out = adjust([copy(views)], found.rig, False).quality[0]
    assert held_out.features_px < 0.5 * as_recorded.features_px
    assert held_out.depth < as_recorded.depth


def test_cameras_that_read_row_after_row_are_found(rolling_views: Views) -> None:
    """Within their standard deviations; were the rows taken for one time, views would agree less."""
    found = adjust([copy(rolling_views)], CameraRig.of(CAMERA), True)
    assert found.covariance is not None
    off = np.abs(found.rig.values() - TRUE.values())
    for name, value, limit in zip(
        NAMES, off, np.maximum(4 * np.sqrt(np.diag(found.covariance)), 1e-3), strict=True
    ):
        assert value < limit, name
    at_once = adjust([replace(rolling_views, readout=READ_AT_ONCE)], CameraRig.of(CAMERA), True)
    quality, at_once_quality = found.quality[0], at_once.quality[0]
    assert quality.features_px < 0.5 * at_once_quality.features_px
    assert quality.depth_of_features < 0.8 * at_once_quality.depth_of_features
    assert quality.depth < 0.8 * at_once_quality.depth


def test_a_robot_whose_images_show_nothing_to_follow_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    landmarks = {"alpha": 220, "bravo": 220, "charlie": 0}
    seen = {robot: make_views(k, landmarks_count=n) for k, (robot, n) in enumerate(landmarks.items())}
    tracked = [
        Tracked(Path(), robot, np.zeros((9, 4, 4)), np.ones(9, bool), np.zeros(9, bool), np.arange(9))
        for robot in seen
    ]

    def loaded(part: Tracked, first: int, last: int, most: int, *, without: object = ()) -> Views:
        return copy(seen[part.robot])

    source = SimpleNamespace(robots=list(seen), log=Path, description={})
    monkeypatch.setattr(calibration, "Recording", lambda folder: source)
    monkeypatch.setattr(calibration, "_track", lambda logs, config, pool: tracked)
    monkeypatch.setattr(calibration, "load_views", loaded)
    found = calibrate(Path("team"), FrontendConfig(), [])
    assert found.names == ["room 0", "room 1"]
    assert found.views == 2 * VIEWS
    assert all(np.isfinite([*judged.before.__dict__.values()]).all() for judged in found.judged)


def test_a_robot_of_few_frames_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = {"alpha": 60, "bravo": 60, "charlie": 5}
    seen = {robot: make_views(k, landmarks_count=220) for k, robot in enumerate(frames)}

    def tracked(log: Path, robot: str, config: FrontendConfig) -> Tracked:
        n = frames[robot]
        return Tracked(log, robot, np.zeros((n, 4, 4)), np.ones(n, bool), np.zeros(n, bool), np.arange(n))

    def loaded(part: Tracked, first: int, last: int, most: int, *, without: object = ()) -> Views:
        assert last - first >= 8
        return copy(seen[part.robot])

    source = SimpleNamespace(robots=list(frames), log=Path, description={})
    monkeypatch.setattr(calibration, "Recording", lambda folder: source)
    monkeypatch.setattr(calibration, "track_log", tracked)
    monkeypatch.setattr(calibration, "load_views", loaded)
    assert calibrate(Path("team"), FrontendConfig(), []).names == ["room 0", "room 1"]


def test_agreement_of_exact_cameras_is_no_better_for_being_smaller() -> None:
    exact = Judged("half", "the other half", Quality(0.15, 0.04, 0.012), Quality(0.15, 0.02, 0.008))
    assert exact.ratios() == [1.0, 1.0, 1.0]
    spoiled = replace(exact, after=Quality(0.15, 0.4, 0.008))
    assert spoiled.ratios() == pytest.approx([1.0, 4.0, 1.0])
    unknown = replace(exact, after=Quality(np.nan, 0.02, 0.008))
    assert np.isnan(unknown.ratios()[0])


def test_a_view_that_sees_nothing_of_the_others_moves_nothing(views: Views) -> None:
    rig = CameraRig.of(CAMERA)
    lonely = copy(views)
    away = lonely.T_map_camera[-1:].copy()
    away[0, :3, 3] += 50.0
    for name, row in (
        ("T_map_camera", away),
        ("velocity", views.velocity[-1:]),
        ("inverse_depth", views.inverse_depth[-1:]),
        ("normals", views.normals[-1:]),
        ("samples", views.samples[-1:]),
    ):
        setattr(lonely, name, np.concatenate([getattr(views, name), row]))
    alone, usual = adjust([lonely], rig, True), adjust([copy(views)], rig, True)
    assert alone.covariance is not None
    assert usual.covariance is not None
    np.testing.assert_allclose(alone.covariance, usual.covariance, rtol=1e-3, atol=1e-12)


def still_recording(folder: Path, contrast: int = 255) -> Path:
    """A camera that does not move, before a wall with a pattern."""
    rng, camera = np.random.default_rng(0), CAMERA.scaled(160, 120)
    pattern = cv2.GaussianBlur(rng.uniform(0, 255, (120, 160)), (0, 0), 2)
    pattern = cv2.normalize(
        pattern, None, (255 - contrast) // 2, (255 + contrast) // 2, cv2.NORM_MINMAX
    ).astype(np.uint8)
    png = cv2.imencode(".png", np.repeat(pattern[..., None], 3, axis=2))[1].tobytes()
    depth = np.full((120, 160), 1500, np.uint16) + (np.arange(160) // 2).astype(np.uint16)
    with RecordingWriter(folder) as recording, recording.robot("alpha", camera, 0.001) as robot:
        for k in range(20):
            robot.add_frame(k * 33_000_000, png, "png", depth)
    return folder


def test_a_camera_that_does_not_move_is_refused(tmp_path: Path) -> None:
    folder = still_recording(tmp_path / "still")
    with pytest.raises(
        UndeterminedError, match=r"still: its images do not determine .*rx, ry.*expected more motion"
    ):
        calibrate(folder, FrontendConfig(), [])
    with pytest.raises(DuagError, match="has no robot bravo, expected one of alpha"):
        calibrate(folder, FrontendConfig(), ["bravo"])


def test_held_out_frames_take_no_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Maps are evaluated by them: their images must not be read, however few others there are."""
    read: list[int] = []
    frame_of = RgbdLog.frame

    def frame(log: RgbdLog, index: int) -> RgbdFrame:
        read.append(index)
        return frame_of(log, index)

    monkeypatch.setattr(RgbdLog, "frame", frame)
    recording = Recording(still_recording(tmp_path / "still"))
    tracked = Tracked(
        path=recording.log("alpha"),
        robot="alpha",
        T_map_camera=np.repeat(np.eye(4)[None], 20, axis=0),
        ok=np.ones(20, dtype=bool),
        held_out=np.array([is_held_out(k) for k in range(20)]),
        stamps_ns=np.arange(20) * 33_000_000,
    )
    views = load_views(tracked, 0, 20, 56)
    assert read == [k for k in range(20) if not is_held_out(k)]
    assert len(views.T_map_camera) == len(read) == 18
    assert views.frames.tolist() == read
    read.clear()
    between = load_views(tracked, 0, 20, 56, without=range(0, 20, 2))
    assert between.frames.tolist() == read == list(range(1, 20, 2))  # held-out ones are even
    monkeypatch.undo()
    held_out = track_log(tracked.path, "alpha", FrontendConfig()).held_out
    np.testing.assert_array_equal(held_out, tracked.held_out)


def test_poses_of_held_out_frames_move_no_view() -> None:
    held_out = np.array([is_held_out(k) for k in range(20)])
    T = np.tile(np.eye(4), (20, 1, 1))
    T[:, 0, 3] = 0.03 * np.arange(20)
    T[held_out, 1, 3] = 0.5
    tracked = Tracked(Path(), "alpha", T, np.ones(20, bool), held_out, 100_000_000 * np.arange(20))
    velocity = _velocities(tracked, np.flatnonzero(~held_out))
    assert velocity == pytest.approx(np.tile([0.3, 0, 0, 0, 0, 0], (18, 1)), abs=1e-9)


def test_a_wall_without_texture_is_refused(tmp_path: Path) -> None:
    folder = still_recording(tmp_path / "bare", contrast=0)
    with pytest.raises(
        DuagError,
        match=r"bare.* tracked frames in alpha, frames 0 to 9 that are not held out .*, expected at least 8",
    ):
        calibrate(folder, FrontendConfig(), [])
    pixels, descriptors = [np.zeros((0, 2))] * 2, [np.zeros((0, 128), np.uint8)] * 2
    found = _landmarks(pixels, descriptors, [np.zeros(0)] * 2, camera=CAMERA, T=np.array([np.eye(4)] * 2))
    assert [len(part) for part in found] == [0, 0, 0, 0]
