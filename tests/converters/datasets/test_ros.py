"""Bags of ROS 1 and ROS 2 made in the test, of every container and encoding, and real ones where they are."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from duagc.converters import registry
from duagc.converters.logs.frames import pose_matrix
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.recording import open_rgbd, read_log
from duagc.pipeline.recording.read import LogFile
from duagc.pipeline.recording.register_depth import register_depth
from duagc.schemas import topics
from tests.fixtures.box_room import path, render
from tests.fixtures.ros_bags import (
    COLOR,
    DEPTH,
    DISTORTION,
    FRAMES,
    REAL,
    START_NS,
    STEP_NS,
    T_COLOR_DEPTH,
    Ros,
    scene,
)


@pytest.mark.parametrize(
    ("version", "container"), [(1, "plain"), (1, "bz2"), (1, "lz4"), (2, "sqlite3"), (2, "mcap")]
)
def test_every_container_gives_the_same_recording(tmp_path: Path, version: int, container: str) -> None:
    r = Ros(version)
    bag = r.write(tmp_path / "bag", scene(r), container)
    registry.convert("ros", bag, tmp_path / "rec", options=["truth=/odom"])
    records = read_log(
        tmp_path / "rec" / "alpha.groundtruth.mcap", topics=[topics.GROUNDTRUTH_POSE.of("alpha")]
    )
    poses = [m.unpack_pose_in_frame(record.proto()) for record in records]
    assert np.allclose(poses, path(FRAMES), atol=1e-9)
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        assert len(log) == FRAMES
        assert log.camera == COLOR
        for i in (0, 1):
            frame = log.frame(i)
            assert frame.stamp_ns == START_NS + (i + 1) * STEP_NS
            color, z = render(COLOR, path(FRAMES)[i])
            seen = frame.depth > 0
            assert seen.mean() > 0.6
            error = np.abs(frame.depth - z)[seen]
            assert np.median(error) < 0.02
            assert np.percentile(error, 95) < 0.15
            inner = np.s_[20:-20, 20:-20]
            assert np.median(np.abs(frame.color[inner].astype(int) - color[inner])) <= 2
    check = json.loads((tmp_path / "rec" / "recording.json").read_text())["checks"]["alpha"]
    assert check["reprojection_median_m"] < 0.05


def test_a_topic_of_two_types_is_refused(tmp_path: Path) -> None:
    r = Ros(1)
    rows = [*scene(r), ("/tf_static", START_NS, r.info(START_NS, "color", COLOR))]
    with pytest.raises(DuagError, match=r"/tf_static holds .*TFMessage and .*CameraInfo, expected one type"):
        registry.convert("ros", r.write(tmp_path / "bag", rows, "plain"), tmp_path / "rec")


@pytest.mark.parametrize("container", ["plain", "lz4"])
def test_an_index_that_leads_to_another_topic_is_refused(tmp_path: Path, container: str) -> None:
    r = Ros(1)
    bag = r.write(tmp_path / "bag", scene(r), container)
    data = bytearray(bag.read_bytes())
    entries = [m.start() for m in re.finditer(rb"op=\x04", data)]  # one for every topic
    for at in entries:
        conn = data.index(b"conn=", at - 40) + 5
        data[conn] = (data[conn] + 1) % len(entries)
    bag.write_bytes(data)
    with pytest.raises(DuagError, match=r"bag\.bag: .*, expected a sound bag of ROS 1 or ROS 2"):
        registry.convert("ros", bag, tmp_path / "rec")


def test_color_that_is_too_fine_for_the_depth_is_refused(tmp_path: Path) -> None:
    """Depth is drawn in steps of the other camera's pixels: a wrong CameraInfo would ask for all memory."""
    r = Ros(1)
    wrong = {
        "/camera/color/camera_info": r.info(START_NS, "_color", replace(COLOR, fy=15 * COLOR.fy)),
        "/camera/depth/camera_info": r.info(START_NS, "_depth", replace(DEPTH, fy=DEPTH.fy / 6)),
    }
    rows = [(name, at, wrong.get(name, message)) for name, at, message in scene(r)]
    with pytest.raises(
        DuagError, match=r"color/image_raw are \d+ times as fine as those of .*, expected at most"
    ):
        registry.convert("ros", r.write(tmp_path / "bag", rows, "plain"), tmp_path / "rec")


def test_depth_that_is_not_moved_is_wrong(tmp_path: Path) -> None:
    """The extrinsics matter: taken as registered, the depth does not fit."""
    z = render(DEPTH, path(1)[0] @ T_COLOR_DEPTH)[1].astype(np.float32)
    _, true = render(COLOR, path(1)[0])
    moved = register_depth(z, DEPTH, T_COLOR_DEPTH, COLOR)
    still = register_depth(z, DEPTH, np.eye(4), COLOR)

    def error(depth: np.ndarray) -> float:
        return float(np.percentile(np.abs(depth - true)[depth > 0], 90))

    assert error(still) > 2 * error(moved)
    holes = (moved[30:-30, 40:-40] == 0).mean()
    assert holes < 0.01


def test_two_robots_in_one_bag_and_in_two(tmp_path: Path) -> None:
    r = Ros(2)
    both = sorted(
        scene(r, prefix="/jackal") + scene(r, prefix="/husky", poses=path(FRAMES, 0.2)), key=lambda x: x[1]
    )
    bag = r.write(tmp_path / "one", both, "mcap")
    with pytest.raises(DuagError, match="expected --set depth=TOPIC"):
        registry.convert("ros", bag, tmp_path / "rec")
    registry.convert("ros", bag, tmp_path / "rec", options=["namespaces=/husky,/jackal"])
    (tmp_path / "two").mkdir()
    r.write(tmp_path / "two" / "a", scene(r, prefix="/husky", poses=path(FRAMES, 0.2)), "sqlite3")
    r.write(tmp_path / "two" / "b", scene(r, prefix="/jackal"), "sqlite3")
    registry.convert("ros", tmp_path / "two", tmp_path / "rec2", robots=2)
    for name, other in (("husky", "alpha"), ("jackal", "bravo")):
        with (
            open_rgbd(tmp_path / "rec" / f"{name}.mcap") as one,
            open_rgbd(tmp_path / "rec2" / f"{other}.mcap") as two,
        ):
            assert np.array_equal(one.frame(2).depth, two.frame(2).depth)
            assert np.array_equal(one.frame(2).color, two.frame(2).color)
    with pytest.raises(DuagError, match="found 2 robots, expected --robots 2"):
        registry.convert("ros", tmp_path / "two", tmp_path / "rec3", robots=3)


def test_times(tmp_path: Path) -> None:
    """Late depth keeps its time; recording times are used only if asked for; times that go back are stated."""
    r = Ros(1)
    bag = r.write(tmp_path / "late", scene(r, late_ns=23_000_000), "plain")
    with pytest.raises(DuagError, match=r"no image on /camera/depth/image_rect_raw within 0.02 s"):
        registry.convert("ros", bag, tmp_path / "rec", options=["association=official"])
    registry.convert("ros", bag, tmp_path / "late_rec")
    with open_rgbd(tmp_path / "late_rec" / "alpha.mcap") as log:
        assert abs(log.frame(0).depth_offset_ns) == min(23_000_000, abs(STEP_NS - 23_000_000))
    registry.convert("ros", bag, tmp_path / "log", options=["time_source=log"])
    with open_rgbd(tmp_path / "log" / "alpha.mcap") as log:
        assert log.frame(0).stamp_ns == START_NS + STEP_NS + 5_000_000
    rows = scene(r)
    times = [row[1] for row in rows]
    backwards = [(t, times[k], msg) for k, (t, _, msg) in enumerate(rows[:3] + rows[9:] + rows[3:9])]
    bag = r.write(tmp_path / "backwards", sorted(backwards, key=lambda x: x[1]), "plain")
    registry.convert("ros", bag, tmp_path / "sorted")
    warnings = json.loads((tmp_path / "sorted" / "recording.json").read_text())["warnings"]
    assert any("times go backwards" in w for w in warnings)
    with open_rgbd(tmp_path / "sorted" / "alpha.mcap") as log:
        assert [log.frame(i).stamp_ns for i in range(FRAMES)] == [
            START_NS + (i + 1) * STEP_NS for i in range(FRAMES)
        ]


def test_a_frame_tied_to_nothing_needs_extrinsics(tmp_path: Path) -> None:
    r = Ros(2)
    rows = [row for row in scene(r) if row[0] != "/tf_static"]
    bag = r.write(tmp_path / "bag", rows, "sqlite3")
    with pytest.raises(DuagError, match="/tf_static does not tie them"):
        registry.convert("ros", bag, tmp_path / "rec")
    q, t = so3.to_quat_wxyz(T_COLOR_DEPTH[:3, :3]), T_COLOR_DEPTH[:3, 3]
    numbers = " ".join(repr(float(v)) for v in (*t, *q))
    registry.convert("ros", bag, tmp_path / "rec", options=[f"T_color_depth='{numbers}'"])
    with_tf = r.write(tmp_path / "with", scene(r), "sqlite3")
    registry.convert("ros", with_tf, tmp_path / "rec2")
    with (
        open_rgbd(tmp_path / "rec" / "alpha.mcap") as one,
        open_rgbd(tmp_path / "rec2" / "alpha.mcap") as two,
    ):
        assert np.array_equal(one.frame(0).depth, two.frame(0).depth)
    with pytest.raises(DuagError, match="expected 'x y z qw qx qy qz'"):
        registry.convert("ros", bag, tmp_path / "rec3", options=["T_color_depth='1 2'"])


def test_true_poses_of_a_transform_that_changes(tmp_path: Path) -> None:
    """ "/tf world base": the same poses as those of the odometry, by any of the clocks."""
    r = Ros(2)
    rows = []
    for topic, log_ns, message in scene(r):
        if topic != "/odom":
            rows.append((topic, log_ns, message))
            continue
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        pose = message.pose.pose
        T = pose_matrix(pose.position, pose.orientation, "here")
        rows.append(("/tf", log_ns, r.tf(r.transform(stamp, "world", "_base", T))))
    bag = r.write(tmp_path / "bag", rows, "mcap")
    for k, options in enumerate(
        (["truth=/tf world _base"], ["truth=/tf /world /_base", "time_source=header"])
    ):
        registry.convert("ros", bag, tmp_path / f"rec{k}", options=options)
        records = read_log(tmp_path / f"rec{k}" / "alpha.groundtruth.mcap")
        assert np.allclose(
            [m.unpack_pose_in_frame(record.proto()) for record in records], path(FRAMES), atol=1e-9
        )
    with pytest.raises(DuagError, match="/tf has no map _base, expected perhaps world _base"):
        registry.convert("ros", bag, tmp_path / "rec", options=["truth=/tf map _base"])


def test_depth_of_a_lens_is_undistorted_before_it_is_moved(tmp_path: Path) -> None:
    """A depth camera with distortion of its own gives the depth that one without would give."""
    r = Ros(1)
    bags = {}
    for name, distortion in (("straight", ()), ("bent", (0.2, -0.1, 0.002, 0.001, 0.0))):
        rows = []
        for topic, log_ns, message in scene(r):
            if topic.endswith("depth/camera_info"):
                message = r.info(START_NS, "_depth", DEPTH, distortion)
            if topic.endswith("image_rect_raw"):
                k = sum(t.endswith("image_rect_raw") for t, _, _ in rows)
                z = render(DEPTH, path(FRAMES)[k] @ T_COLOR_DEPTH, distortion)[1]
                stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                message = r.image(stamp, "_depth", np.rint(z * 1000).astype(np.uint16), "16UC1")
                topic = "/camera/depth/image_raw"
            rows.append((topic, log_ns, message))
        bags[name] = r.write(tmp_path / name, rows, "plain")
        registry.convert("ros", bags[name], tmp_path / f"rec_{name}")
    depths = []
    for name in bags:
        with open_rgbd(tmp_path / f"rec_{name}" / "alpha.mcap") as log:
            depths.append(log.frame(1).depth)
    both = (depths[0] > 0) & (depths[1] > 0)
    assert both.mean() > 0.5
    assert np.percentile(np.abs(depths[0] - depths[1])[both] / depths[0][both], 90) < 0.01


def test_infrared_images_are_not_taken_for_depth(tmp_path: Path) -> None:
    """Of 16UC1 and mono16 the former is depth; depth as JPEG is stated as the reason why there is none."""
    r = Ros(2)
    rows = scene(r)
    infrared = [
        (
            t.replace("depth/image_rect_raw", "infra/image_raw"),
            ns,
            r.image(ns, "_ir", np.ones((90, 120), np.uint16), "mono16"),
        )
        for t, ns, _ in rows
        if t.endswith("image_rect_raw")
    ]
    registry.convert("ros", r.write(tmp_path / "ir", rows + infrared, "mcap"), tmp_path / "rec")
    sensors = json.loads((tmp_path / "rec" / "recording.json").read_text())["robots"]["alpha"]["sensors"]
    assert sensors["depth_topic"] == "/camera/depth/image_rect_raw"
    jpeg = cv2.imencode(".jpg", np.full((90, 120), 30, np.uint8))[1].tobytes()
    lost = [
        (f"{t}/compressed", ns, r.compressed(ns, "_depth", jpeg, "16UC1; jpeg compressed "))
        if t.endswith("image_rect_raw")
        else (t, ns, message)
        for t, ns, message in rows
    ]
    with pytest.raises(
        DuagError, match="image_rect_raw/compressed holds no depth, or as JPEG, which destroys it"
    ):
        registry.convert("ros", r.write(tmp_path / "lost", lost, "mcap"), tmp_path / "rec2")


def test_depth_that_is_too_far_is_told(tmp_path: Path) -> None:
    """Registered depth is kept in half millimeters, up to 32.8 m; what lies beyond is left out, and counted."""
    r = Ros(2)
    rows = []
    for topic, log_ns, message in scene(r):
        if topic.endswith("image_rect_raw"):
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            pixels = np.full((90, 120), 3.0, np.float32)
            pixels[:45] = 40.0
            message = r.image(stamp, "_depth", pixels, "32FC1")
        rows.append((topic, log_ns, message))
    registry.convert("ros", r.write(tmp_path / "bag", rows, "sqlite3"), tmp_path / "rec")
    warnings = json.loads((tmp_path / "rec" / "recording.json").read_text())["warnings"]
    assert any("pixels are farther away than 32.8 m" in warning for warning in warnings)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda rows: [r for r in rows if "color/image" not in r[0]],
            "none of /camera/depth/image_rect_raw holds color images",
        ),
        (lambda rows: [r for r in rows if "camera_info" not in r[0]], "has CameraInfo on no topic"),
        (lambda rows: [r for r in rows if "image" not in r[0]], "found no topic of images"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, change: Callable[[Any], Any], message: str) -> None:
    r = Ros(2)
    bag = r.write(tmp_path / "bag", change(scene(r)), "sqlite3")
    with pytest.raises(DuagError, match=message):
        registry.convert("ros", bag, tmp_path / "rec")
    assert not (tmp_path / "rec").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda bag: edit_rows(bag, "update messages set data = 'text' where id = 4"), "holds 4 bytes that are no"),
        (lambda bag: edit_rows(bag, "update messages set data = 7"), "cannot open value of type integer"),
        (lambda bag: edit_metadata(bag, "message_count: [0-9]+", "message_count: many"), "'many'"),
        (lambda bag: edit_metadata(bag, "type: .*", "type: null"), "None"),
        (lambda bag: edit_metadata(bag, "name: .*", "name: 7"), "7"),
    ],
)  # fmt: skip
def test_a_database_with_anything_in_it_is_refused(
    tmp_path: Path, change: Callable[[Path], Any], message: str
) -> None:
    r = Ros(2)
    bag = r.write(tmp_path / "bag", scene(r), "sqlite3")
    change(bag)
    with pytest.raises(DuagError, match=message):
        registry.convert("ros", bag, tmp_path / "rec")


def edit_metadata(bag: Path, pattern: str, new: str) -> None:
    file = bag / "metadata.yaml"
    file.write_text(re.sub(pattern, new, file.read_text()))


def edit_rows(bag: Path, statement: str) -> None:
    with sqlite3.connect(next(bag.glob("*.db3"))) as base:
        base.execute(statement)
    base.close()


@pytest.mark.parametrize("keep", [0.3, 0.7, 0.95])
@pytest.mark.parametrize("version", [1, 2])
def test_a_truncated_bag_is_an_error(tmp_path: Path, version: int, keep: float) -> None:
    r = Ros(version)
    bag = r.write(tmp_path / "bag", scene(r), "plain" if version == 1 else "mcap")
    file = bag if bag.is_file() else next(bag.glob("*.mcap"))
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * keep)])
    with pytest.raises(DuagError):
        registry.convert("ros", bag, tmp_path / "rec")


@pytest.mark.skipif(not REAL.is_dir(), reason="the real bags are not there")
@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("foxglove_example.bag", [], "found no topic of images"),
        ("pj_rosbag2.db3", [], "found no topic of images"),
        ("lichtblick_custom-camera-model.mcap", [], "none of /image/compressed holds depth images"),
        ("realsense_single_depth_color.bag", [], r"within 0.1 s"),
    ],
)
def test_real_bags_are_refused_for_the_right_reason(
    tmp_path: Path, name: str, options: list[str], message: str
) -> None:
    with pytest.raises(DuagError, match=message):
        registry.convert("ros", REAL / name, tmp_path / "rec", options=options)


@pytest.mark.skipif(not REAL.is_dir(), reason="the real bags are not there")
def test_a_real_bag_converts_when_told_that_times_differ(tmp_path: Path) -> None:
    """Color and depth are 100 ms apart; the extrinsics are those that the camera's own software recorded."""
    source = REAL / "realsense_single_depth_color.bag"
    registry.convert("ros", source, tmp_path / "rec", options=["max_difference_s=0.2"])
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        frame = log.frame(0)
        assert (log.camera.width, log.camera.height) == (640, 480)
    assert 0.2 < (frame.depth > 0).mean() < 1
    assert 0.2 < np.median(frame.depth[frame.depth > 0]) < 5


def test_frames_whose_color_is_cut_short_are_left_out(tmp_path: Path) -> None:
    """Reported, not fatal: a camera that was unplugged for a moment must not cost the rest of the log."""
    r = Ros(1)
    rows = []
    for topic, log_ns, message in scene(r):
        if topic.endswith("color/image_raw"):
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            data = cv2.imencode(".jpg", render(COLOR, path(1)[0], DISTORTION)[0])[1].tobytes()
            whole = stamp != START_NS + 2 * STEP_NS
            message = r.compressed(stamp, "_color", data if whole else data[:999], "jpeg")
        rows.append((topic, log_ns, message))
    registry.convert("ros", r.write(tmp_path / "bag", rows, "lz4"), tmp_path / "rec")
    description = json.loads((tmp_path / "rec" / "recording.json").read_text())
    assert description["robots"]["alpha"]["frames"] == FRAMES - 1
    assert any(
        "1 frames have color or depth that is cut short" in warning for warning in description["warnings"]
    )


def test_cameras_can_be_stated_where_the_log_has_none(tmp_path: Path) -> None:
    r = Ros(2)
    whole = r.write(tmp_path / "whole", scene(r), "mcap")
    bag = r.write(tmp_path / "bag", [row for row in scene(r) if "camera_info" not in row[0]], "mcap")
    with pytest.raises(DuagError, match="CameraInfo on no topic; expected --set color_camera='fx fy cx cy'"):
        registry.convert("ros", bag, tmp_path / "none")
    color, depth = (
        " ".join(repr(x) for x in (c.fx, c.fy, c.cx, c.cy, *lens))
        for c, lens in ((COLOR, DISTORTION), (DEPTH, ()))
    )
    options = [f"color_camera={color}", f"depth_camera={depth}"]
    registry.convert("ros", whole, tmp_path / "as", options=["truth=/odom"])
    registry.convert("ros", bag, tmp_path / "stated", options=["truth=/odom", *options])
    with (
        open_rgbd(tmp_path / "as" / "alpha.mcap") as one,
        open_rgbd(tmp_path / "stated" / "alpha.mcap") as other,
    ):
        assert one.camera == other.camera
        np.testing.assert_array_equal(one.frame(1).color, other.frame(1).color)
        np.testing.assert_array_equal(one.frame(1).depth, other.frame(1).depth)
    for text in ("140 141 79", "140 141 79 x", "-1 141 79 60"):
        with pytest.raises(DuagError, match="camera"):
            registry.convert("ros", bag, tmp_path / "bad", options=[f"color_camera={text}", options[1]])


def test_color_without_depth_is_kept_to_be_followed(tmp_path: Path) -> None:
    """Depth comes with the first image only: the last one is 150 ms away from it, beyond what can be moved."""
    r = Ros(2)
    late = START_NS + STEP_NS + 20_000_000
    rows = [row for row in scene(r) if "/depth/image" not in row[0] or row[1] < late]
    bag = r.write(tmp_path / "bag", rows, "mcap")
    for option, kept, end in (("all", FRAMES, "followed by color"), ("official", 1, "left out")):
        registry.convert("ros", bag, tmp_path / option, options=["truth=/odom", f"association={option}"])
        with open_rgbd(tmp_path / option / "alpha.mcap") as log:
            assert len(log) == kept
            assert log.frame(0).depth.any()
            assert kept == 1 or not log.frame(FRAMES - 1).depth.any()
        warnings = json.loads((tmp_path / option / "recording.json").read_text())["warnings"]
        assert any(text.endswith(end) for text in warnings)


@pytest.mark.parametrize(("options", "left"), [([], 0), (["farthest_m=4"], 0), (["farthest_m=30"], 20_000)])
def test_the_greatest_distance_is_no_measurement(tmp_path: Path, options: list[str], left: int) -> None:
    r = Ros(2)
    rows = []
    for topic, log_ns, message in scene(r):
        if "/depth/image" in topic:
            z = render(DEPTH, path(FRAMES)[0])[1]
            units = np.rint(1000 * z).astype(np.uint16)
            units[:, :40] = 20_000
            message = r.image(log_ns, "_depth", units, "16UC1")
        rows.append((topic, log_ns, message))
    bag = r.write(tmp_path / "bag", rows, "mcap")
    registry.convert("ros", bag, tmp_path / "rec", options=options)
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        depth_m = log.frame(0).depth
        assert depth_m.max() == pytest.approx(left / 1000, rel=0.01) if left else 1.0 < depth_m.max() < 10.0
        assert (depth_m > 0).mean() > 0.3
    warnings = json.loads((tmp_path / "rec" / "recording.json").read_text())["warnings"]
    assert any("is exactly 20.000 m" in text for text in warnings) == (not options)


def test_depth_that_needs_no_moving_keeps_its_numbers(tmp_path: Path) -> None:
    """To the last bit, in any unit, and beyond 32 m."""
    r = Ros(2)
    rng = np.random.default_rng(5)
    pixels = rng.integers(0, 65536, (FRAMES, 120, 160)).astype(np.uint16)
    rows, k = [], 0
    for topic, log_ns, message in scene(r):
        if topic.endswith("camera_info"):
            message = r.info(START_NS, "_color", COLOR)
        elif topic.endswith("image_rect_raw"):
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            message, k = r.image(stamp, "_color", pixels[k], "16UC1", pad=6, big=k == 2), k + 1
        rows.append((topic, log_ns, message))
    bag = r.write(tmp_path / "bag", rows, "sqlite3")
    registry.convert("ros", bag, tmp_path / "rec", options=["depth_scale=0.00025"])
    with LogFile(tmp_path / "rec" / "alpha.mcap") as log:
        records = list(log.records(["/alpha/camera/depth"]))
    assert log.channels["/alpha/camera/depth"].metadata["depth_scale"] == "0.00025"
    assert all(
        np.array_equal(m.unpack_depth(record.proto(), "here"), pixels[i]) for i, record in enumerate(records)
    )


def test_times_in_another_order_than_the_recording_do_not_fill_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that jumps back would make the first half wait for the second."""
    r = Ros(2)
    rows = scene(r)
    moved = [(t, ns + 10**9 * (k < 9), message) for k, (t, ns, message) in enumerate(rows)]
    bag = r.write(tmp_path / "bag", sorted(moved, key=lambda x: x[1]), "mcap")
    registry.convert("ros", bag, tmp_path / "rec")
    monkeypatch.setattr("duagc.converters.logs.gather.MOST_KEPT_BYTES", 100_000)
    with pytest.raises(DuagError, match="wait for messages of earlier times, expected times in the order"):
        registry.convert("ros", bag, tmp_path / "rec2")


@pytest.mark.parametrize("container", ["bz2", "lz4"])
def test_chunks_that_unpack_into_too_much_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, container: str
) -> None:
    r = Ros(1)
    bag = r.write(tmp_path / "bag", scene(r), container)
    monkeypatch.setattr("duagc.converters.logs.rosbag_file.LARGEST_CHUNK", 50_000)
    with pytest.raises(DuagError, match="unpacks to more than 50000 bytes"):
        registry.convert("ros", bag, tmp_path / "rec")


def test_true_poses_of_a_file(tmp_path: Path) -> None:
    """In TUM's format and by a clock of their own; of a body whose place the log or an option states."""
    r = Ros(2)
    r.write(tmp_path / "bag", scene(r), "mcap")
    T_marker_color = se3.from_rotation_translation(so3.exp([0.1, -0.4, 0.3]), [0.02, -0.03, 0.1])
    lines = ["# time x y z qx qy qz qw"]
    for i, T in enumerate(path(FRAMES)):
        T_marker = T @ se3.inverse(T_marker_color)
        w, x, y, z = so3.to_quat_wxyz(T_marker[:3, :3])
        time = f"{(START_NS + (i + 1) * STEP_NS - 250_000_000) / 1e9:.9f}"
        lines.append(" ".join([time, *map(repr, map(float, (*T_marker[:3, 3], x, y, z, w)))]))
    (tmp_path / "gt.tum").write_text("\n".join(lines))
    stated = " ".join(
        repr(float(v)) for v in (*T_marker_color[:3, 3], *so3.to_quat_wxyz(T_marker_color[:3, :3]))
    )
    (tmp_path / "a.toml").write_text(
        f'[robots.a]\nlogs = ["bag"]\ntruth_file = "gt.tum"\nT_truth_color = "{stated}"\ntruth_offset_s = 0.25\n'
    )
    registry.convert("ros", tmp_path / "a.toml", tmp_path / "rec")
    records = read_log(tmp_path / "rec" / "a.groundtruth.mcap")
    assert np.allclose(
        [m.unpack_pose_in_frame(record.proto()) for record in records], path(FRAMES), atol=1e-6
    )
    assert str(tmp_path) not in (tmp_path / "rec" / "recording.json").read_text()
    with pytest.raises(DuagError, match="truth and truth_file are both said"):
        registry.convert("ros", tmp_path / "a.toml", tmp_path / "rec2", options=["truth=/odom"])


def test_robots_whose_frames_have_the_same_names(tmp_path: Path) -> None:
    """Two robots on one /tf_static tie the same frames differently: neither is used, their own topics are."""
    r = Ros(1)
    rows = scene(r)
    static = next(m for t, _, m in rows if t == "/tf_static")
    other = r.tf(r.transform(START_NS, "_depth", "_color", np.eye(4)))
    bag = r.write(tmp_path / "bag", [("/tf_static", START_NS, other), *rows], "plain")
    with pytest.raises(
        DuagError, match=r"does not tie them \(what changes is no extrinsic: _depth to _color\)"
    ):
        registry.convert("ros", bag, tmp_path / "rec")
    own = [("/camera/tf_static", START_NS, static), ("/tf_static", START_NS, other), *rows]
    bag = r.write(tmp_path / "own", own, "plain")
    registry.convert("ros", bag, tmp_path / "rec", options=["namespaces=/camera"])
