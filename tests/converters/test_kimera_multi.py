"""Kimera-Multi-Data: bags with the dataset's topics and types, its ground truth in CSV, and each of them broken."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from duagc.converters import registry
from duagc.converters.datasets import kimera_multi
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.checks.check import check
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import open_rgbd, read_log
from duagc.pipeline.recording.motion import GyroPrior, motion_prior
from duagc.pipeline.recording.read import LogFile
from tests.converters.box_room import look, render
from tests.converters.ros_bags import Ros, odometry

COLOR = PinholeCamera(160, 120, 95.0, 95.2, 80.4, 59.1)
INFRA = PinholeCamera(160, 120, 94.3073, 94.37165, 81.588, 59.915)  # the dataset's, at a quarter of its size
DISTORTION = (-0.055, 0.066, -0.0004, 0.0007, -0.021)  # of a D455's color camera
START_NS = 1_665_777_600_123_456_789
STEP_NS = 400_000_000
FRAMES = 3
CONTAINERS = {"acl_jackal": "bz2", "sparkal2": "lz4", "thoth": "plain"}
RATE = np.array([0.02, -0.05, 0.3])  # rad/s, about the axes of the body


def body_at(seconds: float, start: float) -> np.ndarray:
    """A body (x forward, y left, z up) that drives along a line and turns evenly: exact between any two poses."""
    T_start = look([-1.5, start, 0.1], [4.0, 1.0, -0.2])
    R = T_start[:3, :3] @ se3.inverse(kimera_multi.T_BODY_INFRA1)[:3, :3] @ so3.exp(RATE * seconds)
    return se3.from_rotation_translation(R, T_start[:3, 3] + seconds * np.array([0.8, 0.1, 0.02]))


def vector(r: Ros, values: Any) -> Any:
    return r.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, values), strict=True)))


def imu(r: Ros, stamp_ns: int, frame: str, rates: np.ndarray) -> Any:
    return r.make(
        "sensor_msgs/msg/Imu",
        header=r.header(stamp_ns, frame),
        orientation=r.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.array([-1.0] + [0.0] * 8),
        angular_velocity=vector(r, rates),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(r, [0.0, -9.81, 0.0]),
        linear_acceleration_covariance=np.zeros(9),
    )


def cloud(r: Ros, stamp_ns: int, frame: str) -> Any:
    kinds = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 16, 7), ("ring", 20, 4), ("time", 24, 7))
    fields = [
        r.make("sensor_msgs/msg/PointField", name=n, offset=o, datatype=k, count=1) for n, o, k in kinds
    ]
    return r.make(
        "sensor_msgs/msg/PointCloud2",
        header=r.header(stamp_ns, frame),
        height=1,
        width=4,
        fields=fields,
        is_bigendian=False,
        point_step=32,
        row_step=128,
        data=np.zeros(128, np.uint8),
        is_dense=True,
    )


def bag_rows(r: Ros, robot: str, start: float, frame_prefix: str) -> list[tuple[str, int, Any]]:
    """Messages of a robot by time of recording, which is 5 ms after that of the header."""
    T_infra1_color, _ = kimera_multi.extrinsics(robot)
    frames = {k: f"{frame_prefix}/forward_{k}_optical_frame" for k in ("color", "depth", "imu", "infra1")}
    rows = []

    def add(topic: str, stamp_ns: int, message: Any) -> None:
        rows.append((f"/{robot}/{topic}", stamp_ns + 5_000_000, message))

    for i in range(FRAMES):
        at = START_NS + i * STEP_NS
        T_infra1 = body_at(i * STEP_NS * 1e-9, start) @ kimera_multi.T_BODY_INFRA1
        color, _ = render(COLOR, T_infra1 @ T_infra1_color, DISTORTION)
        gray, z = render(INFRA, T_infra1)
        jpeg = cv2.imencode(".jpg", color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
        left = cv2.imencode(".jpg", gray[..., 0])[1].tobytes()
        depth = np.rint(z * 1000).astype(np.uint16)
        add("forward/color/camera_info", at, r.info(at, frames["color"], COLOR, DISTORTION))
        add(
            "forward/color/image_raw/compressed",
            at,
            r.compressed(at, frames["color"], jpeg, "rgb8; jpeg compressed bgr8"),
        )
        add("forward/depth/camera_info", at, r.info(at, frames["depth"], INFRA))
        add(
            "forward/depth/image_rect_raw",
            at + 2_000_000,
            r.image(at + 2_000_000, frames["depth"], depth, "16UC1"),
        )
        for side in ("infra1", "infra2"):
            name = f"forward/{side}"
            add(f"{name}/camera_info", at, r.info(at, frames["infra1"], INFRA))
            add(
                f"{name}/image_rect_raw/compressed",
                at,
                r.compressed(at, frames["infra1"], left, "mono8; jpeg compressed "),
            )
    R_infra1_body = kimera_multi.T_BODY_INFRA1[:3, :3].T
    for k in range(-4, 200):
        at = START_NS + k * 5_000_000
        add("forward/imu", at, imu(r, at, frames["imu"], R_infra1_body @ RATE))
    for k in range(5):
        at = START_NS + k * 20_000_000
        add("jackal_velocity_controller/odom", at, odometry(r, at, f"{frame_prefix}/base_link", np.eye(4)))
    add("lidar_points", START_NS, cloud(r, START_NS, f"{frame_prefix}/velodyne"))
    return sorted(rows, key=lambda row: row[1])


def write_truth(path: Path, start: float) -> None:
    """Five rows, irregular, as the dataset has them: nanoseconds, w first."""
    lines = ["#timestamp_kf,x,y,z,qw,qx,qy,qz"]
    for seconds in (-0.7, -0.25, 0.3, 0.9, 2.1):
        T = body_at(seconds, start)
        values = [*T[:3, 3], *so3.to_quat_wxyz(T[:3, :3])]
        lines.append(",".join([str(START_NS + round(seconds * 1e9)), *(f"{v:.9f}" for v in values)]))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a sequence with three robots, one of whose frames carry another's name, and its ground truth."""
    root = tmp_path_factory.mktemp("kimera")
    folder = root / "campus_outdoor_1014_compressed"
    folder.mkdir()
    r = Ros(1)
    for k, (robot, container) in enumerate(CONTAINERS.items()):
        prefix = "acl_jackal2" if robot == "acl_jackal" else robot
        r.write(folder / f"10_14_{robot}", bag_rows(r, robot, 0.3 * k, prefix), container)
        write_truth(root / "ground_truth" / "1014" / f"{robot}_gt_odom.csv", 0.3 * k)
    return folder


@pytest.fixture(scope="module")
def recording(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "rec"
    registry.convert("kimera-multi", dataset, out)
    return out


@pytest.mark.parametrize("robot", CONTAINERS)
def test_frames_and_poses_are_those_of_the_fixture(recording: Path, robot: str) -> None:
    start = 0.3 * list(CONTAINERS).index(robot)
    T_infra1_color, _ = kimera_multi.extrinsics(robot)
    truth = read_log(recording / f"{robot}.groundtruth.mcap", [f"/{robot}/groundtruth/pose"])
    poses = [m.unpack_pose_in_frame(record.proto()) for record in truth]
    assert len(poses) == FRAMES
    with open_rgbd(recording / f"{robot}.mcap") as log:
        assert len(log) == FRAMES
        for i in range(FRAMES):
            T = body_at(i * STEP_NS * 1e-9, start) @ kimera_multi.T_BODY_INFRA1 @ T_infra1_color
            assert np.allclose(poses[i], T, atol=1e-7)  # nine digits in the file
            frame = log.frame(i)
            assert frame.stamp_ns == START_NS + i * STEP_NS
            color, z = render(COLOR, T)
            seen = frame.depth > 0
            assert seen.mean() > 0.8
            error = np.abs(frame.depth - z)[seen] / z[seen]
            assert np.median(error) < 0.002
            assert np.percentile(error, 95) < 0.01
            inner = np.s_[20:-20, 20:-20]
            error_of_color = np.abs(frame.color[inner].astype(int) - color[inner])
            assert np.median(error_of_color) <= 6  # JPEG halves the colors, and the grid is some pixels wide


def test_depth_that_is_taken_as_registered_does_not_fit() -> None:
    """What scripts do that rename the topic to aligned_depth_to_color: off by more than a percent."""
    T_infra1_color, _ = kimera_multi.extrinsics("acl_jackal")
    T_infra1 = body_at(0.0, 0.0) @ kimera_multi.T_BODY_INFRA1
    _, depth = render(INFRA, T_infra1)
    _, true = render(COLOR, T_infra1 @ T_infra1_color)
    assert np.percentile(np.abs(depth - true) / true, 95) > 0.01


def test_the_imu_turns_as_the_camera_does(recording: Path) -> None:
    with LogFile(recording / "sparkal2.mcap") as log:
        prior = motion_prior(log, "sparkal2")
    assert isinstance(prior, GyroPrior)
    motion = prior.between(START_NS, START_NS + 2 * STEP_NS)
    assert motion is not None
    T_infra1_color, _ = kimera_multi.extrinsics("sparkal2")
    poses = [body_at(s, 0.3) @ kimera_multi.T_BODY_INFRA1 @ T_infra1_color for s in (0.0, 2 * STEP_NS * 1e-9)]
    true = poses[0][:3, :3].T @ poses[1][:3, :3]
    assert np.linalg.norm(so3.log(true)) > 0.02
    assert np.linalg.norm(so3.log(true.T @ motion.T_start_stop[:3, :3])) < 1e-6


def test_what_is_known_and_what_is_not_is_told(recording: Path) -> None:
    description = json.loads((recording / "recording.json").read_text())
    warnings = "\n".join(description["warnings"])
    assert "thoth: extrinsics of depth and color are published, and the same as those of hathor" in warnings
    assert "acl_jackal: extrinsics" not in warnings
    assert "acl_jackal: true poses are of the body" in warnings
    assert description["checks"]["acl_jackal"]["reprojection_median_m"] < 0.02
    assert sorted(description["robots"]) == ["acl_jackal", "sparkal2", "thoth"]
    report = check(recording)
    assert report.sound, report.findings


def test_robots_and_ground_truth_can_be_chosen(dataset: Path, tmp_path: Path) -> None:
    bag = dataset / "10_14_thoth.bag"
    registry.convert("kimera-multi", bag, tmp_path / "one")
    assert (tmp_path / "one" / "thoth.groundtruth.mcap").is_file()
    options = ["robots_used=thoth", "ground_truth=none", "imu=false"]
    registry.convert("kimera-multi", dataset, tmp_path / "two", options=options)
    description = json.loads((tmp_path / "two" / "recording.json").read_text())
    assert list(description["robots"]) == ["thoth"]
    assert not (tmp_path / "two" / "thoth.groundtruth.mcap").exists()
    for wrong, message in (
        (["robots_used=acl_jakal"], "robot acl_jakal not found, expected perhaps acl_jackal"),
        ([f"ground_truth={tmp_path}"], "acl_jackal_gt_odom.csv: no such file"),
    ):
        with pytest.raises(DuagError, match=message):
            registry.convert("kimera-multi", dataset, tmp_path / "rec", options=wrong)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("#timestamp_kf,x,y,z,qx,qy,qz,qw\n", "columns .*, expected #timestamp_kf,x,y,z,qw,qx,qy,qz"),
        ("#timestamp_kf,x,y,z,qw,qx,qy,qz\n", "found no pose"),
        (
            "#timestamp_kf,x,y,z,qw,qx,qy,qz\n1,0,0,0,1,0,0\n",
            ":2: 1,0,0,0,1,0,0, expected integer nanoseconds",
        ),
        ("#timestamp_kf,x,y,z,qw,qx,qy,qz\n1.5,0,0,0,1,0,0,0\n", ":2: "),
        (f"#timestamp_kf,x,y,z,qw,qx,qy,qz\n{10**30},0,0,0,1,0,0,0\n", ":2: "),
        ("#timestamp_kf,x,y,z,qw,qx,qy,qz\n1,0,0,0,3,0,0,0\n", ":2: "),
    ],
)
def test_broken_ground_truth_is_an_error(dataset: Path, tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "gt").mkdir()
    (tmp_path / "gt" / "thoth_gt_odom.csv").write_text(text)
    options = ["robots_used=thoth", f"ground_truth={tmp_path / 'gt'}"]
    with pytest.raises(DuagError, match=message):
        registry.convert("kimera-multi", dataset, tmp_path / "rec", options=options)
    assert not (tmp_path / "rec").exists()


def test_poses_that_do_not_belong_are_refused(dataset: Path, tmp_path: Path) -> None:
    """Quaternions read with w last would turn the robot over: the depth does not fit the poses."""
    source = (dataset.parent / "ground_truth" / "1014" / "thoth_gt_odom.csv").read_text().splitlines()
    rows = [line.split(",") for line in source]
    (tmp_path / "gt").mkdir()
    swapped = [",".join([*row[:4], row[7], *row[4:7]]) for row in rows[1:]]
    (tmp_path / "gt" / "thoth_gt_odom.csv").write_text("\n".join([source[0], *swapped]) + "\n")
    options = ["robots_used=thoth", f"ground_truth={tmp_path / 'gt'}"]
    with pytest.raises(DuagError, match="poses, intrinsics and depth do not belong together"):
        registry.convert("kimera-multi", dataset, tmp_path / "rec", options=options)


def test_other_bags_are_refused(tmp_path: Path) -> None:
    r = Ros(1)
    bag = r.write(tmp_path / "10_14_thoth", bag_rows(r, "thoth", 0.0, "thoth")[:1], "plain")
    with pytest.raises(DuagError, match=r"no topic /<robot>/forward/color/image_raw/compressed"):
        registry.convert("kimera-multi", bag, tmp_path / "rec")
