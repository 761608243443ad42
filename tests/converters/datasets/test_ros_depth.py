"""Depth of bags: which images are depth, how it is moved to the color camera, and what is no measurement."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters import registry
from duagc.converters.logs import open_log
from duagc.converters.logs.choice import Chooser
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import open_rgbd
from duagc.pipeline.recording.read import LogFile
from duagc.pipeline.recording.register_depth import register_depth
from tests.fixtures.box_room import path, render
from tests.fixtures.ros_bags import (
    COLOR,
    DEPTH,
    DISTORTION,
    FRAMES,
    SMALL,
    START_NS,
    STEP_NS,
    T_COLOR_DEPTH,
    Ros,
    scene,
    still,
)


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


def test_depth_in_another_encoding_is_named_with_it(tmp_path: Path) -> None:
    r = Ros(2)
    rows = [
        (t, ns, replace(m, encoding="16SC1") if t.endswith("depth_registered/image_raw") else m)
        for t, ns, m in still(r)
    ]
    with pytest.raises(
        DuagError, match=r"/image_raw has encoding '16SC1', none of 16UC1, mono16, 32FC1; expected --set"
    ):
        registry.convert("ros", r.write(tmp_path / "bag", rows, "mcap"), tmp_path / "rec")


def test_depth_of_sixteen_bits_is_told_by_its_name_from_infrared(tmp_path: Path) -> None:
    """RealSense's own software records depth as mono16, and infrared of 16 bits as 16UC1."""
    r, sensor = Ros(1), "/device_0/sensor_0"
    rows = still(r, ("/device_0/sensor_1/Color_0/image/data", "c"), (f"{sensor}/Infrared_1/image/data", "c"))
    units = np.full((SMALL.height, SMALL.width), 1500, np.uint16)
    at = [ns for topic, ns, _ in rows if "Infrared_1/image/data" in topic]
    rows += [(f"{sensor}/Depth_0/image/data", ns, r.image(ns, "c", units, "mono16")) for ns in at]
    with open_log([r.write(tmp_path / "bag", rows, "plain")]) as log:
        assert Chooser(log).depth().topic == f"{sensor}/Depth_0/image/data"


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


@pytest.mark.parametrize("kind", ["16UC1", "32FC1"])
def test_distances_along_the_ray_become_depth_along_z(tmp_path: Path, kind: str) -> None:
    """As if the camera had stated depth, to a unit; they are moved to the color camera like that."""
    r = Ros(2)
    found = []
    for along in ("z", "ray"):
        rows = []
        for topic, log_ns, message in scene(r):
            if "/depth/image" in topic:
                meters = render(DEPTH, path(FRAMES)[0])[1] * (DEPTH.ray_lengths() if along == "ray" else 1)
                units = np.rint(1000 * meters).astype(np.uint16)
                message = r.image(
                    log_ns, "_depth", units if kind == "16UC1" else meters.astype(np.float32), kind
                )
            rows.append((topic, log_ns, message))
        bag = r.write(tmp_path / along, rows, "mcap")
        registry.convert("ros", bag, tmp_path / f"{along}_rec", options=[f"depth_along={along}"])
        with open_rgbd(tmp_path / f"{along}_rec" / "alpha.mcap") as log:
            found.append(log.frame(0).depth)
    both = (found[0] > 0) & (found[1] > 0)
    assert both.mean() > 0.9 * (found[0] > 0).mean() > 0.3
    assert np.median(np.abs(found[0] - found[1])[both]) < 0.002
    assert np.percentile(np.abs(found[0] - found[1])[both], 95) < 0.01


def test_depth_that_needs_no_moving_keeps_its_numbers(tmp_path: Path) -> None:
    """To the last bit, in any unit, and beyond 32 m; only the largest number is none."""
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
    expected = np.where(pixels == 65535, 0, pixels)
    assert (pixels == 65535).any()
    found = [m.unpack_depth(record.proto(), "here") for record in records]
    np.testing.assert_array_equal(found, expected)


def test_depth_registered_to_color_without_distortion_has_the_camera_of_that(tmp_path: Path) -> None:
    """As drivers of OpenNI give it: raw color with K and D, depth of P, whose focal length is another."""
    r, straight = Ros(1), PinholeCamera(COLOR.width, COLOR.height, 120.0, 121.0, 80.5, 59.0)
    rows = []
    for topic, log_ns, message in scene(r):
        if topic.endswith("camera_info"):
            message = r.info(START_NS, "_color", COLOR, DISTORTION)
            message.P = np.array([straight.fx, 0, straight.cx, 0, 0, straight.fy, straight.cy, 0, 0, 0, 1, 0])
            topic = topic.replace("camera/depth", "camera/depth_registered/hw_registered")
        elif topic.endswith("image_rect_raw"):
            k = sum(t.endswith("image_rect") for t, _, _ in rows)
            raw = np.rint(render(straight, path(FRAMES)[k])[1] * 1000).astype(np.uint16)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            message = r.image(stamp, "_color", raw, "16UC1")
            topic = "/camera/depth_registered/hw_registered/image_rect"
        rows.append((topic, log_ns, message))
    registry.convert("ros", r.write(tmp_path / "bag", rows, "plain"), tmp_path / "rec")
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        assert log.camera == straight
        frame = log.frame(1)
    color, z = render(straight, path(FRAMES)[1])
    shown = frame.depth > 0  # where the color camera sees something
    assert shown.mean() > 0.6
    np.testing.assert_allclose(frame.depth[shown], (np.rint(z * 1000) / 1000)[shown], atol=1e-6)
    assert np.median(np.abs(frame.color[shown].astype(int) - color[shown])) < 6


def test_an_image_without_a_time_is_left_out(tmp_path: Path) -> None:
    r, rows = Ros(2), scene(Ros(2))
    first = next(message for topic, _, message in rows if topic.endswith("color/image_raw"))
    for name in ("sec", "nanosec"):
        object.__setattr__(first.header.stamp, name, 0)
    registry.convert("ros", r.write(tmp_path / "bag", rows, "sqlite3"), tmp_path / "rec")
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        assert log.pairing.pairs[0][0] > START_NS
    warnings = json.loads((tmp_path / "rec" / "recording.json").read_text())["warnings"]
    assert any("/camera/color/image_raw: 1 images without a time; left out" in text for text in warnings)


@pytest.mark.parametrize(
    ("options", "unit_m", "name"),
    [
        ([], 0.0001, "Depth Units"),
        ([], 0.0001, "Depth_Units"),
        (["depth_scale=0.002"], 0.002, "Depth Units"),
    ],
)
def test_the_unit_that_software_of_a_camera_states_counts(
    tmp_path: Path, options: list[str], unit_m: float, name: str
) -> None:
    """Not every RealSense counts millimeters; what the user says goes before it."""
    r, sensor = Ros(1), "/device_0/sensor_0"
    rows = still(r, ("/device_0/sensor_1/Color_0/image/data", "c"), (f"{sensor}/Depth_0/image/data", "c"))
    unit = r.make("std_msgs/msg/Float32", data=np.float32(0.0001))
    rows.insert(0, (f"{sensor}/option/{name}/value", START_NS, unit))
    registry.convert("ros", r.write(tmp_path / "bag", rows, "plain"), tmp_path / "rec", options=options)
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        np.testing.assert_allclose(np.unique(log.frame(0).depth), [1000 * unit_m, 2000 * unit_m], rtol=1e-6)
    unit = r.make("std_msgs/msg/Float32", data=np.float32(0))
    rows[0] = (rows[0][0], START_NS, unit)
    if not options:
        with pytest.raises(
            DuagError, match="Units/value is 0, expected meters per unit, or --set depth_scale="
        ):
            registry.convert("ros", r.write(tmp_path / "none", rows, "plain"), tmp_path / "rec2")


def test_depth_of_floats_in_millimeters_is_refused_or_taken_by_its_unit(tmp_path: Path) -> None:
    """Floats are meters by REP 118; as such nothing of these would be left."""
    r, logs = Ros(2), {}
    for per_m in (1, 1000):
        rows = []
        for topic, log_ns, message in still(r):
            if "depth_registered/image" in topic:
                units = np.frombuffer(bytes(message.data), np.uint16).reshape(48, 64)
                floats = np.where(units > 1000, units * np.float32(per_m / 1000), np.nan)
                message = r.image(log_ns, "c", floats.astype(np.float32), "32FC1")
            rows.append((topic, log_ns, message))
        logs[per_m] = r.write(tmp_path / str(per_m), rows, "mcap")
    with pytest.raises(DuagError, match=r"is 32FC1 from 2000 to 2000, expected meters, .* depth_scale=0.001"):
        registry.convert("ros", logs[1000], tmp_path / "none")
    for per_m, log in logs.items():  # meters stay meters
        registry.convert("ros", log, tmp_path / f"rec{per_m}", options=["depth_scale=0.001"])
        with open_rgbd(tmp_path / f"rec{per_m}" / "alpha.mcap") as found:
            np.testing.assert_allclose(np.unique(found.frame(0).depth), [0, 2])
