"""S3E: sequences made in the dataset's own files, with its traps, come back as they were rendered."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from duagc.converters import registry
from duagc.converters.datasets.s3e import read_fixes
from duagc.converters.layouts.stereo import RawCamera, StereoOptions, StereoRig
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.messages import unpack_pose_in_frame
from duagc.pipeline.recording import Recording, open_rgbd, read_log
from tests.converters.stereo_room import path, render, right_of, sweep

# Bob's calibration at a quarter of the size, and two like it
LEFT = PinholeCamera(306, 256, 294.09, 294.02, 155.4, 127.0)
RIGHTS = {
    "alpha": PinholeCamera(306, 256, 293.1, 293.3, 154.4, 129.1),
    "bob": PinholeCamera(306, 256, 292.72, 292.68, 150.6, 126.4),
    "carol": PinholeCamera(306, 256, 293.9, 293.96, 155.8, 127.4),
}
BASELINES_MM = {
    "alpha": (-361.175, -5.268, -1.593),
    "bob": (-364.796, 1.395, -12.692),
    "carol": (-361.022, -1.040, 4.668),
}
TURNS = {"alpha": (0.01, 0.012, -0.004), "bob": (0.014, -0.02, 0.008), "carol": (-0.012, 0.01, 0.006)}
D_LEFT, D_RIGHT = (-0.098, 0.11, 0.0004, -0.0006), (-0.101, 0.12, -0.0007, 0.0003)
T_LIDAR_LEFT = se3.from_rotation_translation(
    np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ so3.exp([0.01, -0.016, 0.011]), [0.12, 0.17, -0.21]
)
T_IMU_LEFT = se3.from_rotation_translation(
    np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ so3.exp([0.0, 0.02, 0.0]), [0.05, 0.1, -0.1]
)
FRAMES, STEP_NS, START_NS = 3, 100_000_000, 1_661_000_000_200_000_000
RATE = np.array([0.02, 0.25, -0.03])  # rad/s, of the left camera, about itself
UTM = np.array([744073.32, 2553112.02, 0.19])
STORE = get_typestore(Stores.ROS2_HUMBLE)


def make(type_name: str, /, **values: Any) -> Any:
    return STORE.types[type_name](**values)


def header(stamp_ns: int) -> Any:
    time = make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return make("std_msgs/msg/Header", stamp=time, frame_id="some_frame")


def jpeg(image: np.ndarray) -> Any:
    data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 97])[1]
    return data.ravel()


def vector(values: Any) -> Any:
    x, y, z = (float(v) for v in values)
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def cloud(stamp_ns: int, points: np.ndarray, seconds: np.ndarray) -> Any:
    kind = np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "ring", "time"],
            "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
            "offsets": [0, 4, 8, 12, 16, 18],
            "itemsize": 22,
        }
    )
    rows = np.zeros(len(points), kind)
    rows["x"], rows["y"], rows["z"] = points.T
    rows["time"] = seconds
    types = {"<f4": 7, "<u2": 4}
    fields = [
        make(
            "sensor_msgs/msg/PointField",
            name=n,
            offset=kind.fields[n][1],
            datatype=types[kind[n].str],
            count=1,
        )
        for n in kind.names
    ]
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=header(stamp_ns),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=22,
        row_step=22 * len(rows),
        data=np.frombuffer(rows.tobytes(), np.uint8),
        is_dense=True,
    )


def pose_at(start: np.ndarray, stamp_ns: int) -> np.ndarray:
    """T_world_left: the camera turns about itself."""
    return start @ se3.exp(np.concatenate([np.zeros(3), RATE * (stamp_ns - START_NS) * 1e-9]))


def turning_sweep(start: np.ndarray, stamp_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the front half of a turn that ends at the stamp, and their times before it, s."""
    points, seconds = [], []
    for k in range(20):
        time_s = -0.1 + 0.005 * k + 0.0025
        T = pose_at(start, stamp_ns + round(time_s * 1e9)) @ se3.inverse(T_LIDAR_LEFT)
        part = sweep(T, part=(80.0 - 8 * k, 72.0 - 8 * k))
        points.append(part)
        seconds.append(np.full(len(part), time_s))
    return np.concatenate(points), np.concatenate(seconds)


def vehicle_messages(name: str, start: np.ndarray, cameras: bool) -> list[tuple[int, str, str, Any]]:
    """Time of recording, topic, type, message."""
    T_right_left = T_right_left_of(name.lower())
    out = []
    for k in range(FRAMES if cameras else 0):
        for side, late, camera, D in (
            ("left", 0, LEFT, D_LEFT),
            ("right", 2_000_000, RIGHTS[name.lower()], D_RIGHT),
        ):
            stamp = START_NS + k * STEP_NS
            T = pose_at(start, stamp)
            T = right_of(T, T_right_left) if side == "right" else T
            image, _ = render(camera, T, D)
            message = make(
                "sensor_msgs/msg/CompressedImage",
                header=header(stamp + late),
                format="jpeg",
                data=jpeg(image),
            )
            out.append(
                (stamp + late + 9_000_000, f"/{name}/{side}_camera/compressed", "CompressedImage", message)
            )
    for k in range(FRAMES):
        stamp = START_NS + k * STEP_NS + 7_000_000
        out.append(
            (
                stamp + 20_000_000,
                f"/{name}/velodyne_points",
                "PointCloud2",
                cloud(stamp, *turning_sweep(start, stamp)),
            )
        )
    for k in range(40):
        stamp = START_NS - 120_000_000 + k * 10_000_000
        none = np.zeros(9)
        message = make(
            "sensor_msgs/msg/Imu",
            header=header(stamp),
            orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=none,
            angular_velocity=vector(T_IMU_LEFT[:3, :3] @ RATE),
            angular_velocity_covariance=none,
            linear_acceleration=vector([0, 0, 9.8]),
            linear_acceleration_covariance=none,
        )
        out.append((stamp + 1_000_000, f"/{name}/imu/data", "Imu", message))
    return out


def T_right_left_of(name: str) -> np.ndarray:  # noqa: N802 (a transform)
    return se3.from_rotation_translation(so3.exp(TURNS[name]), np.array(BASELINES_MM[name]) / 1000)


def write_bag(folder: Path, names: tuple[str, ...], cameras: bool = True) -> None:
    """A sqlite bag as the first rosbag2 wrote it: two tables, no types."""
    folder.mkdir(parents=True)
    messages = []
    for k, name in enumerate(names):
        messages += vehicle_messages(name, path(3, step=0.3)[k], cameras)
    messages.sort(key=lambda m: m[0])
    file = sqlite3.connect(folder / f"{folder.name}.db3")
    file.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
        "serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
    )
    file.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, "
        "data BLOB NOT NULL)"
    )
    numbers: dict[str, int] = {}
    for stamp, topic, kind, message in messages:
        full = f"sensor_msgs/msg/{kind}"
        if topic not in numbers:
            numbers[topic] = len(numbers) + 1
            file.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (numbers[topic], topic, full))
        data = bytes(STORE.serialize_cdr(message, full))
        file.execute(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", (numbers[topic], stamp, data)
        )
    file.commit()
    file.close()


def matrix(name: str, values: np.ndarray) -> str:
    rows, columns = np.atleast_2d(values).shape
    data = ", ".join(repr(float(v)) for v in np.ravel(values))
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [{data}]\n"


def write_calibration(file: Path, name: str, transposed: bool = False, meters: bool = False) -> None:
    T, right = T_right_left_of(name), RIGHTS[name]
    R = T[:3, :3].T if transposed else T[:3, :3]
    t = np.array(BASELINES_MM[name]) / (1000 if meters else 1)
    eye = np.c_[LEFT.matrix(), np.zeros(3)]
    text = f"%YAML:1.0\n---\nCamera.fx: {LEFT.fx}\nCamera.width: {LEFT.width}\nCamera.bf: {LEFT.fx * 0.36}\n"
    text += matrix("Tic", T_IMU_LEFT) + f"LEFT.height: {LEFT.height}\nLEFT.width: {LEFT.width}\n"
    text += matrix("LEFT.D", np.array([[*D_LEFT, 0.0]])) + matrix("LEFT.K", LEFT.matrix())
    text += (
        matrix("LEFT.R", np.eye(3))
        + matrix("LEFT.P", eye)
        + f"RIGHT.height: {right.height}\nRIGHT.width: {right.width}\n"
    )
    text += matrix("RIGHT.D", np.array([[*D_RIGHT, 0.0]])) + matrix("RIGHT.K", right.matrix())
    text += matrix("RIGHT.R", R) + matrix("RIGHT.P", np.c_[right.matrix(), t]) + matrix("Tlc", T_LIDAR_LEFT)
    file.parent.mkdir(exist_ok=True)
    file.write_text(text)


def position(name: str, stamp_ns: int) -> np.ndarray:
    return UTM + np.array([ord(name[0].lower()) - 97.0, 0.8 * (stamp_ns - START_NS) * 1e-9, 0.01])


def write_truth(file: Path, name: str) -> None:
    """One fix a second, between the images; the last after a gap."""
    lines = []
    for shift in (-960, 40, 1040, 17040):
        stamp = START_NS + shift * 1_000_000
        x, y, z = position(name, stamp)
        lines.append(f"{stamp // 10**9}.{stamp % 10**9:09d} {x:.6f} {y:.6f} {z:.6f} 0 0 0 1\n")
    file.write_text("".join(lines))


NAMES = ("Alpha", "Bob", "Carol")


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
    return StereoRig.of(cameras[0], cameras[1], T_right_left_of(name), name, StereoOptions(shrink=shrink))


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
        assert not checks_of(tmp_path / "rec")
        # 0.25 rad/s over 0.1 s are 7 px: without the gyroscope 0.5 % (median)
        assert np.median(np.concatenate(errors)) < 0.002
        assert np.mean(np.concatenate(errors) > 0.1) < 0.03


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
        ("other", "matched features lie .* px apart in rows"),
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
