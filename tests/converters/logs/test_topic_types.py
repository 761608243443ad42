"""Topics of several types, and types that a log defines otherwise than it states: what can be read is read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.converters import registry
from duagc.converters.logs.describe import describe, format_description
from duagc.pipeline.base.errors import DuagError
from tests.converters.logs.test_invalid_messages import COLOR, IMU, INFO, imu
from tests.fixtures.foreign_mcap import Row, digests, write
from tests.fixtures.ros_bags import FRAMES, START_NS, STEP_NS, Ros, scene, still

DEPTH = "/camera/depth_registered/image_raw"
AT = f"recorded at {(START_NS + STEP_NS // 2) / 1e9:.3f} s"


def rows_of(r: Ros) -> list[Row]:
    found = still(r)
    for k in range(FRAMES):
        at = START_NS + (k + 1) * STEP_NS
        found.append((IMU, at, imu(r, at)))
    return sorted(found, key=lambda row: row[1])


def with_others(r: Ros, topics: tuple[str, ...]) -> list[Row]:
    """The rows, and one message of another type on each of some topics, before the second image."""
    at = START_NS + STEP_NS // 2
    odd = [(topic, at, r.tf(r.transform(at, "a", "b", np.eye(4)))) for topic in topics]
    return sorted([*rows_of(r), *odd], key=lambda row: row[1])


def log_of(folder: Path, rows: list[Row], r: Ros, container: str) -> Path:
    if container == "own mcap":
        return write(folder / "log.mcap", rows, "cdr", r)
    return r.write(folder / "log", rows, container)


def converted(folder: Path, log: Path, *options: str) -> dict[str, Any]:
    registry.convert("ros", log, folder / "rec", options=["imu=/imu", *options])
    return dict(json.loads((folder / "rec" / "recording.json").read_text()))


@pytest.mark.parametrize(
    ("version", "container"), [(1, "plain"), (1, "lz4"), (2, "sqlite3"), (2, "mcap"), (2, "own mcap")]
)
def test_messages_of_another_type_are_left_out(tmp_path: Path, version: int, container: str) -> None:
    r = Ros(version)
    topics = COLOR, DEPTH, IMU
    for folder in ("odd", "plain"):
        (tmp_path / folder).mkdir()
    odd = converted(tmp_path / "odd", log_of(tmp_path / "odd", with_others(r, topics), r, container))
    plain = converted(tmp_path / "plain", log_of(tmp_path / "plain", rows_of(r), r, container))
    assert digests(tmp_path / "odd" / "rec") == digests(tmp_path / "plain" / "rec")
    kinds = {COLOR: "Image", DEPTH: "Image", IMU: "Imu"}
    assert [text for text in odd["warnings"] if text not in plain["warnings"]] == [
        f"alpha: {topic}: 1 of {FRAMES + 1} messages left out; the first, {AT}, holds tf2_msgs/msg/TFMessage, "
        f"expected sensor_msgs/msg/{kinds[topic]} as most of its messages are"
        for topic in sorted(topics)
    ]
    found = describe(next((tmp_path / "odd").glob("log*")))
    assert f"{FRAMES + 1}" in format_description(found)
    assert "sensor_msgs/msg/Imu, and 1 of tf2_msgs/msg/TFMessage" in format_description(found)
    assert "frames, depth is registered to color already" in format_description(found)


def test_of_as_many_messages_the_type_that_is_read_counts(tmp_path: Path) -> None:
    r = Ros(2)
    text = r.make("std_msgs/msg/String", data="calibrated")
    for number, order in enumerate(((0, 1), (1, 0))):
        rows = scene(r)
        infos = [row for row in rows if row[0].endswith("color/camera_info")]
        both = [infos[0], (infos[0][0], START_NS, text)]
        rows = [*(both[k] for k in order), *(row for row in rows if row not in infos)]
        registry.convert("ros", r.write(tmp_path / f"bag{number}", rows, "mcap"), tmp_path / f"rec{number}")
        [warning] = [
            w
            for w in json.loads((tmp_path / f"rec{number}" / "recording.json").read_text())["warnings"]
            if "camera_info" in w
        ]
        assert warning.startswith("alpha: /camera/color/camera_info: 1 of 2 messages left out; the first, ")
        assert "holds std_msgs/msg/String, expected sensor_msgs/msg/CameraInfo" in warning


def test_pieces_of_one_log_may_differ_in_type(tmp_path: Path) -> None:
    """The first piece has the other type alone: most messages decide, not the first."""
    r = Ros(1)
    rows = with_others(r, (IMU,))
    second = next(k for k, row in enumerate(rows) if row[1] > START_NS + STEP_NS // 2)
    logs = tmp_path / "logs"
    logs.mkdir()
    r.write(logs / "log_0", rows[:second], "plain")
    r.write(logs / "log_1", rows[second:], "plain")
    found = converted(tmp_path, logs, "pieces=true")
    assert found["robots"]["alpha"]["frames"] == FRAMES
    start = (
        f"alpha: {IMU}: 1 of {FRAMES + 1} messages left out; the first, {AT}, holds tf2_msgs/msg/TFMessage"
    )
    assert [warning for warning in found["warnings"] if warning.startswith(start)]


def test_a_topic_most_of_which_is_of_other_types_is_refused(tmp_path: Path) -> None:
    r = Ros(1)
    rows = rows_of(r)
    kinds = "Point", "Quaternion", "Vector3"
    for k in range(3 * (FRAMES - 1)):
        name = kinds[k % 3]
        values = dict.fromkeys("xyzw" if name == "Quaternion" else "xyz", 0.0)
        rows.append((IMU, START_NS + k, r.make(f"geometry_msgs/msg/{name}", **values)))
    rows.sort(key=lambda row: row[1])
    with pytest.raises(DuagError, match=r"/imu holds geometry_msgs/msg/Point, .*; so it is with 9 of its 13"):
        converted(tmp_path, r.write(tmp_path / "log", rows, "plain"))


class Redefined(Ros):
    """Writes bags of ROS 1 whose connections state what the test says, by topic: MD5 sum and definition."""

    def __init__(self, stated: dict[str, dict[str, str]]) -> None:
        super().__init__(1)
        self.stated = stated

    def _fill(self, bag: Any, rows: list[Row], serialize: Any) -> None:
        connections: dict[str, Any] = {}
        for topic, log_ns, message in rows:
            kind = message.__msgtype__
            if topic not in connections:
                text, md5sum = self.store.generate_msgdef(kind)
                stated = {"msgdef": text, "md5sum": md5sum, **self.stated.get(topic, {})}
                connections[topic] = bag.add_connection(topic, kind, **stated)
            bag.write(connections[topic], log_ns, serialize(message, kind))


def redefined(folder: Path, stated: dict[str, dict[str, str]]) -> Path:
    r = Redefined(stated)
    return r.write(folder / "log", rows_of(r), "plain")


def test_a_wrong_md5_sum_is_said_and_the_topic_read(tmp_path: Path) -> None:
    for folder in ("odd", "plain"):
        (tmp_path / folder).mkdir()
    stated = {topic: {"md5sum": "0" * 32} for topic in (COLOR, IMU, INFO)}
    odd = converted(tmp_path / "odd", redefined(tmp_path / "odd", stated))
    plain = converted(tmp_path / "plain", redefined(tmp_path / "plain", {}))
    assert digests(tmp_path / "odd" / "rec") == digests(tmp_path / "plain" / "rec")
    sums = {
        COLOR: ("Image", "060021388200f6f0f447d0fcd9c64743"),
        INFO: ("CameraInfo", "c9a58c1b0b154e0e6da7578cb991d214"),
        IMU: ("Imu", "6a62c6daae103f4ff57a132d6f95cec2"),
    }
    assert [text for text in odd["warnings"] if text not in plain["warnings"]] == [
        f"alpha: {topic}: a connection states MD5 sum {'0' * 32} of sensor_msgs/msg/{kind}, expected {md5} as of its "
        "definition, by which its messages are read"
        for topic, (kind, md5) in sorted(sums.items())
    ]


def test_any_md5_sum_is_none(tmp_path: Path) -> None:
    found = converted(tmp_path, redefined(tmp_path, {topic: {"md5sum": "*"} for topic in (IMU, INFO)}))
    assert not [text for text in found["warnings"] if "MD5" in text]


@pytest.mark.parametrize("definition", ["float64 something", "uint8 X=1\nfoo_pkg/Missing y\n", "}{"])
def test_a_broken_definition_costs_its_topic(tmp_path: Path, definition: str) -> None:
    log = redefined(tmp_path, {IMU: {"msgdef": definition}})
    registry.convert("ros", log, tmp_path / "without")
    assert (
        json.loads((tmp_path / "without" / "recording.json").read_text())["robots"]["alpha"]["frames"]
        == FRAMES
    )
    with pytest.raises(
        DuagError,
        match=r"log\.bag: /imu has a definition of sensor_msgs/msg/Imu that cannot be read \(.*\); so it is with 4 of",
    ):
        converted(tmp_path, log)
