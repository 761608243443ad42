"""MCAP of other programs: the same scene in every encoding gives the same recording, message for message."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType

from duagc.converters import registry
from duagc.converters.logs import open_log
from duagc.converters.robot_writer import RobotWriter
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.checks.check import check
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens
from duagc.pipeline.recording import open_rgbd, read_log
from tests.fixtures.foreign_mcap import Row, digests, raw_log, write
from tests.fixtures.ros_bags import Ros, scene


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Digests of the recording made from a bag of ROS 1."""
    folder, r = tmp_path_factory.mktemp("bag"), Ros(1)
    bag = r.write(folder / "bag", scene(r), "plain")
    registry.convert("ros", bag, folder / "rec", options=["truth=/odom"])
    return digests(folder / "rec")


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("ros1", {}),
        ("cdr", {"compression": CompressionType.LZ4}),
        ("protobuf", {}),
        ("protobuf", {"compression": CompressionType.NONE}),
        ("protobuf", {"index_types": IndexType.NONE}),
        ("protobuf", {"use_chunking": False}),
        ("json", {"compression": CompressionType.LZ4, "index_types": IndexType.NONE}),
        ("json", {}),
        ("rosbridge", {}),
        ("rosbridge1", {"index_types": IndexType.NONE}),
    ],
    ids=lambda v: v if isinstance(v, str) else "-".join(f"{k}={getattr(x, 'name', x)}" for k, x in v.items()),
)
def test_every_encoding_gives_the_same_recording(
    tmp_path: Path, expected: dict[str, str], kind: str, settings: dict[str, Any]
) -> None:
    r = Ros(1 if kind.endswith("1") else 2)
    kind = "rosbridge" if kind == "rosbridge1" else kind
    log = write(tmp_path / "log.mcap", scene(r), kind, r, **settings)
    registry.convert("ros", log, tmp_path / "rec", options=["truth=/odom"])
    assert digests(tmp_path / "rec") == expected
    report = check(tmp_path / "rec")
    assert report.sound, report.findings


def test_a_log_without_an_index_may_be_read_twice_at_a_time(tmp_path: Path) -> None:
    """As when the first true pose is looked up while images are converted."""
    r = Ros(2)
    path = write(tmp_path / "log.mcap", scene(r), "protobuf", r, use_chunking=False)
    with open_log([path]) as log:
        topics = list(log.topics)
        alone = [(entry.topic, entry.log_ns) for topic in topics for entry in log.entries(topic)]
        together = []
        for topic in topics:
            for entry, other in zip(log.entries(topic), log.entries(topic), strict=True):
                assert (entry.topic, entry.log_ns) == (other.topic, other.log_ns)
                together.append((entry.topic, entry.log_ns))
    assert together == alone


def test_pieces_of_a_log_are_one_log(tmp_path: Path, expected: dict[str, str]) -> None:
    """Cut in time, in containers of different kinds, in the order of their numbers: the same recording."""
    r, r1 = Ros(2), Ros(1)
    rows, rows1 = scene(r), scene(r1)
    write(tmp_path / "src" / "jackal" / "part_2.mcap", rows[:8], "cdr", r)
    write(tmp_path / "src" / "jackal" / "part_10.mcap", rows[8:11], "json", r)
    r1.write(tmp_path / "src" / "jackal" / "part_11", rows1[11:], "lz4")
    registry.convert(
        "ros", tmp_path / "src" / "jackal", tmp_path / "rec", options=["truth=/odom", "pieces=true"]
    )
    assert digests(tmp_path / "rec") == expected
    registry.convert("ros", tmp_path / "src", tmp_path / "rec2", options=["truth=/odom"])
    assert digests(tmp_path / "rec2") == expected


def test_transforms_that_never_change_are_extrinsics(tmp_path: Path, expected: dict[str, str]) -> None:
    """Foxglove's logs have no tf_static: what is repeated without change ties the cameras, what moves does not."""
    r = Ros(2)
    rows = scene(r)
    (static,) = [m for t, _, m in rows if t == "/tf_static"]
    repeated = [("/tf", ns, static) for t, ns, _ in rows if t == "/odom"]
    others = [row for row in rows if row[0] != "/tf_static"]
    log = write(tmp_path / "log.mcap", sorted(others + repeated, key=lambda x: x[1]), "protobuf", r)
    registry.convert("ros", log, tmp_path / "rec", options=["truth=/odom"])
    assert digests(tmp_path / "rec") == expected
    T_moved = se3.from_rotation_translation(np.eye(3), [0.01, 0.0, 0.0])
    moved = ("/tf", repeated[-1][1] + 1, r.tf(r.transform(1, "_depth", "_color", T_moved)))
    path = write(
        tmp_path / "moving.mcap", sorted([*others, *repeated, moved], key=lambda x: x[1]), "protobuf", r
    )
    with pytest.raises(DuagError, match="does not tie them"):
        registry.convert("ros", path, tmp_path / "rec3")


@pytest.mark.parametrize("distortion", [(), (-0.3, 0.1, 0.0, 0.0, 0.0)])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.03, -0.02, 0.05)])
def test_a_log_of_ours_with_a_lens_is_read_as_it_is(
    tmp_path: Path, turn: tuple[float, float, float], distortion: tuple[float, ...]
) -> None:
    """Its color has the distortion, its depth has none and a unit: registered depth of others has that of color."""
    camera = PinholeCamera(64, 48, 50.0, 51.0, 31.0, 23.0)
    lens = Lens(PinholeCamera(64, 48, 52.0, 50.0, 32.0, 24.0), distortion, rotation_rad=turn)
    (tmp_path / "ours").mkdir()
    rng = np.random.default_rng(0)
    with RobotWriter(tmp_path / "ours", "alpha", camera, 0.0002, find_regions=False) as robot:
        robot.set_lens(lens)
        for k in range(1, 5):
            png = cv2.imencode(".png", rng.integers(0, 256, (48, 64, 3), dtype=np.uint8))[1].tobytes()
            robot.add_frame(k * 10**8, png, "png", rng.integers(500, 4000, (48, 64), dtype=np.uint16))
    registry.convert("ros", tmp_path / "ours" / "alpha.mcap", tmp_path / "rec")
    with (
        open_rgbd(tmp_path / "ours" / "alpha.mcap") as ours,
        open_rgbd(tmp_path / "rec" / "alpha.mcap") as again,
    ):
        assert again.camera == ours.camera
        assert len(again) == len(ours)
        for before, after in zip(ours.frames(), again.frames(), strict=True):
            assert np.array_equal(before.depth, after.depth)
            assert np.array_equal(before.color, after.color)


def test_times_of_publication(tmp_path: Path) -> None:
    r = Ros(2)
    log = write(tmp_path / "log.mcap", scene(r), "json", r)
    registry.convert("ros", log, tmp_path / "rec", options=["time_source=publish"])
    row = json.loads((tmp_path / "rec" / "recording.json").read_text())["robots"]["alpha"]
    first = next(ns for topic, ns, _ in scene(r) if topic == "/camera/color/image_raw")
    assert row["start_ns"] == first - 1_000_000
    bag = r.write(tmp_path / "bag", scene(r), "sqlite3")
    with pytest.raises(DuagError, match="no times of publication"):
        registry.convert("ros", bag, tmp_path / "rec2", options=["time_source=publish"])


def test_compressed_images_of_foxglove(tmp_path: Path) -> None:
    """JPEG color keeps its bytes; a gray PNG of 16 bits is depth, whatever its format says."""
    r, rows = Ros(2), []
    jpegs = []
    for topic, ns, m in scene(r):
        if topic.endswith("image_raw"):
            pixels = (
                np.asarray(m.data).reshape(m.height, m.step)[:, : 3 * m.width].reshape(m.height, m.width, 3)
            )
            jpegs.append(cv2.imencode(".jpg", pixels[..., ::-1])[1].tobytes())
            m = r.compressed(m.header.stamp.sec * 10**9 + m.header.stamp.nanosec, "_color", jpegs[-1], "jpeg")
        elif topic.endswith("image_rect_raw"):
            kind = ">u2" if m.is_bigendian else "<u2"
            raw = np.ascontiguousarray(np.asarray(m.data).reshape(m.height, m.step)[:, : 2 * m.width]).view(
                kind
            )
            png = cv2.imencode(".png", raw.astype(np.uint16))[1].tobytes()
            m = r.compressed(m.header.stamp.sec * 10**9 + m.header.stamp.nanosec, "_depth", png, "png")
        rows.append((topic, ns, m))
    log = write(tmp_path / "log.mcap", rows, "protobuf", r)
    registry.convert("ros", log, tmp_path / "rec")
    colors = [
        record.proto().data for record in read_log(tmp_path / "rec" / "alpha.mcap", ["/alpha/camera/color"])
    ]
    assert colors == jpegs


def test_definitions_that_are_missing_are_those_of_ros(tmp_path: Path) -> None:
    r = Ros(2)
    message = r.header(5, "camera")
    data = bytes(r.store.serialize_cdr(message, message.__msgtype__))
    path = raw_log(tmp_path / "log.mcap", "/h", ("std_msgs/msg/Header", "", b""), data)
    with open_log([path]) as log:
        assert log.first("/h").frame_id == "camera"


def test_definitions_in_idl(tmp_path: Path) -> None:
    """Two types, the inner one in a part of its own, as recorders of ROS 2 write them."""
    inner = "module demo { module msg { struct Inner { long value; }; }; };"
    struct_outer = "struct Outer { demo::msg::Inner inner; string name; };"
    outer = f'#include "demo/msg/Inner.idl"\nmodule demo {{ module msg {{ {struct_outer} }}; }};'
    line = "=" * 80 + "\n"
    for text in (
        f"{line}IDL: demo/msg/Outer\n{outer}\n{line}IDL: demo/msg/Inner\n{inner}\n",
        f"{inner}\n{outer}",
    ):
        data = b"\x00\x01\x00\x00" + struct.pack("<iI", 42, 6) + b"hello\x00"
        path = raw_log(tmp_path / "log.mcap", "/o", ("demo/msg/Outer", "ros2idl", text.encode()), data)
        with open_log([path]) as log:
            assert (log.first("/o").inner.value, log.first("/o").name) == (42, "hello")


KITCHEN = Path(__file__).parents[4] / "shared" / "data" / "redkitchen"


@pytest.mark.skipif(not KITCHEN.is_dir(), reason="the real images are not there")
def test_real_images_in_a_log_are_those_of_the_dataset(tmp_path: Path) -> None:
    """RedKitchen as a log of Foxglove's: the same colors, and depth as 7-Scenes' own converter registers it."""
    color = PinholeCamera(640, 480, 525, 525, 320, 237.8)
    depth = PinholeCamera(640, 480, 585, 585, 320, 240)
    r, start = Ros(2), 10**18
    T_color_depth = se3.from_rotation_translation(np.eye(3), [-0.025, 0.0, 0.0])
    rows: list[Row] = [
        ("/color/camera_info", start, r.info(start, "color", color)),
        ("/depth/camera_info", start, r.info(start, "depth", depth)),
        ("/tf", start, r.tf(r.transform(start, "color", "depth", T_color_depth))),
    ]
    (tmp_path / "seq").mkdir()
    for k, path in enumerate(sorted(KITCHEN.glob("*.color.*"))[:3]):
        at, stem = start + k * 10**9 // 30, path.name.split(".")[0]
        for file in KITCHEN.glob(f"{stem}.*"):
            (tmp_path / "seq" / file.name).symlink_to(file)
        raw = cv2.imread(str(KITCHEN / f"{stem}.depth.png"), cv2.IMREAD_UNCHANGED)
        rows.append(("/color/image", at, r.compressed(at, "color", path.read_bytes(), "jpeg")))
        rows.append(
            (
                "/depth/image",
                at,
                r.image(at, "depth", np.where(raw == 65535, 0, raw).astype(np.uint16), "16UC1"),
            )
        )
    log = write(tmp_path / "log.mcap", rows, "protobuf", r)
    registry.convert("ros", log, tmp_path / "log_rec")
    registry.convert("7scenes", tmp_path / "seq", tmp_path / "own_rec")
    with (
        open_rgbd(tmp_path / "log_rec" / "alpha.mcap") as a,
        open_rgbd(tmp_path / "own_rec" / "alpha.mcap") as b,
    ):
        for i in range(3):
            assert np.array_equal(a.frame(i).color, b.frame(i).color)
            ours, theirs = a.frame(i).depth, b.frame(i).depth
            both = (ours > 0) & (theirs > 0)
            assert both.mean() > 0.7
            assert np.percentile(np.abs(ours - theirs)[both] / theirs[both], 95) < 0.002


def test_webp_comes_out_as_png(tmp_path: Path) -> None:
    """Color as WebP without loss gives the pixels; one that is cut short is left out and reported."""
    r, rows, pixels = Ros(2), [], []
    for topic, ns, m in scene(r):
        if topic.endswith("color/image_raw"):
            image = (
                np.asarray(m.data).reshape(m.height, m.step)[:, : 3 * m.width].reshape(m.height, m.width, 3)
            )
            pixels.append(image)
            webp = cv2.imencode(".webp", image[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
            webp = webp[:-40] if len(pixels) == 2 else webp
            stamp = m.header.stamp.sec * 10**9 + m.header.stamp.nanosec
            rows.append((f"{topic}/compressed", ns, r.compressed(stamp, m.header.frame_id, webp, "webp")))
        else:
            rows.append((topic, ns, m))
    log = write(tmp_path / "log.mcap", rows, "cdr", r)
    registry.convert("ros", log, tmp_path / "rec", options=["undistort=false"])
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as found:
        kept = [p for k, p in enumerate(pixels) if k != 1]
        assert len(found) == len(kept)
        assert all(np.array_equal(f.color, p) for f, p in zip(found.frames(), kept, strict=True))
    warnings = json.loads((tmp_path / "rec" / "recording.json").read_text())["warnings"]
    assert any("1 frames have color or depth that is cut short" in text for text in warnings)
