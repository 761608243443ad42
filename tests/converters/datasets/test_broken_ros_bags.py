"""Bags that are broken, incomplete or contradictory are refused with the reason."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest

from duagc.converters import registry
from duagc.pipeline.base.errors import DuagError
from tests.fixtures.box_room import path, render
from tests.fixtures.ros_bags import (
    COLOR,
    DEPTH,
    DISTORTION,
    FRAMES,
    REAL,
    START_NS,
    STEP_NS,
    Ros,
    scene,
)


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
        (lambda bag: edit_rows(bag, "update messages set data = 'text'"), "holds 4 bytes that are no"),
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
    with closing(sqlite3.connect(next(bag.glob("*.db3")))) as base, base:
        base.execute(statement)


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
