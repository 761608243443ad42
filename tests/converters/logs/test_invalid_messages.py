"""A message whose bytes are none of its type costs itself; a topic most of whose messages are such is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.converters import registry
from duagc.pipeline.base.errors import DuagError
from tests.fixtures.ros_bags import FRAMES, SMALL, START_NS, STEP_NS, Ros, still

COLOR, DEPTH, IMU, TF = "/camera/color/image_raw", "/camera/depth_registered/image_raw", "/imu", "/tf_static"
INFO = "/camera/color/camera_info"
TEXT = b"some text that is no message"


def imu(r: Ros, at: int) -> Any:
    def vector(x: float) -> Any:
        return r.make("geometry_msgs/msg/Vector3", x=x, y=0.1, z=0.0)

    return r.make(
        "sensor_msgs/msg/Imu",
        header=r.header(at, "c"),
        orientation=r.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=vector(0.2),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(9.8),
        linear_acceleration_covariance=np.zeros(9),
    )


def bag(folder: Path, version: int, container: str, bad: dict[str, dict[int, bytes | int]]) -> Path:
    """A log of which the bytes of some messages are others, or cut to a length; by topic and number."""
    r, seen = Ros(version), dict[str, int]()
    rows = still(r)
    for k in range(FRAMES):
        at = START_NS + (k + 1) * STEP_NS
        rows += [(IMU, at, imu(r, at)), (INFO, at, r.info(at, "c", SMALL))]
        rows.append((TF, at, r.tf(r.transform(at, "base", "c", np.eye(4)))))

    class Damaged(Ros):
        def _fill(self, writer: Any, rows: list[tuple[str, int, Any]], serialize: Any) -> None:
            topics = iter([topic for topic, _, _ in rows])

            def damaged(message: Any, kind: str) -> bytes:
                topic, data = next(topics), bytes(serialize(message, kind))
                number = seen[topic] = seen.get(topic, -1) + 1
                how = bad.get(topic, {}).get(number, len(data))
                return data[:how] if isinstance(how, int) else how

            super()._fill(writer, rows, damaged)

    return Damaged(version).write(folder / "bag", sorted(rows, key=lambda row: row[1]), container)


def convert(folder: Path, log: Path) -> dict[str, Any]:
    registry.convert("ros", log, folder / "rec", options=["imu=/imu"])
    return dict(json.loads((folder / "rec" / "recording.json").read_text()))


@pytest.mark.parametrize(("version", "container"), [(1, "plain"), (1, "lz4"), (2, "sqlite3"), (2, "mcap")])
@pytest.mark.parametrize("bytes_left", [5, 22, TEXT], ids=["cut in its header", "cut", "text"])
def test_one_of_every_topic(tmp_path: Path, version: int, container: str, bytes_left: bytes | int) -> None:
    log = bag(
        tmp_path,
        version,
        container,
        {t: {0: bytes_left} for t in (COLOR, IMU, INFO)} | {DEPTH: {2: bytes_left}},
    )
    found = convert(tmp_path, log)
    # whose header is cut too has no time; else the frame is left out for its color
    assert found["robots"]["alpha"]["frames"] == FRAMES - 1
    at_s = (START_NS + STEP_NS) / 1e9
    for topic, count, time_s in (
        (COLOR, FRAMES, at_s),
        (IMU, FRAMES, at_s),
        (INFO, FRAMES + 1, START_NS / 1e9),
        (DEPTH, FRAMES, at_s + 2 * STEP_NS / 1e9),
    ):
        start = f"alpha: {topic}: 1 of {count} messages left out; the first, recorded at {time_s:.3f} s, "
        assert [w for w in found["warnings"] if w.startswith(start)], (topic, found["warnings"])


def test_what_is_no_header_tells_no_time(tmp_path: Path) -> None:
    """As a time it would be one of the future, and the clock of the images set back after it."""
    found = convert(tmp_path, bag(tmp_path, 2, "sqlite3", {COLOR: {1: TEXT}, IMU: {1: TEXT}}))
    assert found["robots"]["alpha"]["frames"] == FRAMES - 1
    assert not [warning for warning in found["warnings"] if "clock" in warning]


@pytest.mark.parametrize("topic", [COLOR, DEPTH, IMU, INFO])
def test_most_of_a_topic(tmp_path: Path, topic: str) -> None:
    log = bag(tmp_path, 2, "mcap", {topic: {0: 5, 1: 5, 3: 22}})
    with pytest.raises(
        DuagError, match=rf"{topic} holds 5 bytes.*; so it is with 3 of its \d messages, expected most"
    ):
        convert(tmp_path, log)
    assert not (tmp_path / "rec").exists()


def test_a_transform_that_is_needed_and_none_is_said(tmp_path: Path) -> None:
    log = bag(tmp_path, 1, "plain", {TF: dict.fromkeys(range(3), 7)})
    found = convert(tmp_path, log)  # none is needed: the IMU is in the camera's frame
    start = f"alpha: {TF}: 3 of {FRAMES} messages left out; "
    assert [warning for warning in found["warnings"] if warning.startswith(start)]
    with pytest.raises(
        DuagError, match=r"/tf_static holds 7 bytes that are no .*; so it is with 3 of its 4 messages"
    ):
        registry.convert(
            "ros",
            log,
            tmp_path / "other",
            options=["imu=/imu", "truth_frame=elsewhere", f"truth_file={truth(tmp_path)}"],
        )


def truth(folder: Path) -> Path:
    (folder / "true.tum").write_text(
        "".join(f"{(START_NS + k * STEP_NS) / 1e9} 0 0 0 0 0 0 1\n" for k in range(9))
    )
    return folder / "true.tum"
