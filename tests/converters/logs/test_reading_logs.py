"""Logs are read no further than is needed, and the same comes out."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from duagc.converters import registry
from duagc.converters.logs import foxglove, open_log
from duagc.converters.logs.entries import Entry
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.bench import convert
from duagc.pipeline.geometry.camera import PinholeCamera
from tests.fixtures.full_disks import no_file_larger_than
from tests.fixtures.long_logs import COLOR, DEPTH, FRAME, IMU, KINDS, Seed, write

CAMERA = PinholeCamera(96, 64, 80.0, 80.0, 47.5, 31.5)
FRAMES = 7
IMAGES = f"{COLOR}/compressed", DEPTH


def seed() -> Seed:
    rng = np.random.default_rng(3)
    depths = [rng.integers(500, 4000, (CAMERA.height, CAMERA.width)).astype(np.uint16) for _ in range(3)]
    pixels = [rng.integers(0, 255, (CAMERA.height, CAMERA.width, 3)).astype(np.uint8) for _ in range(3)]
    return Seed(CAMERA, [cv2.imencode(".jpg", image)[1].tobytes() for image in pixels], depths)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("logs")
    paths = {kind: folder / f"{kind}{ {'bag': '.bag', 'db3': ''}.get(kind, '.mcap') }" for kind in KINDS}
    for kind, path in paths.items():
        write(seed(), path, kind, FRAMES * 4 * CAMERA.width * CAMERA.height)
    return paths


def row(entry: Entry) -> tuple[str, int, int]:
    return entry.topic, entry.log_ns, entry.header_ns()


@pytest.mark.parametrize("kind", KINDS)
def test_a_look_at_the_headers_finds_the_same_times(logs: dict[str, Path], kind: str) -> None:
    with open_log([logs[kind]]) as log:
        topics = [*IMAGES, *([IMU] if IMU in log.topics else [])]
        whole = list(log.entries(*topics))
        looked = list(log.entries(*topics, heads=IMAGES))
    assert [row(e) for e in looked] == [row(e) for e in whole]
    assert sum(e.topic == DEPTH for e in whole) >= FRAMES
    seen, all_of_it = ([len(e.data) for e in found if e.topic in IMAGES] for found in (looked, whole))
    assert max(seen) <= 256 < min(all_of_it)
    assert [e.data for e in looked if e.topic == IMU] == [e.data for e in whole if e.topic == IMU]


@pytest.mark.parametrize("kind", ["bag", "db3"])
def test_bags_give_what_rosbags_gives(logs: dict[str, Path], kind: str) -> None:
    with AnyReader([logs[kind]], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        expected = sorted((c.topic, t, bytes(data)) for c, t, data in reader.messages())
    with open_log([logs[kind]]) as log:
        found = [(e.topic, e.log_ns, e.data) for e in log.entries(*log.topics)]
    assert sorted(found) == expected
    assert [t for _, t, _ in found] == sorted(t for _, t, _ in found)


def test_a_message_that_leads_out_of_its_chunk_is_refused(logs: dict[str, Path], tmp_path: Path) -> None:
    data = bytearray(logs["bag"].read_bytes())
    size_at = data.rindex(FRAME.encode()) - 20  # before it: length of the name, stamp, number
    data[size_at : size_at + 4] = struct.pack("<I", 1 << 30)
    path = tmp_path / "out.bag"
    path.write_bytes(data)
    with open_log([path]) as log, pytest.raises(DuagError, match=r"1073741824 bytes leads out of its chunk"):
        list(log.entries(*log.topics))


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4])
def test_chunks_that_overlap_come_in_order_of_time(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "mixed.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000, compression=compression)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
        channels = [writer.register_channel(topic, "json", schema) for topic in ("/a", "/b", "/c")]
        for k, time in enumerate(np.random.default_rng(0).permutation(np.repeat(np.arange(60), 2)).tolist()):
            stamp = b'{"timestamp":{"sec":%d,"nsec":5},"n":%d,"rest":"%s"}' % (time, k, b"x" * 400)
            writer.add_message(channels[k % 3], time, stamp, time)
        writer.finish()
    with path.open("rb") as stream:
        found = make_reader(stream).iter_messages(["/a", "/c"], log_time_order=True)
        expected = [(c.topic, m.log_time, m.data) for _, c, m in found]
    with open_log([path]) as log:
        whole = [(e.topic, e.log_ns, e.data) for e in log.entries("/a", "/c")]
        looked = [row(e) for e in log.entries("/a", "/c", heads=["/a", "/c"])]
    assert whole == expected
    assert len(whole) == 80
    assert looked == [(topic, time, time * 10**9 + 5) for topic, time, _ in whole]


@pytest.mark.parametrize("kind", ["cdr", "protobuf", "json"])
def test_damage_behind_the_headers_is_found(logs: dict[str, Path], tmp_path: Path, kind: str) -> None:
    """In the pixels of the last image, whose chunk is looked at for times first."""
    data = bytearray(logs[kind].read_bytes())
    with logs[kind].open("rb") as stream:
        last = make_reader(stream).get_summary().chunk_indexes[-1]  # type: ignore[union-attr]
    at = last.chunk_start_offset + last.chunk_length - 300
    data[at] ^= 4
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    with pytest.raises(DuagError, match=r"damaged\.mcap"):
        registry.convert("ros", path, tmp_path / "rec")
    assert not (tmp_path / "rec").exists()


LONG = "QUJD" * 2000


@pytest.mark.parametrize(
    "members",
    [
        {"timestamp": {"sec": 3, "nsec": 4}, "data": LONG, "format": "jpeg"},
        {"data": LONG, "timestamp": {"sec": 3, "nsec": 4}},
        {"data": "", "meta": {"data": LONG}},
        {"meta": {"data": LONG}, "data": ""},
        {"meta": {"data": LONG}},
        {"data": LONG + '"', "a": 1},
        {"data": LONG, "other": 'x"data":"y"'},
        {'odd"data': LONG},
        {"data": [1, 2]},
        {"data": "QUJD"},
        ["data", LONG],
        {"frame_id": "data", "data": LONG},
    ],
)
@pytest.mark.parametrize("indent", [None, 2])
def test_json_is_read_as_python_reads_it(members: object, indent: int | None) -> None:
    text = json.dumps(members, indent=indent).encode()
    found = foxglove.json_members(text)
    if isinstance(found, dict) and isinstance(found.get("data"), foxglove.Base64):
        found["data"] = found["data"].decode()
    assert found == json.loads(text)


def test_a_second_timestamp_or_none_is_left_to_the_whole_message() -> None:
    assert foxglove.first_stamp_of_json(b'{ "timestamp": {"sec": 7, "nsec": 9}, "x"') == 7_000_000_009
    assert foxglove.first_stamp_of_json(b'{"frame_id":"a","timestamp":{"sec":7,"nsec":9}}') is None
    assert foxglove.first_stamp_of_json(b'{"timestamp":{"sec":7.5,"nsec":9}}') is None
    assert foxglove.first_stamp_of_protobuf(b"\x0a\x04\x08\x07\x10\x09rest") == 7_000_000_009
    assert foxglove.first_stamp_of_protobuf(b"\x12\x04\x08\x07\x10\x09") is None
    assert foxglove.first_stamp_of_protobuf(b"\x0a\x04\x08\x07") is None


def test_the_bench_compares_the_same_messages(logs: dict[str, Path], tmp_path: Path) -> None:
    found = convert.run(logs["bag"], [f"imu={IMU}"], tmp_path / "bench")
    assert found["topics"] == sorted([*IMAGES, IMU])
    assert not (tmp_path / "bench").exists()
    assert all(found[task]["cpu_s"] > 0 and found[task]["peak_bytes"] > 1e6 for task in convert.TASKS)
    assert 0.5 < found["copy"]["bytes"] / found["convert"]["bytes"] < 2
    assert "processor time" in convert.format_table(found)
    with pytest.raises(DuagError, match="imu topic /none not found"):
        convert.run(logs["bag"], ["imu=/none"], tmp_path / "bench")


def test_a_bench_that_finds_no_room_is_one_line(
    logs: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with no_file_larger_than(2000), pytest.raises(DuagError, match=r"to copy it: .*File too large"):
        convert.run(logs["bag"], [], tmp_path / "bench")
    assert not (tmp_path / "bench").exists()
    assert capfd.readouterr().err == ""
