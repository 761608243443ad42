"""Logs whose clocks, cameras or paths are odd: warned of, or refused with a remedy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.converters import registry
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import open_rgbd
from tests.fixtures.kimera_multi import imu
from tests.fixtures.ros_bags import SMALL, START_NS, STEP_NS, Ros, odometry, still
from tests.fixtures.ros_clocks import moved_headers

DEPTH = "/camera/depth_registered/image_raw"


def warnings_of(recording: Path) -> list[str]:
    return list(json.loads((recording / "recording.json").read_text())["warnings"])


def moved_depth(r: Ros, by_ns: int) -> list[Any]:
    rows = still(r)
    moved_headers(r, [row for row in rows if row[0] == DEPTH], by_ns)
    return rows


@pytest.mark.parametrize("by_ns", [-START_NS, 3_600_000_000_000, 0])
def test_readings_of_another_clock_are_warned_of(tmp_path: Path, by_ns: int) -> None:
    r = Ros(2)
    times = [START_NS + k * STEP_NS for k in range(6)]
    rows = still(r) + [("/imu", t, imu(r, t + by_ns, "c", np.array([0.0, 0.0, 0.3]))) for t in times]
    bag = r.write(tmp_path / "bag", sorted(rows, key=lambda row: row[1]), "sqlite3")
    registry.convert("ros", bag, tmp_path / "rec", options=["imu=/imu"])
    assert any("/imu: its times" in text for text in warnings_of(tmp_path / "rec")) == bool(by_ns)


def test_depth_of_another_clock_offers_the_recorders(tmp_path: Path) -> None:
    r = Ros(2)
    bag = r.write(tmp_path / "bag", moved_depth(r, -(10**18)), "sqlite3")
    with pytest.raises(DuagError, match="expected pairs, or --set time_source=log"):
        registry.convert("ros", bag, tmp_path / "rec")
    registry.convert("ros", bag, tmp_path / "rec", options=["time_source=log"])


@pytest.mark.parametrize(("depth_s", "imu_s"), [(0, 0), (0.8, 0), (37, 0), (-37, -37), (0, 37)])
def test_clocks_that_differ_by_less_than_the_log_are_warned_of(
    tmp_path: Path, depth_s: float, imu_s: float
) -> None:
    """TAI is 37 s before UTC: images are paired all the same, each with what was seen half a minute before."""
    r = Ros(2)
    rows = [
        (topic, START_NS + (at_ns - START_NS) * 200, message)  # one image in 10 s
        for topic, at_ns, message in still(r, frames=8)
    ]
    for topic, log_ns, message in rows:
        by_ns = round(1e9 * depth_s) if topic == DEPTH else 0
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(log_ns - 30_000_000 + by_ns, 10**9)
    for k in range(80):
        at_ns = START_NS + k * 10**9
        message = imu(r, at_ns - 1_000_000 + imu_s * 10**9, "c", np.array([0.0, 0.0, 0.3]))
        rows.append(("/imu", at_ns, message))
    bag = r.write(tmp_path / "bag", sorted(rows, key=lambda row: row[1]), "sqlite3")
    options = ["imu=/imu", "association=nearest", "max_difference_s=5"]
    registry.convert("ros", bag, tmp_path / "rec", options=options)
    found = [text for text in warnings_of(tmp_path / "rec") if "as if their clocks differ" in text]
    late = {DEPTH: depth_s, "/imu": imu_s}
    wrong = [topic for topic in (DEPTH, "/imu") if abs(late[topic]) > 1]
    assert sorted(text.split()[1] for text in found) == wrong, found
    least = 0.03 if DEPTH in wrong else 0.001
    assert not wrong or f"recorded {least - late[wrong[0]]:.3f} s after the times of its headers" in " ".join(
        found
    )
    if found:
        registry.convert("ros", bag, tmp_path / "log", options=[*options, "time_source=log"])
        assert not [text for text in warnings_of(tmp_path / "log") if "clock" in text]


def test_depth_before_the_first_color_keeps_its_time_from_zero(tmp_path: Path) -> None:
    r = Ros(2)
    bag = r.write(tmp_path / "bag", moved_depth(r, -15_000_000), "sqlite3")
    registry.convert("ros", bag, tmp_path / "rec", options=["clocks=from_zero"])
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        frames = [log.frame(i) for i in range(len(log))]
    assert [frame.stamp_ns - STEP_NS * i for i, frame in enumerate(frames)] == [15_000_000] * len(frames)
    assert {frame.depth_offset_ns for frame in frames} == {-15_000_000}


def test_a_camera_that_was_not_calibrated_can_be_stated(tmp_path: Path) -> None:
    r = Ros(2)
    infos = {
        "/camera/color/camera_info": r.info(START_NS, "c", PinholeCamera(64, 48, 0.0, 0.0, 0.0, 0.0)),
        "/camera/depth_registered/camera_info": r.info(START_NS, "c", SMALL),
    }
    bag = r.write(tmp_path / "bag", still(r, infos=infos), "sqlite3")
    with pytest.raises(DuagError, match=r"focal length 0, 0 px .*, or --set color_camera='fx fy cx cy'"):
        registry.convert("ros", bag, tmp_path / "rec")
    registry.convert("ros", bag, tmp_path / "rec", options=["color_camera=60 60 31.5 23.5"])


@pytest.mark.parametrize("name", ["day #2", "50%25 run", "why?"])
def test_signs_of_a_uri_in_a_path(tmp_path: Path, name: str) -> None:
    r = Ros(2)
    bag = r.write(tmp_path / "bag", still(r), "sqlite3").rename(tmp_path / name)
    registry.convert("ros", bag, tmp_path / "rec")
    assert warnings_of(tmp_path / "rec") == []


@pytest.mark.parametrize(("worlds", "count"), [(("a/odom", "b/odom"), 1), (("map", "/map"), 0)])
def test_true_poses_in_different_frames_are_warned_of(
    tmp_path: Path, worlds: tuple[str, str], count: int
) -> None:
    r = Ros(2)
    for robot, world in zip("ab", worlds, strict=True):
        rows = still(r)
        for k in range(6):
            message = odometry(r, START_NS + k * STEP_NS, "c", np.eye(4))
            object.__setattr__(message.header, "frame_id", world)
            rows.append(("/truth", START_NS + k * STEP_NS, message))
        r.write(tmp_path / "logs" / robot, sorted(rows, key=lambda row: row[1]), "sqlite3")
    registry.convert("ros", tmp_path / "logs", tmp_path / "rec", options=["truth=/truth"])
    assert (
        sum("true poses are in different frames" in text for text in warnings_of(tmp_path / "rec")) == count
    )
