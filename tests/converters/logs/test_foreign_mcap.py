"""MCAP of other programs: the same scene in every encoding gives the same recording, message for message."""

from __future__ import annotations

import base64
import json
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer

from duagc import schemas
from duagc.converters import registry
from duagc.converters.logs import open_log, ros_json
from duagc.converters.logs.foxglove import JsonFields, as_ros
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.checks.check import check
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import open_rgbd, read_log
from tests.fixtures.foreign_mcap import Row, as_rosbridge, digests, encoded, foxglove, write
from tests.fixtures.ros_bags import COLOR, DISTORTION, Ros, scene


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
    registry.convert("ros", log, tmp_path / "rec", options=["undistort=false"])
    colors = [
        record.proto().data for record in read_log(tmp_path / "rec" / "alpha.mcap", ["/alpha/camera/color"])
    ]
    assert colors == jpegs


def spoil(path: Path, change: Callable[[bytes], bytes]) -> None:
    path.write_bytes(change(path.read_bytes()))


def test_broken_files_are_errors(tmp_path: Path) -> None:
    r = Ros(2)
    log = write(tmp_path / "log.mcap", scene(r), "protobuf", r)
    data = log.read_bytes()
    for name, broken, message in (
        ("cut", data[: len(data) // 2], "cut short or no MCAP"),
        ("empty", b"", "cut short or no MCAP"),
        ("flipped", data[:5000] + bytes([data[5000] ^ 4]) + data[5001:], "expected a sound MCAP log"),
    ):
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(broken)
        with pytest.raises(DuagError, match=message):
            registry.convert("ros", path, tmp_path / "rec")
        assert not (tmp_path / "rec").exists()


def test_messages_that_do_not_fit_their_schema_are_errors(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    for kind, data, message in (
        (
            "json",
            b'{"timestamp": {"sec": 1, "nsec": 2}, "frame_id": "c", "data": "!"}',
            "foxglove.CompressedImage that cannot be read",
        ),
        ("json", b"[1, 2]", "cannot be read"),
        ("json", b"{", "no foxglove.CompressedImage in json"),
        ("protobuf", b"\xff\xff", "no foxglove.CompressedImage in protobuf"),
    ):
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            schema = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
            writer.add_message(writer.register_channel("/image", kind, schema), 5, data, 5)
            writer.finish()
        with pytest.raises(DuagError, match=message):
            registry.convert("ros", path, tmp_path / "rec")
    assert base64.b64decode("!") == b""  # what a lenient decoder would have made of the first


def test_a_camera_that_changes_is_refused(tmp_path: Path) -> None:
    """As of a telephone that focuses: by a tenth of a pixel it may, by more not."""
    r = Ros(2)
    rows = scene(r)
    info = next(m for t, _, m in rows if t == "/camera/color/camera_info")
    for by, kind in ((0.1, "cdr"), (0.1, "protobuf"), (3.0, "cdr"), (3.0, "json")):
        camera = PinholeCamera(COLOR.width, COLOR.height, COLOR.fx + by, COLOR.fy, COLOR.cx, COLOR.cy)
        later = (
            "/camera/color/camera_info",
            rows[-1][1] + 1,
            r.info(rows[-1][1], info.header.frame_id, camera, DISTORTION),
        )
        log = write(tmp_path / "log.mcap", [*rows, later], kind, r)
        if by < 1:
            registry.convert("ros", log, tmp_path / f"rec_{kind}")
            continue
        with pytest.raises(DuagError, match=r"camera_info changes at .* from .*\[140.0, .*\[143.0"):
            registry.convert("ros", log, tmp_path / "rec")


def raw_log(path: Path, topic: str, schema: tuple[str, str, bytes], data: bytes) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        channel = writer.register_channel(topic, "cdr", writer.register_schema(*schema))
        writer.add_message(channel, 7, data, 7)
        writer.finish()
    return path


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


@pytest.mark.parametrize(
    ("log_ns", "stamp_ns", "message"),
    [
        (2**64 - 1, 5, "time 18446744073709551615 ns"),
        (7, -(10**9), "time -1000000000 ns"),
        (7, 2**62, "time 46"),
    ],
)
def test_times_that_cannot_be_are_refused(tmp_path: Path, log_ns: int, stamp_ns: int, message: str) -> None:
    r = Ros(2)
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, _, ros in scene(r):
            proto = foxglove(ros)
            if topic == "/camera/color/image_raw":
                proto.timestamp.seconds, proto.timestamp.nanos = divmod(stamp_ns, 10**9)
            name = proto.DESCRIPTOR.full_name
            schema = writer.register_schema(name, "protobuf", schemas.descriptor_set(name))
            writer.add_message(
                writer.register_channel(topic, "protobuf", schema), log_ns, proto.SerializeToString(), 7
            )
        writer.finish()
    with pytest.raises(DuagError, match=message):
        registry.convert("ros", path, tmp_path / "rec")


@pytest.mark.parametrize("data", [2_147_483_647, True, None, {"a": 1}])
def test_image_data_of_json_that_is_no_text_is_refused(data: Any) -> None:
    """A number would become as many zeros."""
    time = {"sec": 1, "nsec": 2}
    members = {"timestamp": time, "frame_id": "c", "width": 1, "height": 1, "encoding": "mono8", "step": 1}
    with pytest.raises(DuagError, match="that cannot be read"):
        as_ros("foxglove.RawImage", JsonFields({**members, "data": data}), "here")


def test_definitions_that_are_not_those_of_ros_are_refused(tmp_path: Path) -> None:
    """A name that is another, also by its case alone; a type that is another."""
    r = Ros(2)
    info = next(m for t, _, m in scene(r) if t.endswith("camera_info"))
    name, encoding, text, data = encoded(info, "cdr", r)
    for ours, theirs, field in (
        (b"binning_x", b"binnimg_x", "binning_x"),
        (b"distortion_model", b"distortion_Model", "distortion_model"),
        (b"uint32 width", b"uint16 width", "width"),
    ):
        path = raw_log(tmp_path / "log.mcap", "/i", (name, encoding, text.replace(ours, theirs)), data)
        message = f"its sensor_msgs/msg/(CameraInfo|RegionOfInterest) has no field {field}"
        with open_log([path]) as log, pytest.raises(DuagError, match=message):
            log.first("/i")


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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.pop("step"), "has no step"),
        (lambda m: m.update(height="12"), "height is '12', expected a number"),
        (lambda m: m.update(encoding=5), "encoding is 5, expected text"),
        (lambda m: m.update(data="###"), "no sensor_msgs/msg/Image in json"),
        (lambda m: m.update(data=[1, 2, 300]), "data holds a number that is no uint8"),
        (lambda m: m.update(header=[]), "is list, expected an object"),
        (lambda m: m.update(data={"a": 1}), "data is dict, expected a list"),
    ],
)
def test_broken_json_of_ros_is_one_line(change: Callable[[dict[str, Any]], Any], words: str) -> None:
    r = Ros(2)
    members = as_rosbridge(next(m for t, _, m in scene(r) if t.endswith("color/image_raw")), False)
    change(members)
    with pytest.raises(DuagError, match=re.escape(words)) as caught:
        ros_json.read("sensor_msgs/msg/Image", json.dumps(members).encode(), "log.mcap: /image")
    assert str(caught.value).startswith("log.mcap: /image")
    assert "\n" not in str(caught.value)


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


@pytest.mark.parametrize("others", [True, False])
def test_video_is_refused_by_its_name(tmp_path: Path, others: bool) -> None:
    r = Ros(2)
    path = tmp_path / "log.mcap"
    rows = [row for row in scene(r) if others and not row[0].endswith("color/image_raw")]
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedVideo", "protobuf", b"")
        writer.add_message(writer.register_channel("/cam/video", "protobuf", schema), 1, b"x", 1)
        for topic, log_ns, message in rows:
            name, encoding, text, data = encoded(message, "cdr", r)
            number = writer.register_channel(topic, "cdr", writer.register_schema(name, encoding, text))
            writer.add_message(number, log_ns, data, log_ns)
        writer.finish()
    with pytest.raises(
        DuagError, match=r"/cam/video \(foxglove.CompressedVideo\) is video, which is not read"
    ):
        registry.convert("ros", path, tmp_path / "rec")
