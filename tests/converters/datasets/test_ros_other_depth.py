"""Logs of ROS without depth images: depth of a stereo pair, however its calibration is stated, and of a LiDAR."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from duagc.converters import registry
from duagc.converters.layouts.derived_depth import LidarSource
from duagc.converters.layouts.ros_camera import RosCamera
from duagc.converters.layouts.ros_points import VELODYNE
from duagc.converters.layouts.stereo import RawCamera, StereoOptions, StereoRig
from duagc.converters.logs.derived import Sweeps, stereo_of
from duagc.converters.logs.options import LogOptions
from duagc.pipeline import messages
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import Recording, open_rgbd, read_log
from tests.fixtures.lidar_logs import FRAMES, START, lidar_log
from tests.fixtures.ros_bags import Ros, odometry, still
from tests.fixtures.s3e import (
    D_LEFT,
    D_RIGHT,
    LEFT,
    RIGHTS,
    START_NS,
    STEP_NS,
    T_right_left_of,
    change_messages,
    pose_at,
)
from tests.fixtures.stereo_room import render, right_of

RIGHT, T_RIGHT_LEFT = RIGHTS["bob"], T_right_left_of("bob")
T_LEFT_RIGHT = se3.inverse(T_RIGHT_LEFT)
TEXT = " ".join(f"{v:.12f}" for v in (*T_LEFT_RIGHT[:3, 3], *so3.to_quat_wxyz(T_LEFT_RIGHT[:3, :3])))


def raw_rig() -> StereoRig:
    cameras = [RawCamera(c.matrix(), D, c.width, c.height) for c, D in ((LEFT, D_LEFT), (RIGHT, D_RIGHT))]
    return StereoRig.of(cameras[0], cameras[1], T_RIGHT_LEFT, "here", options=StereoOptions(min_depth_m=1.5))


def poses() -> list[np.ndarray]:
    return [START @ se3.exp([0.03 * k, 0, 0.02 * k, 0, 0.01 * k, 0]) for k in range(FRAMES)]


def calibrated(info: Any, R: np.ndarray, P: np.ndarray) -> Any:
    info.r, info.p = np.asarray(R, float).ravel(), np.asarray(P, float).ravel()
    return info


def stereo_log(
    folder: Path, stated: str, broken: Mapping[int, bytes] | None = None, apart_ns: int = 1_000_000
) -> Path:
    """A bag of a pair.

    Args:
        folder: for the log.
        stated: how ("p", "rect", "tf", "option", "wrong", "none") the right camera's place is.
        broken: by number of the frame, what is recorded instead of the right image; all are compressed then.
        apart_ns: stamps of the right images after those of the left.
    """
    r = Ros(2)
    D = [(*D_LEFT, 0.0), (*D_RIGHT, 0.0)]
    size = (LEFT.width, LEFT.height)
    turns = cv2.stereoRectify(
        LEFT.matrix(), np.array(D[0]), RIGHT.matrix(), np.array(D[1]), size, T_RIGHT_LEFT[:3, :3],
        T_RIGHT_LEFT[:3, 3:], flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )  # fmt: skip
    rig = raw_rig()
    name = "image_rect" if stated == "rect" else "image_raw"
    infos = [r.info(START_NS, frame, c, d) for frame, c, d in (("l", LEFT, D[0]), ("r", RIGHT, D[1]))]
    if stated in ("p", "rect", "wrong"):
        infos = [calibrated(infos[k], turns[k], turns[2 + k]) for k in (0, 1)]
    if stated == "wrong":
        infos[1].r = turns[1].T.ravel()
    rows = [
        (f"/eyes/{side}/camera_info", START_NS, info)
        for side, info in zip(("left", "right"), infos, strict=True)
        if stated != "none"
    ]
    if stated == "tf":
        rows.append(("/tf_static", START_NS, r.tf(r.transform(START_NS, "l", "r", T_LEFT_RIGHT))))
    for k, T in enumerate(poses()):
        at = START_NS + k * STEP_NS
        images = [render(LEFT, T, D_LEFT)[0], render(RIGHT, right_of(T, T_RIGHT_LEFT), D_RIGHT)[0]]
        if stated == "rect":
            images = [rig.rectify_left(images[0]), rig.rectify_right(images[1])]
        for side, frame, image in zip(("left", "right"), "lr", images, strict=True):
            late = 0 if side == "left" else apart_ns
            message, topic = r.image(at + late, frame, image, "rgb8"), f"/eyes/{side}/{name}"
            if broken is not None:
                data = cv2.imencode(".png", image[..., ::-1])[1].tobytes()
                data = broken.get(k, data) if side == "right" else data
                message, topic = (
                    r.compressed(at + late, frame, data, "rgb8; png compressed bgr8"),
                    f"{topic}/compressed",
                )
            rows.append((topic, at + 5_000_000 + late, message))
        rows.append(("/odom", at + 6_000_000, odometry(r, at, "l", T)))
    return r.write(folder / stated, rows, "sqlite3")


@pytest.mark.parametrize("stated", ["p", "rect", "tf", "option"])
def test_a_stereo_pair(tmp_path: Path, stated: str) -> None:
    options = ["depth_from=stereo", "truth=/odom", "min_depth_m=1.5", "max_relative_sigma=0.1"]
    options += [f"T_color_depth={TEXT}"] if stated == "option" else []
    registry.convert("ros", stereo_log(tmp_path, stated), tmp_path / "rec", options=options)
    recording, rig = Recording(tmp_path / "rec"), raw_rig()
    assert recording.description["checks"]["alpha"]["row_difference_px"] < 0.3
    assert recording.description["checks"]["alpha"]["reprojection_median_m"] is not None
    turn = np.eye(4)
    turn[:3, :3] = rig.R_rectified_left.T
    with open_rgbd(recording.log("alpha")) as log:
        np.testing.assert_allclose(log.camera.matrix(), rig.camera.matrix(), rtol=1e-6)
        for frame, T in zip(log.frames(), poses(), strict=True):
            color, truth = render(rig.camera, T @ turn)
            known = frame.depth > 0
            assert frame.depth_sigma is not None
            assert known.mean() > 0.7
            assert np.median((np.abs(frame.depth - truth) / truth)[known]) < 0.01
            assert np.median(np.abs(frame.color.astype(int) - color)) < 12
    groundtruth = recording.groundtruth("alpha")
    assert groundtruth is not None
    stated_poses = [record.proto() for record in read_log(groundtruth) if "pose" in record.topic]
    for found, T in zip(stated_poses, poses(), strict=True):
        np.testing.assert_allclose(messages.unpack_pose_in_frame(found), T @ turn, atol=1e-6)


def test_broken_images_of_a_pair_cost_themselves(tmp_path: Path) -> None:
    """Also among the pairs by which the rectification is tested."""
    options = ["depth_from=stereo", "min_depth_m=1.5", "max_relative_sigma=0.1"]
    no_jpeg = b"\xff\xd8\xff\xe0" + b"\x55" * 400 + b"\xff\xd9"
    log = stereo_log(tmp_path, "p", {0: no_jpeg, 2: b"\x89PNG"})
    registry.convert("ros", log, tmp_path / "rec", options=options)
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as found:
        assert len(found) == FRAMES - 2
    log = stereo_log(tmp_path, "tf", dict.fromkeys(range(FRAMES), no_jpeg))
    with pytest.raises(DuagError, match="406 bytes of rgb8, expected an image"):
        registry.convert("ros", log, tmp_path / "rec2", options=options)


@pytest.mark.parametrize(("apart_ns", "said"), [(0, False), (1_000_000, False), (5_000_000, True)])
def test_a_pair_that_was_not_taken_at_once_is_said(tmp_path: Path, apart_ns: int, said: bool) -> None:
    options = ["depth_from=stereo", "min_depth_m=1.5", "max_relative_sigma=0.1"]
    log = stereo_log(tmp_path, "p", apart_ns=apart_ns)
    registry.convert("ros", log, tmp_path / "rec", options=options)
    warnings = Recording(tmp_path / "rec").description["warnings"]
    words = "/eyes/left/image_raw and /eyes/right/image_raw are 5.0 ms apart (median)"
    assert any(words in text for text in warnings) == said, warnings


def test_a_pair_whose_rows_do_not_meet_is_refused(tmp_path: Path) -> None:
    log = stereo_log(tmp_path, "wrong")
    with pytest.raises(
        DuagError, match=r"/eyes/left/image_raw and /eyes/right/image_raw: matched features lie"
    ):
        registry.convert("ros", log, tmp_path / "rec", options=["depth_from=stereo"])
    assert not (tmp_path / "rec").exists()
    log = stereo_log(tmp_path, "option")  # and no option
    with pytest.raises(
        DuagError, match=r"P of /eyes/right/camera_info has no base line, and /tf_static does not tie"
    ):
        registry.convert("ros", log, tmp_path / "rec", options=["depth_from=stereo"])


def test_cameras_that_the_options_state_need_no_topic(tmp_path: Path) -> None:
    def text(camera: PinholeCamera) -> str:
        return f"{camera.fx!r} {camera.fy!r} {camera.cx!r} {camera.cy!r}"

    log = stereo_log(tmp_path, "none")
    options = ["depth_from=stereo", "min_depth_m=1.5", f"T_color_depth={TEXT}"]
    for option, camera, D in (("color_camera", LEFT, D_LEFT), ("depth_camera", RIGHT, D_RIGHT)):
        options.append(f"{option}={text(camera)} {' '.join(map(repr, D))} 0.0")
    registry.convert("ros", log, tmp_path / "rec", options=options)
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as found:
        np.testing.assert_allclose(found.camera.matrix(), raw_rig().camera.matrix(), rtol=1e-6)
    lidar = lidar_log(tmp_path, infos=False)
    stated = ["depth_from=lidar", f"color_camera={text(PinholeCamera(240, 180, 200.0, 200.0, 119.5, 89.5))}"]
    registry.convert("ros", lidar, tmp_path / "rec2", options=stated)
    with open_rgbd(tmp_path / "rec2" / "alpha.mcap") as found:
        assert found.camera.fx == 200.0


def pair_of(infos: list[Any]) -> StereoRig:
    """The pair of two CameraInfo, whose poses are also on /tf_static."""
    log = SimpleNamespace(name="log", first=lambda topic: infos["lr".index(topic[-1])])
    eyes = [(f"/{k}", f"/info/{k}", RosCamera.of(i, False, k)) for k, i in zip("lr", infos, strict=True)]
    transforms = SimpleNamespace(lookup=lambda *_: T_LEFT_RIGHT)
    return stereo_of(log, eyes[0], eyes[1], False, transforms=transforms, settings=LogOptions())._frames.rig


def infos_of_pair() -> list[Any]:
    D = [(*D_LEFT, 0.0), (*D_RIGHT, 0.0)]
    turns = cv2.stereoRectify(
        LEFT.matrix(), np.array(D[0]), RIGHT.matrix(), np.array(D[1]), (LEFT.width, LEFT.height),
        T_RIGHT_LEFT[:3, :3], T_RIGHT_LEFT[:3, 3:], flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )  # fmt: skip
    infos = [Ros(2).info(START_NS, k, c, d) for k, c, d in (("l", LEFT, D[0]), ("r", RIGHT, D[1]))]
    return [calibrated(infos[k], turns[k], turns[2 + k]) for k in (0, 1)]


def test_an_empty_projection_says_nothing_of_the_pair() -> None:
    infos = infos_of_pair()
    for info in infos:
        info.p = np.zeros(0)
    base = float(np.linalg.norm(T_LEFT_RIGHT[:3, 3]))
    assert pair_of(infos).baseline_m == pytest.approx(base, rel=1e-6)
    infos = infos_of_pair()
    infos[1].r = np.zeros(0)
    with pytest.raises(DuagError, match="log: /info/r: R of 0 numbers, expected 9"):
        pair_of(infos)


def test_images_with_half_of_the_pixels_have_half_of_the_projection() -> None:
    whole = pair_of(infos_of_pair())
    infos = infos_of_pair()
    for info in infos:
        info.binning_x = info.binning_y = 2
    half = pair_of(infos)
    assert (half.camera.width, half.camera.fx) == (
        whole.camera.width // 2,
        pytest.approx(whole.camera.fx / 2),
    )
    assert half.camera.cx == pytest.approx((whole.camera.cx + 0.5) / 2 - 0.5)
    assert half.baseline_m == pytest.approx(whole.baseline_m)


def test_a_lidar_beside_color_that_is_rectified_already() -> None:
    """It moves with the frame of color; it is drawn from where the turned images are taken."""
    R = so3.exp([0.02, -0.03, 0.01])
    turned = RosCamera(LEFT, (), False, "cam", R=tuple(R.ravel().tolist()), is_rectified=True)
    T = se3.exp([0.1, -0.2, 0.05, 0.3, 0.2, 1.0])
    sweeps = Sweeps(LidarSource(T, 0.02, None, VELODYNE), turned, ("color", "points"))
    np.testing.assert_allclose(
        sweeps.T_camera_lidar, se3.from_rotation_translation(R, np.zeros(3)) @ T, atol=1e-12
    )


def test_a_lidar_and_what_turns_it(tmp_path: Path) -> None:
    log, errors = lidar_log(tmp_path), {}
    for motion in ("imu=/imu", "odometry=/odom", ""):
        out = tmp_path / f"rec{motion[:3]}"
        options = ["depth_from=lidar", "truth=/odom", *([motion] if motion else [])]
        registry.convert("ros", log, out, options=options)
        recording = Recording(out)
        stated = any("hold what the LiDAR moved" in text for text in recording.description["warnings"])
        assert stated == (motion == "")
        assert recording.description["checks"]["alpha"]["reprojection_median_m"] < 0.1
        with open_rgbd(recording.log("alpha")) as found:
            assert len(found) == FRAMES
            frame = found.frame(1)
            truth = render(found.camera, pose_at(START, START_NS + STEP_NS))[1]
            known = frame.depth > 0
            assert frame.depth_sigma is not None
            assert known.mean() > 0.4
            errors[motion] = np.median((np.abs(frame.depth - truth) / truth)[known])
            assert (found.motion_prior() is None) == (motion == "")
    assert errors["imu=/imu"] < 0.001
    assert errors["odometry=/odom"] < 0.001 or errors["odometry=/odom"] < 0.5 * errors[""]
    assert errors[""] > 0.002


def test_points_in_microseconds_are_taken_so_and_it_is_told(tmp_path: Path) -> None:
    options = ["depth_from=lidar", "imu=/imu"]
    depths = []
    for unit_s in (1.0, 1e-6):
        log = lidar_log(tmp_path / str(unit_s), unit_s=unit_s)
        registry.convert("ros", log, tmp_path / f"rec{unit_s}", options=options)
        recording = Recording(tmp_path / f"rec{unit_s}")
        stated = [text for text in recording.description["warnings"] if "/points: field time" in text]
        assert stated == [] or (unit_s < 1 and "taken in us after the stamp" in stated[0])
        assert len(stated) == (unit_s < 1)
        with open_rgbd(recording.log("alpha")) as found:
            depths.append(found.frame(1).depth)
    np.testing.assert_allclose(depths[1], depths[0], atol=1e-3)


def test_a_sweep_that_is_cut_short_costs_its_frame_alone(tmp_path: Path) -> None:
    def cut(number: int, message: Any) -> None:
        message.data = message.data[: 50 if number == 0 else None]

    log = lidar_log(tmp_path)
    change_messages(log, "/points", "PointCloud2", cut)
    registry.convert("ros", log, tmp_path / "rec", options=["depth_from=lidar", "imu=/imu"])
    recording = Recording(tmp_path / "rec")
    with open_rgbd(recording.log("alpha")) as found:
        assert [frame.stamp_ns for frame in found.frames()] == [START_NS + k * STEP_NS for k in (1, 2)]
    assert any(
        "1 frames have color or depth that is cut short" in w for w in recording.description["warnings"]
    )


def test_logs_without_depth_say_what_could_be_used(tmp_path: Path) -> None:
    with pytest.raises(DuagError, match=r"holds depth images, but there are points \(depth_from=lidar\)"):
        registry.convert("ros", lidar_log(tmp_path), tmp_path / "rec")
    with pytest.raises(DuagError, match=r"/points is of 'velo', and /tf_static does not tie it to 'cam'"):
        registry.convert(
            "ros", lidar_log(tmp_path, tied=False), tmp_path / "rec", options=["depth_from=lidar"]
        )
    with pytest.raises(DuagError, match="depth_from"):
        registry.convert("ros", lidar_log(tmp_path / "b"), tmp_path / "rec", options=["depth_from=radar"])


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ([], "none of /camera/color/image_raw holds depth images; /livox/lidar "),
        (["depth_from=lidar"], "no topic holds sensor_msgs/msg/PointCloud2; /livox/lidar "),
        (
            ["depth_from=lidar", "depth=/livox/lidar"],
            "no topic holds sensor_msgs/msg/PointCloud2; /livox/lidar ",
        ),
        (["depth=/livox/lidar"], "depth topic /livox/lidar is livox_ros_driver2/msg/CustomMsg, expected"),
    ],
)
def test_points_as_a_driver_has_them_are_named(tmp_path: Path, options: list[str], found: str) -> None:
    r, kind = Ros(2), "livox_ros_driver2/msg/CustomMsg"
    r.store.register(get_types_from_msg("std_msgs/Header header\nuint64 timebase\nuint32 point_num", kind))
    rows = [row for row in still(r) if "depth" not in row[0]]
    sweep = r.make(kind, header=r.header(rows[-1][1], "lidar"), timebase=0, point_num=0)
    rows.append(("/livox/lidar", rows[-1][1], sweep))
    log = r.write(tmp_path / "log", rows, "mcap")
    with pytest.raises(DuagError) as caught:
        registry.convert("ros", log, tmp_path / "rec", options=options)
    assert found in str(caught.value)
    is_told = "(livox_ros_driver2/msg/CustomMsg) is of a driver and not read: republish it as" in str(
        caught.value
    )
    assert is_told == ("is livox" not in found)
