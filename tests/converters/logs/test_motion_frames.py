"""Transforms and poses of logs: those that are none, bodies that nobody names, and frames that are not optical."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.converters import registry
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import read_log
from tests.fixtures.kimera_multi import imu
from tests.fixtures.ros_bags import START_NS, STEP_NS, Ros, odometry, still

OPTICAL = se3.from_rotation_translation([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.0, 0.0, 0.0])
TIMES = [START_NS + k * STEP_NS for k in range(7)]


def warnings_of(recording: Path) -> list[str]:
    return list(json.loads((recording / "recording.json").read_text())["warnings"])


def static(r: Ros, parent: str, child: str, T: np.ndarray, quaternion: tuple[float, ...] = ()) -> Any:
    """quaternion: x, y, z, w that the message holds instead."""
    transform = r.transform(START_NS, parent, child, T)
    for name, value in zip("xyzw", quaternion, strict=False):
        object.__setattr__(transform.transform.rotation, name, value)
    return "/tf_static", START_NS, r.tf(transform)


def convert(r: Ros, tmp_path: Path, rows: list[Any], *options: str) -> Path:
    bag = r.write(tmp_path / "bag", sorted(rows, key=lambda row: row[1]), "sqlite3")
    registry.convert("ros", bag, tmp_path / "rec", options=list(options))
    return tmp_path / "rec"


def odometry_rows(r: Ros, child: str) -> list[Any]:
    """A body that moves along its x axis."""
    return [
        ("/odom", t, odometry(r, t, child, se3.from_rotation_translation(np.eye(3), [0.1 * k, 0, 0])))
        for k, t in enumerate(TIMES)
    ]


def test_a_transform_that_is_none_is_left_out(tmp_path: Path) -> None:
    r = Ros(2)
    out = convert(r, tmp_path, [static(r, "map", "odom", np.eye(4), (0, 0, 0, 0)), *still(r)])
    [warning] = warnings_of(out)
    assert "/tf_static: 1 transforms without a rotation or a finite position (map odom); left out" in warning


def test_a_transform_that_is_none_is_an_error_where_it_is_needed(tmp_path: Path) -> None:
    r = Ros(2)
    rows = still(r, depth=("/camera/depth/image_raw", "d"))
    with pytest.raises(DuagError, match=r"/tf_static: quaternion wxyz \[0\.0, 0\.0, 0\.0, 0\.0\], expected"):
        convert(r, tmp_path, [static(r, "c", "d", np.eye(4), (0, 0, 0, 0)), *rows])


def test_a_quaternion_of_few_digits_is_normalized(tmp_path: Path) -> None:
    r = Ros(2)
    rows = [static(r, "base", "c", OPTICAL, (-0.47, 0.47, -0.47, 0.47)), *still(r), *odometry_rows(r, "base")]
    out = convert(r, tmp_path, rows, "odometry=/odom")
    assert any("1 transforms whose quaternion has not length 1; normalized" in w for w in warnings_of(out))
    np.testing.assert_allclose(moved(out), [0, 0, 0.4], atol=1e-6)


def moved(recording: Path) -> np.ndarray:
    """How the camera moved in its own axes, by the odometry."""
    T = [
        m.unpack_pose_in_frame(x.proto())
        for x in read_log(recording / "alpha.mcap", ["/alpha/odometry_prior"])
    ]
    return np.asarray((np.linalg.inv(T[0]) @ T[4])[:3, 3])


def test_true_poses_that_are_none_are_left_out(tmp_path: Path) -> None:
    """One of a motion capture that lost its body; and one of a gripper that nobody asked for."""
    r = Ros(2)
    rows = still(r) + [("/tf", t, r.tf(r.transform(t, "world", "c", np.eye(4)))) for t in TIMES]
    for parent, child, at in (("world", "c", TIMES[-1] + STEP_NS), ("gripper", "finger", TIMES[-1])):
        transform = r.transform(at, parent, child, np.eye(4))
        object.__setattr__(transform.transform.rotation, "w", 0.0)
        rows.append(("/tf", at, r.tf(transform)))
    out = convert(r, tmp_path, rows, "truth=/tf world c")
    [warning] = warnings_of(out)
    assert "/tf: 2 true poses without a rotation" in warning
    with pytest.raises(DuagError, match="/tf: quaternion wxyz"):
        registry.convert("ros", tmp_path / "bag", tmp_path / "rec2", options=["truth=/tf gripper finger"])


def test_a_body_of_the_name_camera_is_where_the_transforms_put_it(tmp_path: Path) -> None:
    r = Ros(2)
    rows = [static(r, "camera", "c", OPTICAL), *still(r), *odometry_rows(r, "camera")]
    np.testing.assert_allclose(moved(convert(r, tmp_path, rows, "odometry=/odom")), [0, 0, 0.4], atol=1e-9)


@pytest.mark.parametrize(
    ("frame", "T", "count"), [("c", np.eye(4), 1), ("c_optical", np.eye(4), 0), ("c", OPTICAL, 0)]
)
def test_a_camera_whose_z_axis_is_that_of_its_body_is_warned_of(
    tmp_path: Path, frame: str, T: np.ndarray, count: int
) -> None:
    """As in Gazebo, where images are of frames with x forward."""
    r = Ros(2)
    turning = [("/imu", t, imu(r, t, "base", np.array([0.0, 0.0, 0.3]))) for t in TIMES]
    images = still(r, ("/camera/color/image_raw", frame), ("/camera/depth_registered/image_raw", frame))
    rows = [static(r, "base", frame, T), *images, *odometry_rows(r, "base"), *turning]
    warnings = warnings_of(convert(r, tmp_path, rows, "odometry=/odom", "imu=/imu"))
    assert [sum(option in w for w in warnings) for option in ("T_odometry_color", "T_color_imu")] == [
        count
    ] * 2


def test_true_poses_of_nobody_knows_which_body_are_warned_of(tmp_path: Path) -> None:
    r = Ros(2)
    rows = [*still(r), *odometry_rows(r, "")]
    assert any("true poses name no body" in w for w in warnings_of(convert(r, tmp_path, rows, "truth=/odom")))
    options = ["truth=/odom", "truth_frame=camera"]
    registry.convert("ros", tmp_path / "bag", tmp_path / "rec2", options=options)
    assert warnings_of(tmp_path / "rec2") == []


def test_an_imu_that_measures_no_turning_is_left_out(tmp_path: Path) -> None:
    """RealSense's /camera/accel/sample has the same type as its IMU."""
    r = Ros(2)
    rows = still(r) + [("/accel", t, imu(r, t, "c", np.zeros(3))) for t in TIMES]
    out = convert(r, tmp_path, rows, "imu=/accel")
    assert any("/accel: all turning rates are zero" in w for w in warnings_of(out))
    assert not list(read_log(out / "alpha.mcap", ["/alpha/imu"]))


def test_a_message_of_an_imu_that_is_no_number_is_left_out(tmp_path: Path) -> None:
    r, lost = Ros(2), np.full(3, np.nan)
    rates = [np.array([0.1, 0.2, 0.3]) for _ in TIMES]
    rates[1] = lost
    rows = still(r) + [("/imu", t, imu(r, t, "c", rate)) for t, rate in zip(TIMES, rates, strict=True)]
    out = convert(r, tmp_path, rows, "imu=/imu")
    said = f"1 of {len(TIMES)} messages hold numbers that are not finite, the first at {TIMES[1] / 1e9:.3f} s"
    assert any(f"/imu: {said}; left out" in w for w in warnings_of(out))
    assert len(list(read_log(out / "alpha.mcap", ["/alpha/imu"]))) == len(TIMES) - 1
    rows = still(r) + [("/imu", t, imu(r, t, "c", lost)) for t in TIMES]
    with pytest.raises(DuagError, match="/imu holds no message of finite numbers"):
        registry.convert(
            "ros", r.write(tmp_path / "lost", rows, "mcap"), tmp_path / "r", options=["imu=/imu"]
        )


def test_frames_without_a_name_are_tied_by_nothing(tmp_path: Path) -> None:
    """Nobody said where an IMU is: that it has the axes of the camera would be a guess."""
    r = Ros(2)
    rows = still(r, ("/camera/color/image_raw", ""), ("/camera/color/depth_registered", ""))
    rows += [("/imu", t, imu(r, t, "", np.array([0.1, 0.2, 0.3]))) for t in TIMES]
    with pytest.raises(
        DuagError, match=r"/imu is of '', and /tf_static does not tie it to ''; expected --set T_c"
    ):
        convert(r, tmp_path, rows, "imu=/imu", "registered=yes")
