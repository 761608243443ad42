"""Rows that were read one after the other, put where a still camera has them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import open_rgbd
from duagc.pipeline.recording.depth_sources import DepthImage, Registered
from duagc.pipeline.recording.read import Record
from duagc.pipeline.recording.rolling_shutter import (
    Readout,
    SeenPoints,
    Unrolling,
    all_lines,
    known_lines,
    line_times_ns,
)

CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 79.5, 59.5)
TWIST = np.array([0.4, -0.2, 0.3, 0.5, 1.2, -0.4])  # m/s and rad/s, of a hasty hand
READOUT_S = 0.03
SCALE_M = 0.0002


def shot(T_world_line: np.ndarray, by_columns: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Color and depth of a slanted wall; T_world_line: where the camera was at each row [h, 4, 4], or column."""
    rays = np.einsum("uij,vuj->vui" if by_columns else "vij,vuj->vui", T_world_line[:, :3, :3], CAMERA.rays())
    normal, origin = np.array([0.3, 0.1, -1.0]), T_world_line[:, :3, 3]
    origin = origin[None] if by_columns else origin[:, None]
    z = (-2.0 - origin @ normal) / (rays @ normal)
    at = origin + rays * z[..., None]
    waves = at @ np.array([[6.0, 1.0, 4.0], [1.0, 7.0, -4.0], [0.0, 0.0, 0.0]])
    return np.rint(127 + 100 * np.sin(waves)).astype(np.uint8), z.astype(np.float32)


def poses(times_s: np.ndarray) -> np.ndarray:
    return se3.exp(times_s[:, None] * TWIST)


def rows(middle_s: float) -> np.ndarray:
    return poses(middle_s + 1e-9 * line_times_ns(np.arange(CAMERA.height), CAMERA.height, READOUT_S))


def still(middle_s: float) -> tuple[np.ndarray, np.ndarray]:
    return shot(np.repeat(poses(np.array([middle_s])), CAMERA.height, axis=0))


def differences(
    color: np.ndarray, depth: np.ndarray, usable: np.ndarray, middle_s: float
) -> tuple[float, float]:
    """90th percentiles, gray values and meters."""
    true_color, true_depth = still(middle_s)
    off = np.abs(color.astype(float) - true_color)[usable]
    both = usable & (depth > 0)
    return float(np.percentile(off, 90)), float(np.percentile(np.abs(depth - true_depth)[both], 90))


@pytest.mark.parametrize("by_columns", [False, True])
def test_an_image_is_as_a_still_camera_takes_it(by_columns: bool) -> None:
    count = Readout(by_columns=by_columns).lines(CAMERA)
    lines = poses(1e-9 * line_times_ns(np.arange(count), count, READOUT_S))
    color, depth = shot(lines, by_columns)
    unrolling = Unrolling(SeenPoints(CAMERA, depth), lines, by_columns=by_columns)
    assert unrolling.is_needed
    usable = unrolling.usable(None)
    assert 0.9 < usable.mean() < 1
    before = differences(color, depth, usable, 0.0)
    after = differences(unrolling.color(color), unrolling.depth(DepthImage(depth)).depth_m, usable, 0.0)
    assert before[0] > 12
    assert before[1] > 0.006
    assert after[0] < 4
    assert after[1] < 0.004


def test_what_may_not_be_used_moves_along() -> None:
    _, depth = shot(rows(0.0))
    unrolling = Unrolling(SeenPoints(CAMERA, depth), rows(0.0))
    mask = np.ones(depth.shape, dtype=bool)
    mask[:, :40] = False
    found = unrolling.usable(mask)
    assert not np.array_equal(found, mask & unrolling.usable(None))
    sigma = np.full(depth.shape, 0.01, np.float32)
    moved = unrolling.depth(DepthImage(np.where(mask, depth, np.float32(0)), sigma))
    assert moved.sigma_m is not None
    assert np.array_equal(moved.sigma_m > 0, moved.depth_m > 0)
    assert not moved.depth_m[found ^ unrolling.usable(None)][:100].all()


def test_a_camera_that_stands_changes_nothing() -> None:
    depth = np.full((120, 160), 2.0, np.float32)
    assert not Unrolling(SeenPoints(CAMERA, depth), np.tile(np.eye(4), (120, 1, 1))).is_needed


@pytest.mark.parametrize("text", ["-0.01", "30", "fast", "nan"])
def test_a_readout_that_no_camera_has_is_refused(text: str) -> None:
    with pytest.raises(DuagError, match="rolling_shutter_s"):
        Readout.stated({"rolling_shutter_s": text}, "a.mcap")


def test_each_camera_states_its_own_readout() -> None:
    assert Readout.stated({"rolling_shutter_s": "0.02"}, "") == Readout(0.02, 0.0)
    assert Readout.stated({"depth_rolling_shutter_s": "0.03"}, "") == Readout(0.0, 0.03)
    assert Readout.stated({}, "") is None


def test_poses_between_those_that_are_computed_are_interpolated() -> None:
    for count in (1, 2, 119, 480):
        known = poses(1e-9 * line_times_ns(known_lines(count), count, READOUT_S))
        every = poses(1e-9 * line_times_ns(np.arange(count), count, READOUT_S))
        assert np.allclose(all_lines(known, count), every, atol=1e-5)


TIMES_S = np.arange(5) / 30
PATH = Trajectory(np.rint(1e9 * TIMES_S).astype(np.int64), poses(TIMES_S))


def recorded(folder: Path, stated: bool) -> Path:
    """A log of rolling images, which states their readout or not."""
    keys = ("rolling_shutter_s", "depth_rolling_shutter_s") if stated else ()
    sensors = dict.fromkeys(keys, str(READOUT_S))
    with (
        RecordingWriter(folder) as recording,
        recording.robot("alpha", CAMERA, SCALE_M, sensors, find_regions=False) as robot,
    ):
        for t in TIMES_S:
            color, depth = shot(rows(t))
            units = np.rint(depth / SCALE_M).astype(np.uint16)
            png = cv2.imencode(".png", color[:, :, ::-1])[1].tobytes()
            robot.add_frame(round(1e9 * t), png, "png", units)
    return folder / "alpha.mcap"


@pytest.mark.parametrize("stated", [True, False])
def test_frames_of_a_log_are_still_once_its_motion_is_known(tmp_path: Path, stated: bool) -> None:
    with open_rgbd(recorded(tmp_path / "rec", stated)) as log:
        read = log.frame(2)
        assert log.needs_motion == stated
        log.move_depth(PATH)
        found = log.frame(2)
        assert np.array_equal(log.usable_depth(2), found.usable_depth)
    if not stated:
        assert np.array_equal(found.color, read.color)
        assert np.array_equal(found.depth, read.depth)
        return
    assert found.mask is not None
    after = differences(found.color, found.depth, found.mask, TIMES_S[2])
    assert after[0] < 4
    assert after[1] < 0.004


def test_depth_is_read_once_to_know_how_far_rows_move(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[Record] = []
    taken = Registered.read

    def noted(source: Registered, record: Record) -> DepthImage:
        read.append(record)
        return taken(source, record)

    monkeypatch.setattr(Registered, "read", noted)
    with open_rgbd(recorded(tmp_path / "rec", stated=True)) as log:
        log.move_depth(PATH)
        far_px = log.moved_rows_px(2)
        log.readout = Readout(0.5 * READOUT_S, 0.5 * READOUT_S)
        near_px = log.moved_rows_px(2)
        assert len(read) == 1
        log.delay_depth(33_333_333)  # now the image has the depth of the next one
        log.moved_rows_px(2)
        assert len(read) == 2
    assert near_px == pytest.approx(0.5 * far_px, rel=0.05)
