"""Bags of ROS 1 and ROS 2 made in the test, of every container and encoding, and real ones where they are."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from duagc.converters import registry
from duagc.converters.logs.frames import pose_matrix
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.recording import info, open_rgbd, read_log
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
    still,
)
from tests.fixtures.ros_clocks import moved_headers


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


def test_namespaces_of_robots_inside_another(tmp_path: Path) -> None:
    r = Ros(2)
    rows = scene(r, prefix="/fleet/jackal") + scene(r, prefix="/fleet/husky", poses=path(FRAMES, 0.2))
    bag = r.write(tmp_path / "bag", sorted(rows, key=lambda x: x[1]), "mcap")
    words = "namespaces=/fleet/husky,/fleet/jackal"
    with pytest.raises(DuagError, match=f"expected --set {words} if each"):
        registry.convert("ros", bag, tmp_path / "rec")
    registry.convert("ros", bag, tmp_path / "rec", options=[words])
    assert sorted(info(tmp_path / "rec")["robots"]) == ["fleet_husky", "fleet_jackal"]
    one = r.write(tmp_path / "one", scene(r, prefix="/fleet/jackal"), "mcap")
    registry.convert("ros", one, tmp_path / "alone")


def test_two_robots_in_one_bag_and_in_two(tmp_path: Path) -> None:
    r = Ros(2)
    both = sorted(
        scene(r, prefix="/jackal") + scene(r, prefix="/husky", poses=path(FRAMES, 0.2)), key=lambda x: x[1]
    )
    bag = r.write(tmp_path / "one", both, "mcap")
    with pytest.raises(
        DuagError, match=r"below /husky, /jackal, expected --set namespaces=/husky,/jackal if each"
    ):
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


@pytest.mark.parametrize("late", [(9,), tuple(range(9, 15))], ids=["one image", "a clock that was set back"])
def test_a_clock_that_was_set_back_is_refused(tmp_path: Path, late: tuple[int, ...]) -> None:
    """Its frames would be mixed with those of before; a single image that came late is not."""
    r, rows = Ros(1), []
    for topic, log_ns, message in still(r, frames=15):
        k = (log_ns - START_NS) // STEP_NS - 1
        if "image_raw" in topic and k in late:
            moved_headers(r, [(topic, log_ns, message)], -STEP_NS * 17 // 2)
        rows.append((topic, log_ns, message))
    bag = r.write(tmp_path / "bag", rows, "plain")
    if len(late) == 1:
        registry.convert("ros", bag, tmp_path / "rec")
        return
    with pytest.raises(DuagError, match=r"times go back by 0\.375 s to 1700000000\.075 s, .*time_source=log"):
        registry.convert("ros", bag, tmp_path / "rec")
    registry.convert("ros", bag, tmp_path / "rec", options=["time_source=log"])


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


@pytest.mark.skipif(not REAL.is_dir(), reason="the real bags are not there")
def test_a_real_bag_converts_when_told_that_times_differ(tmp_path: Path) -> None:
    """Color and depth are 100 ms apart; the extrinsics are those that the camera's own software recorded."""
    source = REAL / "realsense_single_depth_color.bag"
    registry.convert("ros", source, tmp_path / "rec", options=["association=nearest", "max_difference_s=0.2"])
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        frame = log.frame(0)
        assert (log.camera.width, log.camera.height) == (640, 480)
    assert 0.2 < (frame.depth > 0).mean() < 1
    assert 0.2 < np.median(frame.depth[frame.depth > 0]) < 5


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


def test_two_robots_state_the_same_frames_on_topics_of_their_own(tmp_path: Path) -> None:
    """Without a namespace nobody knows whose frames are meant; which topic came last decided."""
    r = Ros(1)
    rows = scene(r)
    static = next(m for t, _, m in rows if t == "/tf_static")
    other = r.tf(r.transform(START_NS, "_depth", "_color", np.eye(4)))
    rest = [row for row in rows if row[0] != "/tf_static"]
    words = r"does not tie them \(what changes is no extrinsic: _depth to _color\)"
    for k, shared in enumerate(([], [("/tf_static", START_NS, static)])):
        own = [("/a/tf_static", START_NS, static), ("/b/tf_static", START_NS, other), *shared, *rest]
        bag = r.write(tmp_path / f"bag{k}", own, "plain")
        with pytest.raises(DuagError, match=words):
            registry.convert("ros", bag, tmp_path / "rec")


def test_poses_of_nobody_knows_which_body_are_no_odometry(tmp_path: Path) -> None:
    """The base of a robot looks along x, its camera along z."""
    r, rows = Ros(2), scene(Ros(2))
    for topic, _, message in rows:
        if topic == "/odom":
            object.__setattr__(message, "child_frame_id", "")
    bag = r.write(tmp_path / "bag", rows, "sqlite3")
    with pytest.raises(
        DuagError, match="messages of odometry name no body frame, expected --set T_odometry_color="
    ):
        registry.convert("ros", bag, tmp_path / "rec", options=["odometry=/odom"])
    stated = ["odometry=/odom", "T_odometry_color=0 0 0 1 0 0 0"]
    registry.convert("ros", bag, tmp_path / "rec", options=stated)
