"""One image of a log that is empty, cut short or broken costs itself, wherever it stands."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from duagc.converters import registry
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.recording import open_rgbd
from tests.fixtures.ros_bags import FRAMES, SMALL, START_NS, STEP_NS, Ros, still

COLOR, DEPTH = "/camera/color/image_raw", "/camera/depth_registered/image_raw"
HEAD = bytes(12)


def jpeg() -> bytes:
    pixels = np.random.default_rng(1).integers(0, 255, (SMALL.height, SMALL.width, 3)).astype(np.uint8)
    return cv2.imencode(".jpg", pixels)[1].tobytes()


def torn(data: bytes, marker: bytes, skip: int, fill: bytes) -> bytes:
    """The same length, with bytes after a marker that no decoder understands."""
    at = data.index(marker) + skip
    return data[:at] + fill + data[at + len(fill) :]


def convert(tmp_path: Path, change: Callable[[Ros, str, int, Any], Any], *options: str) -> dict[str, Any]:
    """A log of which `change` makes messages: of a Ros, a topic, the number of the frame, and the message."""
    r, rows = Ros(2), []
    for topic, at, message in still(r):
        if topic in (COLOR, DEPTH):
            message = change(r, topic, (at - START_NS) // STEP_NS - 1, message)
        kind = message.__msgtype__.rpartition("/")[2]
        rows.append((f"{topic}/compressed" if kind == "CompressedImage" else topic, at, message))
    registry.convert(
        "ros", r.write(tmp_path / "bag", rows, "sqlite3"), tmp_path / "rec", options=list(options)
    )
    return dict(json.loads((tmp_path / "rec" / "recording.json").read_text()))


@pytest.mark.parametrize("number", [0, 2])
@pytest.mark.parametrize(
    "broken",
    [b"", jpeg()[:100], jpeg()[:-600], torn(jpeg(), b"\xff\xc4", 4, b"\xff" * 56)],
    ids=["empty", "cut in its header", "cut", "broken"],
)
def test_color(tmp_path: Path, number: int, broken: bytes) -> None:
    def change(r: Ros, topic: str, k: int, message: Any) -> Any:
        if topic == DEPTH:
            return message
        at = START_NS + (k + 1) * STEP_NS
        return r.compressed(at, "c", broken if k == number else jpeg(), "rgb8; jpeg compressed bgr8")

    found = convert(tmp_path, change)
    assert found["robots"]["alpha"]["frames"] == FRAMES - 1
    assert found["warnings"] == ["alpha: 1 frames have color or depth that is cut short or broken; left out"]
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        assert all(log.frame(i).color.any() for i in range(FRAMES - 1))


def empty_depth(r: Ros, topic: str, k: int, message: Any) -> Any:
    if topic == DEPTH and k == 1:
        for name, value in (("height", 0), ("width", 0), ("step", 0), ("data", np.zeros(0, np.uint8))):
            object.__setattr__(message, name, value)
    return message


def torn_depth(r: Ros, topic: str, k: int, message: Any) -> Any:
    if topic == COLOR:
        return message
    units = np.frombuffer(message.data, np.uint16).reshape(SMALL.height, SMALL.width)
    data = cv2.imencode(".png", units)[1].tobytes()
    data = torn(data, b"IDAT", 6, bytes(14)) if k == 1 else data
    return r.compressed(START_NS + (k + 1) * STEP_NS, "c", HEAD + data, "16UC1; compressedDepth png")


@pytest.mark.parametrize("change", [empty_depth, torn_depth])
def test_depth(tmp_path: Path, change: Callable[[Ros, str, int, Any], Any]) -> None:
    """The color image is kept where frames may be without depth."""
    found = convert(tmp_path, change)
    assert found["robots"]["alpha"]["frames"] == FRAMES
    assert found["warnings"] == [
        "alpha: 1 frames have depth that is cut short or broken; their color is kept"
    ]
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        offsets = [log.frame(i).depth_offset_ns for i in range(FRAMES)]
    assert [abs(offset) for offset in offsets] == [0, STEP_NS, 0, 0]  # the run takes the nearest
    (tmp_path / "official").mkdir()
    found = convert(tmp_path / "official", change, "association=official")
    assert found["robots"]["alpha"]["frames"] == FRAMES - 1


def test_a_log_without_a_sound_image_is_an_error(tmp_path: Path) -> None:
    def no_color(r: Ros, topic: str, k: int, message: Any) -> Any:
        if topic == COLOR:
            object.__setattr__(message, "data", message.data[:7])
        return message

    def no_depth(r: Ros, topic: str, k: int, message: Any) -> Any:
        if topic == DEPTH:
            object.__setattr__(message, "data", message.data[:7])
        return message

    for name, change, words in (
        ("color", no_color, "7 bytes with rows of 192"),
        ("depth", no_depth, "4 images are cut short or broken, expected depth in some"),
    ):
        (tmp_path / name).mkdir()
        with pytest.raises(DuagError, match=words):
            convert(tmp_path / name, change)
