"""MCAP of other programs that is broken or cannot be read is refused with the reason."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from duagc import schemas
from duagc.converters import registry
from duagc.converters.logs import open_log, ros_json
from duagc.converters.logs.foxglove import JsonFields, as_ros
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera
from tests.fixtures.foreign_mcap import as_rosbridge, encoded, foxglove, raw_log, write
from tests.fixtures.ros_bags import COLOR, DISTORTION, Ros, scene


def test_broken_files_are_errors(tmp_path: Path) -> None:
    r = Ros(2)
    log = write(tmp_path / "log.mcap", scene(r), "protobuf", r)
    data = log.read_bytes()
    for name, broken, message in (
        ("cut", data[: len(data) // 2], "is cut short; what it holds can be saved with `duagc recover`"),
        ("headless", data[100:], "expected a sound MCAP log"),
        ("empty", b"", "is no MCAP, expected a sound MCAP log"),
        ("text", b"not a log at all" * 10, "is no MCAP, expected a sound MCAP log"),
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
