"""S3E: sequences made in the dataset's own files, with its traps, come back as they were rendered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from duagc.converters import registry
from duagc.converters.layouts.s3e_layout import read_fixes
from duagc.converters.layouts.stereo import RawCamera, StereoOptions, StereoRig
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import so3
from duagc.pipeline.messages import unpack_pose_in_frame
from duagc.pipeline.recording import Recording, open_rgbd, read_log
from tests.fixtures.s3e import (
    D_LEFT,
    D_RIGHT,
    FRAMES,
    LEFT,
    NAMES,
    RATE,
    RIGHTS,
    START_NS,
    STEP_NS,
    T_right_left_of,
    pose_at,
    position,
    write_bag,
    write_calibration,
    write_truth,
)
from tests.fixtures.stereo_room import path, render


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("S3Ev1")
    sequence = root / "S3E_Playground_2"
    write_bag(sequence, NAMES)
    for name in NAMES:
        write_calibration(root / "Calibration" / f"{name.lower()}.yaml", name.lower())
        write_truth(sequence / f"{name.lower()}_gt.txt", name)
    return sequence


def rig_of(name: str, shrink: int) -> StereoRig:
    cameras = [
        RawCamera(c.matrix(), (*D, 0.0), c.width, c.height)
        for c, D in ((LEFT, D_LEFT), (RIGHTS[name], D_RIGHT))
    ]
    return StereoRig.of(
        cameras[0], cameras[1], T_right_left_of(name), name, options=StereoOptions(shrink=shrink)
    )


def checks_of(recording: Path) -> list[str]:
    """What `duagc check` finds wrong."""
    from duagc.pipeline.checks import check

    return [f.found for f in check.check(recording).findings if f.severity is check.Severity.ERROR]


def truth_depth(rig: StereoRig, k: int, frame: int) -> np.ndarray:
    T = pose_at(path(3, step=0.3)[k], START_NS + frame * STEP_NS)
    T[:3, :3] = T[:3, :3] @ rig.R_rectified_left.T
    return render(rig.camera, T)[1]


def test_stereo_of_three_vehicles(dataset: Path, tmp_path: Path) -> None:
    registry.convert("s3e", dataset, tmp_path / "rec", options=["shrink=1"])
    recording = Recording(tmp_path / "rec")
    assert recording.robots == ["alpha", "bravo", "charlie"]
    checks, parameters = recording.description["checks"], recording.description["parameters"]
    for k, (robot, name) in enumerate(zip(recording.robots, NAMES, strict=True)):
        assert recording.description["robots"][robot]["sensors"]["part"] == name
        assert checks[robot]["row_difference_px"] < 0.3
        assert checks[robot]["stereo_over_lidar"] == pytest.approx(1, abs=0.02)
        rig = rig_of(name.lower(), 1)
        units, errors = [], []
        with open_rgbd(recording.log(robot)) as log:
            np.testing.assert_allclose(log.camera.matrix(), rig.camera.matrix(), rtol=1e-12)
            assert [frame.stamp_ns for frame in log.frames()] == [
                START_NS + i * STEP_NS for i in range(FRAMES)
            ]
            for i, frame in enumerate(log.frames()):
                truth, known = truth_depth(rig, k, i), frame.depth > 0
                assert known.mean() > 0.7
                assert frame.depth_sigma is not None
                errors.append((np.abs(frame.depth - truth) / truth)[known])
                units.append((frame.depth - truth)[known] / frame.depth_sigma[known])
            prior = log.motion_prior()
        assert np.median(np.concatenate(errors)) < 0.012  # JPEG, 0.2 px at 6 m
        assert 0.5 < 1.4826 * np.median(np.abs(np.concatenate(units))) < 1.5
        assert prior is not None
        motion = prior.between(START_NS, START_NS + STEP_NS)
        assert motion is not None
        R = rig.R_rectified_left
        np.testing.assert_allclose(so3.log(motion.T_start_stop[:3, :3]), R @ RATE * 0.1, atol=1e-5)
        truth_log = recording.groundtruth(robot)
        assert truth_log is not None
        (record,) = list(read_log(truth_log))  # one fix has an image next to it
        stamp = record.publish_time_ns
        assert stamp in (START_NS, START_NS + STEP_NS)  # 40 ms before, 60 ms after
        found = unpack_pose_in_frame(record.message())[:3, 3] + parameters["origin_m"]
        np.testing.assert_allclose(found, position(name, stamp), atol=1e-6)
    assert any("no rotations" in text for text in recording.description["warnings"])
    assert not checks_of(tmp_path / "rec")


def test_lidar_is_unturned_by_the_gyroscope(dataset: Path, tmp_path: Path) -> None:
    registry.convert("s3e", dataset, tmp_path / "rec", options=["depth=lidar", "shrink=1"])
    recording = Recording(tmp_path / "rec")
    for k, (robot, name) in enumerate(zip(recording.robots, NAMES, strict=True)):
        rig, errors = rig_of(name.lower(), 1), []
        with open_rgbd(recording.log(robot)) as log:
            assert len(log) == FRAMES
            for i, frame in enumerate(log.frames()):
                truth, known = truth_depth(rig, k, i), frame.depth > 0
                assert known.mean() > 0.3
                assert frame.depth_sigma is not None
                errors.append((np.abs(frame.depth - truth) / truth)[known])
        # 0.25 rad/s over 0.1 s are 7 px: without the gyroscope 0.5 % (median)
        assert np.median(np.concatenate(errors)) < 0.002
        assert np.mean(np.concatenate(errors) > 0.1) < 0.03
    assert not checks_of(tmp_path / "rec")


def test_bags_without_cameras_are_refused(dataset: Path, tmp_path: Path) -> None:
    write_bag(tmp_path / "S3E_Tunnel_1", ("Alpha",), cameras=False)
    with pytest.raises(
        DuagError, match=r"no camera in this bag \(found /Alpha/imu/data, /Alpha/velodyne_points\); S3E v2"
    ):
        registry.convert("s3e", tmp_path / "S3E_Tunnel_1", tmp_path / "rec")
    assert not (tmp_path / "rec").exists()
    with pytest.raises(DuagError, match="no such folder"):
        registry.convert("s3e", tmp_path / "nothing", tmp_path / "rec")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DuagError, match=r"\.db3 files: none"):
        registry.convert("s3e", tmp_path / "empty", tmp_path / "rec")
    with pytest.raises(DuagError, match="found 3 robots, expected --robots 2"):
        registry.convert("s3e", dataset, tmp_path / "rec", robots=2)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("transposed", "matched features lie .* px apart in rows"),
        ("meters", "last column of RIGHT.P is"),
        pytest.param("other", "matched features lie .* px apart in rows", marks=pytest.mark.slow),
        ("cut", "bob.yaml: "),
        ("missing", "bob.yaml: No such file"),
        ("text", "bob.yaml: "),
    ],
)
def test_wrong_calibrations_are_refused(dataset: Path, tmp_path: Path, fault: str, message: str) -> None:
    for name in NAMES:
        write_calibration(tmp_path / f"{name.lower()}.yaml", name.lower())
    file = tmp_path / "bob.yaml"
    if fault == "other":  # Alpha's for Bob
        file.write_text((tmp_path / "alpha.yaml").read_text())
    elif fault == "cut":
        file.write_text(file.read_text()[:900])
    elif fault == "missing":
        file.unlink()
    elif fault == "text":
        file.write_text("calibration: soon\n")
    else:
        write_calibration(file, "bob", **{fault: True})
    with pytest.raises(DuagError, match=message):
        registry.convert("s3e", dataset, tmp_path / "rec", options=[f"calibration={tmp_path}", "shrink=1"])
    assert not (tmp_path / "rec").exists()


def test_files_of_positions(tmp_path: Path) -> None:
    file = tmp_path / "alpha_gt.txt"
    assert read_fixes(file) is None
    file.write_text("0 1.0 2.0 3.0 0 0 0 1\n1 4.0 5.0 6.0 0 0 0 1\n")  # Laboratory: start and end
    assert read_fixes(file) is None
    file.write_text("1661000000.5 744073.32-0.041-0.296 0 0 0 1\n1661000001.500000001 1 2 3 0 0 0 1\n")
    fixes = read_fixes(file)
    assert fixes is not None
    assert fixes.stamps_ns == [1661000000_500000000, 1661000001_500000001]
    np.testing.assert_array_equal(fixes.positions[0], [744073.32, -0.041, -0.296])
    for broken in ("1e99 2 3 4 5 6 7 8\n", "1 1e999 3 4 5 6 7 8\n"):
        file.write_text(broken)
        with pytest.raises(DuagError, match=r"alpha_gt.txt:1: .* expected (a time in seconds|meters)"):
            read_fixes(file)
    for broken in ("1 2 3\n", "1661000000.5 a b c 0 0 0 1\n", "1 2 3 4 5 6 7 8 9\n"):
        file.write_text(broken)
        with pytest.raises(DuagError, match=r"alpha_gt.txt:1: .* expected eight numbers"):
            read_fixes(file)
