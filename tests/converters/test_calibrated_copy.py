"""A recording whose cameras are corrected from its logs: what a camera without errors would have seen."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.calibrated_copy import Correction, why_not, write_calibrated
from duagc.converters.robot_writer import RobotWriter
from duagc.converters.writer import RecordingWriter
from duagc.pipeline import messages
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.geometry import depth_error, se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens
from duagc.pipeline.recording import LogWriter, Recording, RgbdFrame, content_digest, open_rgbd, read_log
from duagc.pipeline.recording.read import LogFile
from duagc.schemas import topics

CAMERA = PinholeCamera(160, 120, 140.0, 142.0, 79.0, 60.5)
SEEN_BY = PinholeCamera(160, 120, 146.0, 147.0, 81.5, 58.5)
TURN = (0.010, -0.014, 0.02)
CORRECTION = Correction(
    Lens(SEEN_BY, (0.08, -0.3, 0.0, 0.0, 0.3), rotation_rad=TURN),
    (0.012, -0.015, 0.006, -0.018, 0.005, 0.008),
    4_000_000,
)
FRAMES, STEP_NS = 6, 33_000_000
IMU_T_CAMERA = se3.from_rotation_translation(so3.exp(np.array([0.1, 0.2, 0.3])), np.array([0.1, 0.0, 0.0]))


def scene(rays: np.ndarray, frame: int) -> np.ndarray:
    """Color [h, w, 3] far away in directions [h, w, 3]."""
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    waves = np.stack([np.sin(9 * x + frame), np.cos(7 * y - frame), np.sin(6 * (x + y))], axis=-1)
    return np.rint(127.5 + 100 * waves).astype(np.uint8)


def true_depth(frame: int) -> np.ndarray:
    x, y = np.moveaxis(CAMERA.rays()[..., :2], -1, 0)
    return 2 + 0.5 * x - 0.7 * y + 0.1 * frame


def rays_of_the_lens() -> np.ndarray:
    """Directions [h, w, 3], in the frame of the recording's camera, of the pixels of the camera that took color."""
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    exact = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    points = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    lens = np.array(CORRECTION.lens.distortion)
    x = cv2.undistortPoints(points, SEEN_BY.matrix(), lens, None, None, None, exact).reshape(120, 160, 2)
    return np.concatenate([x, np.ones((120, 160, 1))], axis=-1) @ so3.exp(np.array(TURN))


def measured_depth(frame: int) -> np.ndarray:
    """What the depth camera with its error has, m."""
    rays = CAMERA.rays()
    at_infinity = depth_error.terms(np.zeros(rays.shape[:2]), rays[..., 0], rays[..., 1])
    inverse = 1 / true_depth(frame) - at_infinity @ np.array(CORRECTION.depth_error)
    return np.asarray((1 - depth_error.NO_ERROR_M * CORRECTION.depth_error[0]) / inverse)


def png(rgb: np.ndarray) -> bytes:
    return cv2.imencode(".png", rgb[..., ::-1])[1].tobytes()


def moving(frame: int) -> np.ndarray:
    """Where a thing that moves is not, bool, in the images of the camera that took color."""
    usable = np.ones((120, 160), dtype=bool)
    usable[40:60, 50 + 5 * frame : 70 + 5 * frame] = False
    return usable


def add_frames(robot: RobotWriter, valid: np.ndarray | None = None) -> None:
    rays = rays_of_the_lens()
    robot.set_valid(valid)
    robot.set_imu(IMU_T_CAMERA)
    for k in range(FRAMES):
        stamp = 1_000_000_000 + k * STEP_NS
        depth = measured_depth(k)
        robot.add_frame(
            stamp,
            png(scene(rays, k)),
            "png",
            np.rint(depth / 0.0005).astype(np.uint16),
            T_world_camera=se3.from_rotation_translation(np.eye(3), np.array([0.1 * k, 0, 0])),
            mask=moving(k),
            depth_sigma_m=0.01 * depth**2,
        )
        robot.add_imu(stamp + 1_000_000, np.array([0.1, 0.2, k]), np.array([0, 0, 9.8]))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("recorded") / "wrong"
    valid = np.ones((120, 160), dtype=bool)
    valid[110:] = False
    with RecordingWriter(folder, "wrong", {"dataset": "waves"}) as recording:
        with recording.robot("alpha", CAMERA, 0.0005) as alpha:
            add_frames(alpha, valid)
        with recording.robot("bravo", CAMERA, 0.0005) as bravo:
            add_frames(bravo)
    return Recording(folder)


@pytest.fixture(scope="module")
def corrected(recorded: Recording, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("corrected")
    write_calibrated(recorded, {"alpha": CORRECTION}, folder, "right", calibration={"why": "a test"})
    return Recording(folder)


def frames(recording: Recording, robot: str = "alpha") -> list[RgbdFrame]:
    with open_rgbd(recording.log(robot)) as log:
        return list(log.frames())


def test_images_are_those_of_a_camera_without_errors(corrected: Recording) -> None:
    """Color within interpolation, depth within half a unit; all frames, those held out among them."""
    found = frames(corrected)
    assert [f.index for f in found] == list(range(FRAMES))
    assert any(is_held_out(f.index) for f in found)
    for frame in found:
        assert frame.mask is not None
        exact = scene(CAMERA.rays(), frame.index)
        off = np.abs(frame.color.astype(float) - exact)[frame.mask]
        assert np.mean(off) < 0.7
        assert np.max(off) < 4
        known = frame.depth > 0
        np.testing.assert_allclose(frame.depth[known], true_depth(frame.index)[known], atol=0.0006)
        assert frame.depth_sigma is not None
        sigma = (1 - 2 * CORRECTION.depth_error[0]) * 0.01 * true_depth(frame.index) ** 2
        np.testing.assert_allclose(frame.depth_sigma[known], sigma[known], rtol=0.04)


def test_the_recorded_images_are_far_from_them(recorded: Recording) -> None:
    """So the test above sees the correction."""
    frame = frames(recorded)[0]
    assert np.abs(frame.color.astype(float) - scene(CAMERA.rays(), 0)).mean() > 7
    assert np.median(np.abs(frame.depth - true_depth(0))) > 0.008


def test_masks_move_with_the_color_and_the_rim_is_masked(corrected: Recording) -> None:
    with open_rgbd(corrected.log("alpha")) as log:
        valid = log.valid
        found = log.frame(2)
    u, v = CORRECTION.lens.maps(CAMERA)
    inside = (u >= 0) & (u <= 159) & (v >= 0) & (v <= 119)
    assert valid is not None
    assert not valid[~inside].any()
    assert not valid[110:].any()
    assert valid.mean() == pytest.approx(
        (inside & (v < 110) & (np.arange(120) < 110)[:, None]).mean(), abs=0.02
    )
    row, column = np.rint(v).astype(int).clip(0, 119), np.rint(u).astype(int).clip(0, 159)
    away = cv2.erode(moving(2).astype(np.uint8), np.ones((5, 5)))[row, column] > 0
    near = cv2.dilate(moving(2).astype(np.uint8), np.ones((5, 5)))[row, column] == 0
    assert found.mask is not None
    assert found.mask[valid & away].all()
    assert not found.mask[near].any()
    assert near.sum() > 200


def test_depth_gets_earlier_by_the_delay_and_color_keeps_its_stamps(
    recorded: Recording, corrected: Recording
) -> None:
    before, after = frames(recorded), frames(corrected)
    assert [f.stamp_ns for f in after] == [f.stamp_ns for f in before]
    assert {f.depth_offset_ns for f in after} == {-4_000_000}


def test_everything_else_is_copied(recorded: Recording, corrected: Recording) -> None:
    assert corrected.name == "right"
    for robot in ("alpha", "bravo"):
        truth, same = recorded.groundtruth(robot), corrected.groundtruth(robot)
        assert truth is not None
        assert same is not None
        assert same.read_bytes() == truth.read_bytes()
    assert corrected.log("bravo").read_bytes() == recorded.log("bravo").read_bytes()
    for row in (topics.IMU, topics.IMU_TRANSFORM, topics.COLOR):
        was, now = (list(read_log(r.log("alpha"), [row])) for r in (recorded, corrected))
        assert was
        assert [dataclasses.replace(r, path=Path()) for r in was] == [
            dataclasses.replace(r, path=Path()) for r in now
        ]
    description = corrected.description
    assert description["calibration"]["recording"] == "wrong"
    assert description["calibration"]["why"] == "a test"
    assert description["calibration"]["digests"]["alpha"] == recorded.digest("alpha.mcap")
    assert description["source"] == {"dataset": "waves"}
    row = description["robots"]["alpha"]
    assert row["digests"]["alpha.mcap"] == content_digest(corrected.log("alpha"))
    assert "alpha.groundtruth.mcap" in row["digests"]
    assert row["masked_share"] > recorded.description["robots"]["alpha"]["masked_share"]


def test_a_topic_that_no_table_has_is_copied(recorded: Recording, tmp_path: Path) -> None:
    log = tmp_path / "alpha.mcap"
    with LogFile(recorded.log("alpha")) as source, LogWriter(log, "alpha") as writer:
        for record in source.records(None):
            writer.copy(source, record)
            if record.topic == topics.IMU_TRANSFORM.of("alpha"):
                source.channels["/alpha/bumper"] = dataclasses.replace(
                    source.channels[record.topic], topic="/alpha/bumper", metadata={"side": "left"}
                )
                writer.copy(source, dataclasses.replace(record, topic="/alpha/bumper"))
    with LogFile(log) as copied:
        assert copied.channels["/alpha/bumper"].metadata == {"side": "left"}
        assert len(copied.entries("/alpha/bumper")) == 1
    shutil.copyfile(recorded.path / "recording.json", tmp_path / "recording.json")
    shutil.copyfile(recorded.log("bravo"), tmp_path / "bravo.mcap")
    out = tmp_path / "out"
    out.mkdir()
    write_calibrated(Recording(tmp_path), {"alpha": CORRECTION}, out, "right", calibration={})
    with LogFile(out / "alpha.mcap") as copied:
        assert len(copied.entries("/alpha/bumper")) == 1


def test_depth_of_another_camera_becomes_registered(tmp_path: Path) -> None:
    """As the reader registers it: the calibration is relative to that."""
    small = PinholeCamera(80, 60, 70.0, 70.0, 39.5, 29.5)
    with RecordingWriter(tmp_path / "raw") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        robot.set_depth_camera(small, se3.from_rotation_translation(np.eye(3), np.array([0.02, 0, 0])), 0.001)
        for k in range(3):
            robot.add_frame(k * STEP_NS, png(scene(rays_of_the_lens(), k)), "png", None)
            robot.add_depth(k * STEP_NS, np.full((60, 80), 1500 + 10 * k, np.uint16))
    (tmp_path / "out").mkdir()
    now = dataclasses.replace(CORRECTION, delay_ns=0)
    write_calibrated(Recording(tmp_path / "raw"), {"alpha": now}, tmp_path / "out", "out", calibration={})
    for was, found in zip(
        frames(Recording(tmp_path / "raw")), frames(Recording(tmp_path / "out")), strict=True
    ):
        known = found.depth > 0
        assert known.mean() > 0.5
        rays = CAMERA.rays()[known]
        terms = depth_error.terms(1 / was.depth[known].astype(float), rays[:, 0], rays[:, 1])
        expected = 1 / (1 / was.depth[known] + terms @ np.array(CORRECTION.depth_error))
        np.testing.assert_allclose(found.depth[known], expected, atol=0.0006)
    with LogFile(tmp_path / "out" / "alpha.mcap") as log:
        assert not {topics.RAW_DEPTH.of("alpha"), topics.RAW_DEPTH_TRANSFORM.of("alpha")} & set(log.channels)


def test_depth_of_a_lidar_is_refused(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "lidar") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        robot.set_lidar(np.eye(4), None)
        for k in range(3):
            robot.add_frame(k * STEP_NS, png(scene(CAMERA.rays(), k)), "png", None)
            robot.add_points(k * STEP_NS, np.array([[0.1, 0.0, 2.0]]))
    expected = "depth comes from /alpha/lidar/points, expected images of a depth camera"
    assert expected in why_not(tmp_path / "lidar" / "alpha.mcap")
    with pytest.raises(DuagError, match=expected):
        write_calibrated(
            Recording(tmp_path / "lidar"), {"alpha": CORRECTION}, tmp_path, "out", calibration={}
        )


def test_a_lens_that_sees_nothing_of_it_is_refused(recorded: Recording, tmp_path: Path) -> None:
    away = dataclasses.replace(
        CORRECTION, lens=dataclasses.replace(CORRECTION.lens, rotation_rad=(0, 1.2, 0))
    )
    with pytest.raises(DuagError, match=r"alpha.mcap: its calibration leaves no pixel that shows the scene"):
        write_calibrated(recorded, {"alpha": away}, tmp_path, "away", calibration={})
    assert not list(tmp_path.iterdir())


def test_stamps_do_not_fall_below_zero(tmp_path: Path) -> None:
    log = tmp_path / "alpha.mcap"
    raw = np.full((120, 160), 2000, np.uint16)
    with RecordingWriter(tmp_path / "zero") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        for k in range(2):
            robot.add_frame(k * STEP_NS, png(scene(CAMERA.rays(), k)), "png", raw)
    write_calibrated(
        Recording(tmp_path / "zero"), {"alpha": CORRECTION}, tmp_path, "out", calibration={"why": ""}
    )
    depth = [r.publish_time_ns for r in read_log(log, [topics.DEPTH])]
    assert depth == [0, STEP_NS - 4_000_000]
    stamped = [messages.unpack_depth(r.proto(), "") for r in read_log(log, [topics.DEPTH])]
    assert len(stamped) == 2
    assert json.loads((tmp_path / "recording.json").read_text())["name"] == "out"


def test_images_of_a_lens_are_resampled_where_another_correction_applies(
    corrected: Recording, tmp_path: Path
) -> None:
    """A log states one lens; the second correction is of the images as the first one has them read."""
    turned = Lens(CAMERA, (), rotation_rad=(0.0, 0.0, 0.02))
    again = Correction(turned, (0.0,) * 6)
    write_calibrated(corrected, {"alpha": again}, tmp_path, "twice", calibration={})
    u, v = turned.maps(CAMERA)
    with open_rgbd(corrected.log("alpha")) as once, open_rgbd(Recording(tmp_path).log("alpha")) as twice:
        assert once.lens is not None
        assert twice.lens is None
        assert twice.camera == once.camera
        before, after = once.frame(1), twice.frame(1)
        assert after.mask is not None
        expected = cv2.remap(before.color, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        off = np.abs(after.color.astype(int) - expected)[after.mask]
    assert np.mean(off) < 0.1
    assert np.abs(after.color.astype(int) - before.color)[after.mask].mean() > 2
