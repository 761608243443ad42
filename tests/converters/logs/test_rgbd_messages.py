"""Messages that hold color, depth and cameras at once give the same recording as topics of their own."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from duagc.converters import registry
from duagc.converters.logs import open_log
from duagc.converters.logs.describe import describe
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.recording import open_rgbd
from tests.fixtures.foreign_mcap import Row, write
from tests.fixtures.ros_bags import COLOR, DEPTH, DISTORTION, FRAMES, Ros, scene

BOTH = """std_msgs/Header header
sensor_msgs/CameraInfo rgb_camera_info
sensor_msgs/CameraInfo depth_camera_info
sensor_msgs/Image rgb
sensor_msgs/Image depth
"""
COMPRESSED = """sensor_msgs/CompressedImage rgb_compressed
sensor_msgs/CompressedImage depth_compressed
"""
FEATURES = """KeyPoint[] key_points
Point3f[] points
uint8[] descriptors
GlobalDescriptor global_descriptor
"""
PARTS = {
    "Point2f": "float32 x\nfloat32 y\n",
    "Point3f": "float32 x\nfloat32 y\nfloat32 z\n",
    "KeyPoint": "Point2f pt\nfloat32 size\nfloat32 angle\nfloat32 response\nint32 octave\nint32 class_id\n",
    "GlobalDescriptor": "std_msgs/Header header\nint32 type\nuint8[] info\nuint8[] data\n",
}
IMAGES = "/camera/color/image_raw", "/camera/depth/image_rect_raw"


def realsense(r: Ros, **values: Any) -> Any:
    """A message of RealSense's driver."""
    kind = "realsense2_camera_msgs/msg/RGBD"
    if kind not in r.store.types:
        r.store.register(get_types_from_msg(BOTH, kind))
    return r.make(kind, **values)


def rtabmap(r: Ros, package: str = "rtabmap_msgs", **values: Any) -> Any:
    """A message of RTAB-Map with one feature; images that are not given are empty."""
    kind = f"{package}/msg/RGBDImage"
    if kind not in r.store.types:
        for name, text in PARTS.items():
            r.store.register(get_types_from_msg(text, f"{package}/msg/{name}"))
        r.store.register(get_types_from_msg(BOTH + COMPRESSED + FEATURES, kind))
    header = values["header"]
    raw = r.make(
        "sensor_msgs/msg/Image",
        header=header,
        height=0,
        width=0,
        encoding="",
        is_bigendian=0,
        step=0,
        data=np.zeros(0, np.uint8),
    )
    packed = r.make("sensor_msgs/msg/CompressedImage", header=header, format="", data=np.zeros(0, np.uint8))
    point = r.make(f"{package}/msg/Point2f", x=3.0, y=4.0)
    feature = r.make(
        f"{package}/msg/KeyPoint", pt=point, size=1.0, angle=0.0, response=1.0, octave=0, class_id=-1
    )
    none = r.make(
        f"{package}/msg/GlobalDescriptor",
        header=header,
        type=0,
        info=np.zeros(0, np.uint8),
        data=np.zeros(0, np.uint8),
    )
    empty = {"rgb": raw, "depth": raw, "rgb_compressed": packed, "depth_compressed": packed}
    rest = {"key_points": [feature], "points": [], "descriptors": np.zeros(7, np.uint8)}
    return r.make(kind, **{**empty, **rest, "global_descriptor": none, **values})


def pixels(image: Any) -> np.ndarray:
    """Of a raw image of 8-bit color or 16-bit depth, in native order."""
    channels, dtype = (3, np.dtype(np.uint8)) if image.encoding == "rgb8" else (1, np.dtype("<u2"))
    dtype = dtype.newbyteorder(">") if image.is_bigendian else dtype
    rows = np.asarray(image.data).reshape(image.height, image.step)
    rows = np.ascontiguousarray(rows[:, : image.width * channels * dtype.itemsize]).view(dtype)
    return rows.reshape(image.height, image.width, channels).squeeze().astype(dtype.newbyteorder("="))


def together(r: Ros, rows: list[Row], form: str) -> list[Row]:
    """The same log with one message for both images and cameras."""
    found = [row for row in rows if "/camera/" not in row[0]]
    infos = r.info(0, "_color", COLOR, DISTORTION), r.info(0, "_depth", DEPTH)
    images = [[row for row in rows if row[0] == topic] for topic in IMAGES]
    for (_, _, color), (_, log_ns, depth) in zip(*images, strict=True):
        for info, image in zip(infos, (color, depth), strict=True):
            info.header = image.header
        values: dict[str, Any] = {"header": color.header}
        values |= {"rgb_camera_info": infos[0], "depth_camera_info": infos[1]}
        if form == "raw" or form == "realsense":
            values |= {"rgb": color, "depth": depth}
        else:
            stamp = color.header.stamp.sec * 10**9 + color.header.stamp.nanosec
            late = depth.header.stamp.sec * 10**9 + depth.header.stamp.nanosec
            shown = cv2.imencode(".png", pixels(color)[..., ::-1])[1].tobytes()
            values["rgb_compressed"] = r.compressed(stamp, color.header.frame_id, shown, "png")
            z = pixels(depth)
            if form == "floats":  # as RTAB-Map compresses them: four bytes a pixel
                z = np.ascontiguousarray(z.astype(np.float32) / 1000).view(np.uint8).reshape(*z.shape, 4)
            data = cv2.imencode(".png", z)[1].tobytes()
            values["depth_compressed"] = r.compressed(late, depth.header.frame_id, data, "png")
        package = {"package": "rtabmap_ros"} if r.version == 1 else {}
        make = realsense if form == "realsense" else rtabmap
        found.append(("/camera/rgbd", log_ns, make(r, **(package if make is rtabmap else {}), **values)))
    return found


def without_definitions(folder: Path) -> None:
    """Make a bag of ROS 2 one of Humble, which holds no definitions."""
    with closing(sqlite3.connect(next(folder.glob("*.db3")))) as database, database:
        database.execute("DROP TABLE message_definitions")
        database.execute("UPDATE schema SET schema_version = 3, ros_distro = 'humble'")


def as_rectified(rows: list[Row]) -> list[Row]:
    """The same log with images that are named so."""
    return [(topic.replace("/image_raw", "/image_rect_color"), log_ns, m) for topic, log_ns, m in rows]


def with_floats(r: Ros, rows: list[Row]) -> list[Row]:
    """The same log with depth in meters."""
    found = []
    for topic, log_ns, m in rows:
        if topic == IMAGES[1]:
            stamp = m.header.stamp.sec * 10**9 + m.header.stamp.nanosec
            m = r.image(stamp, m.header.frame_id, pixels(m).astype(np.float32) / 1000, "32FC1")
        found.append((topic, log_ns, m))
    return found


def assert_same(found: Path, wanted: Path) -> None:
    with open_rgbd(found / "alpha.mcap") as a, open_rgbd(wanted / "alpha.mcap") as b:
        assert len(a) == len(b) == FRAMES
        assert a.camera == b.camera
        for index in range(FRAMES):
            frame, same = a.frame(index), b.frame(index)
            assert frame.stamp_ns == same.stamp_ns
            np.testing.assert_array_equal(frame.color, same.color)
            np.testing.assert_array_equal(frame.depth, same.depth)
            assert (frame.depth > 0).mean() > 0.5


@pytest.mark.parametrize(
    ("version", "container", "form"),
    [
        (1, "plain", "raw"),
        (1, "lz4", "compressed"),
        (2, "sqlite3", "realsense"),
        (2, "humble", "realsense"),
        (2, "humble", "compressed"),
        (2, "mcap", "raw"),
        (2, "cdr", "floats"),
    ],
)
def test_the_recording_is_that_of_separate_topics(
    tmp_path: Path, version: int, container: str, form: str
) -> None:
    r = Ros(version)
    rows = scene(r)
    alone = with_floats(r, rows) if form == "floats" else rows
    plain = r.write(tmp_path / "plain", alone if form == "realsense" else as_rectified(alone), "plain")
    registry.convert("ros", plain, tmp_path / "wanted", options=["truth=/odom"])
    if container == "cdr":
        log = write(tmp_path / "log.mcap", together(r, rows, form), "cdr", r)
    else:
        log = r.write(tmp_path / "log", together(r, rows, form), container)
        if container == "humble":
            without_definitions(log)
    registry.convert("ros", log, tmp_path / "found", options=["truth=/odom"])
    assert_same(tmp_path / "found", tmp_path / "wanted")


def test_topics_of_their_own_count_before_them(tmp_path: Path) -> None:
    r = Ros(2)
    rows = scene(r)
    held = [row for row in together(r, rows, "raw") if row[0] == "/camera/rgbd"]
    both = rows + held + [("/rtabmap/rgbd_image", log_ns, m) for _, log_ns, m in held]
    log = write(tmp_path / "log.mcap", both, "cdr", r)
    [robot] = describe(log)["robots"].values()
    assert {k: c["topic"] for k, c in robot["choices"].items()} == {
        "color": IMAGES[0],
        "depth": IMAGES[1],
        "color_info": "/camera/color/camera_info",
        "depth_info": "/camera/depth/camera_info",
    }
    registry.convert("ros", log, tmp_path / "rec", options=["truth=/odom"])


def test_a_log_lists_what_the_messages_hold(tmp_path: Path) -> None:
    r = Ros(2)
    rows = together(r, scene(r), "compressed")
    with open_log([write(tmp_path / "log.mcap", rows, "cdr", r)]) as log:
        added = sorted(name for name in log.topics if name.startswith("/camera/rgbd/"))
        assert added == [
            "/camera/rgbd/depth/camera_info",
            "/camera/rgbd/depth/image_rect/compressed",
            "/camera/rgbd/rgb/camera_info",
            "/camera/rgbd/rgb/image_rect/compressed",
        ]
        assert {log.topics[name].count for name in added} == {FRAMES}
        entries = list(log.entries(*added, "/camera/rgbd", heads=added))
        assert len(entries) == 5 * FRAMES
        stamps = {e.topic: e.header_ns() for e in entries}
        assert stamps[added[1]] - stamps[added[3]] == 3_000_000  # each as its own header says


def test_a_message_that_cannot_be_read_says_why(tmp_path: Path) -> None:
    r = Ros(2)
    log = r.write(tmp_path / "log", together(r, scene(r), "realsense"), "sqlite3")
    without_definitions(log)
    with closing(sqlite3.connect(next(log.glob("*.db3")))) as database, database:
        database.execute("UPDATE messages SET data = X'00010000' WHERE length(data) > 20000")
    with pytest.raises(
        DuagError, match=r"found no topic of images.*; .*/camera/rgbd holds 4 bytes that are no "
    ):
        registry.convert("ros", log, tmp_path / "found")
