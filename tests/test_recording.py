"""Logs: what is written is what is read, and a broken file is one line, never a wrong message."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

import schemas
from converters.base import RecordingWriter, RobotWriter, robot_names
from pipeline import messages as m
from pipeline.errors import DuagError
from pipeline.geometry import se3
from pipeline.geometry.camera import PinholeCamera
from pipeline.recording import (
    LogWriter,
    Record,
    Recording,
    content_digest,
    format_info,
    info,
    log_metadata,
    merge,
    open_rgbd,
    read_log,
    verify,
)
from pipeline.recording.pairing import TOLERANCE_NS, pair
from pipeline.recording.register_depth import register_depth
from schemas import topics

CAMERA = PinholeCamera(16, 12, 14.0, 14.0, 7.5, 5.5)
FRAME_NS = 33_333_333
LOGS = Path(__file__).parents[2] / "shared" / "data" / "logs"


def image(index: int) -> np.ndarray:
    return np.random.default_rng(index).integers(0, 255, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)


def png(array: np.ndarray) -> bytes:
    return cv2.imencode(".png", array)[1].tobytes()


def depth(index: int) -> np.ndarray:
    return np.random.default_rng(1000 + index).integers(
        0, 5000, (CAMERA.height, CAMERA.width), dtype=np.uint16
    )


def write_camera(
    path: Path,
    frames: int = 4,
    skip_color: tuple[int, ...] = (),
    skip_depth: tuple[int, ...] = (),
    cameras: dict[int, PinholeCamera] | None = None,
    scale: str | None = "0.001",
    color: Callable[[int], bytes] = lambda index: png(image(index)),
    depth: Callable[[int], np.ndarray] = depth,
    masks: dict[int, Any] | None = None,
) -> Path:
    with LogWriter(path, "alpha") as log:
        log.channel(
            topics.DEPTH.of("alpha"), topics.DEPTH.schema, {} if scale is None else {"depth_scale": scale}
        )
        for index in range(frames):
            stamp = index * FRAME_NS
            for at, camera in ({0: CAMERA} if cameras is None else cameras).items():
                if at == index:
                    log.write(
                        topics.CALIBRATION.of("alpha"), m.pack_calibration(stamp, "alpha", camera), stamp
                    )
            if index not in skip_color:
                log.write(topics.COLOR.of("alpha"), m.pack_color(stamp, "alpha", color(index), "png"), stamp)
            if index not in skip_depth:
                log.write(topics.DEPTH.of("alpha"), m.pack_depth(stamp, "alpha", depth(index)), stamp)
            if masks is not None and index in masks:
                log.write(topics.MASK.of("alpha"), masks[index], stamp)
    return path


def update(robot: str, index: int) -> m.MapUpdate:
    return m.MapUpdate(index, robot, index, 1, 2, 3, 0.5, 0.25)


def write_updates(
    path: Path, robot: str, log_times: list[int], metadata: dict[str, str] | None = None
) -> str:
    with LogWriter(path, robot, metadata) as log:
        for index, time in enumerate(log_times):
            log.write(topics.MAP_UPDATE.of(robot), update(robot, index), time, max(0, time - 5))
    return log.digest


# --- writing and reading ---------------------------------------------------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(steps=st.lists(st.integers(0, 3), max_size=30))
def test_messages_come_back_in_order(tmp_path_factory: pytest.TempPathFactory, steps: list[int]) -> None:
    times = np.cumsum(steps, dtype=int).tolist()
    path = tmp_path_factory.mktemp("log") / "alpha.mcap"
    digest = write_updates(path, "alpha", times)
    records = list(read_log(path))
    assert [r.log_time_ns for r in records] == times
    assert [r.publish_time_ns for r in records] == [max(0, t - 5) for t in times]
    assert [r.sequence for r in records] == list(range(len(times)))
    assert [r.message() for r in records] == [update("alpha", i) for i in range(len(times))]
    assert content_digest(path) == digest


def test_sequences_count_per_topic(tmp_path: Path) -> None:
    path = write_camera(tmp_path / "alpha.mcap")
    for topic in (topics.COLOR.of("alpha"), topics.DEPTH.of("alpha")):
        assert [r.sequence for r in read_log(path, [topic])] == [0, 1, 2, 3]
    assert list(read_log(path, ["/alpha/odometry"])) == []


def test_many_chunks_come_back_in_order(tmp_path: Path) -> None:
    """A log of several chunks of 1 MiB, with incompressible messages."""
    path = tmp_path / "alpha.mcap"
    rng = np.random.default_rng(0)
    blobs = [rng.bytes(300_000) for _ in range(12)]
    with LogWriter(path, "alpha") as log:
        for index, blob in enumerate(blobs):
            log.write(topics.COLOR.of("alpha"), m.pack_color(index, "alpha", blob, "jpeg"), index)
    assert [r.proto().data for r in read_log(path)] == blobs
    assert path.stat().st_size > 3_600_000


def test_merge_orders_by_time_then_file_then_place(tmp_path: Path) -> None:
    paths = []
    for name, times in (("bravo", [0, 5, 5, 9]), ("alpha", [5, 5, 9, 20])):
        paths.append(tmp_path / f"{name}.mcap")
        write_updates(paths[-1], name, times)
    merged = [(r.log_time_ns, r.topic.split("/")[1], r.sequence) for r in merge(paths)]
    expected = [(t, 0, i, "bravo") for i, t in enumerate([0, 5, 5, 9])]
    expected += [(t, 1, i, "alpha") for i, t in enumerate([5, 5, 9, 20])]
    assert merged == [(t, name, i) for t, _, i, name in sorted(expected)]


def test_the_writer_refuses_what_is_not_in_the_table(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "x.mcap") as log:
        log.write("/alpha/map_update", update("alpha", 0), 10)
        for topic, message, time, words in (
            ("/alpha/map_updates", update("alpha", 0), 10, "topics.py"),
            ("/alpha/odometry", update("alpha", 0), 10, "expected duagc.v1.Odometry"),
            ("/alpha/map_update", m.pack_color(0, "alpha", b"", "png"), 10, "expected duagc.v1.MapUpdate"),
            ("/alpha/map_update", update("alpha", 0), 9, "comes after 10 ns"),
        ):
            with pytest.raises(ValueError, match=words):
                log.write(topic, message, time)


def test_nothing_half_written_has_a_final_name(tmp_path: Path) -> None:
    path = tmp_path / "alpha.mcap"

    def write_and_fail(error: type[BaseException]) -> None:
        with LogWriter(path, "alpha") as log:
            log.write("/alpha/map_update", update("alpha", 0), 0)
            assert [p.name for p in tmp_path.iterdir()] == ["alpha.mcap.part"]
            raise error

    for error in (RuntimeError, KeyboardInterrupt):
        with pytest.raises(error):
            write_and_fail(error)
        assert list(tmp_path.iterdir()) == []
    with pytest.raises(DuagError, match="expected to write a log"), LogWriter(tmp_path / "no" / "x.mcap"):
        pass


# --- identity ---------------------------------------------------------------------------------------------------------


def test_digest_depends_on_content_only(tmp_path: Path) -> None:
    first = write_updates(tmp_path / "a.mcap", "alpha", [0, 1, 2], {"seed": "0"})
    assert write_updates(tmp_path / "b.mcap", "alpha", [0, 1, 2], {"seed": "0"}) == first
    others = [
        write_updates(tmp_path / "c.mcap", "alpha", [0, 1, 3], {"seed": "0"}),
        write_updates(tmp_path / "d.mcap", "alpha", [0, 1], {"seed": "0"}),
        write_updates(tmp_path / "e.mcap", "bravo", [0, 1, 2], {"seed": "0"}),
        write_updates(tmp_path / "f.mcap", "alpha", [0, 1, 2], {"seed": "1"}),
    ]
    assert len({first, *others}) == 5
    assert len(first) == 64
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_digest_does_not_depend_on_the_encoder(tmp_path: Path) -> None:
    """The same messages in a file that another program chunked and left uncompressed."""
    source, other = tmp_path / "a.mcap", tmp_path / "b.mcap"
    digest = write_updates(source, "alpha", [0, 1, 2])
    with other.open("wb") as stream:
        writer = Writer(stream, chunk_size=10, compression=CompressionType.NONE)
        writer.start(library="another")
        writer.add_metadata("duagc.log", log_metadata(source))
        for number, record in enumerate(read_log(source)):
            if number == 0:
                schema = writer.register_schema(record.schema, "protobuf", record.schema_data)
                channel = writer.register_channel(record.topic, "protobuf", schema)
            writer.add_message(
                channel, record.log_time_ns, record.data, record.publish_time_ns, record.sequence
            )
        writer.finish()
    assert other.read_bytes() != source.read_bytes()
    assert content_digest(other) == digest


def test_digest_is_the_same_in_every_process(tmp_path: Path) -> None:
    write_camera(tmp_path / "alpha.mcap")
    code = (
        "import sys; from pathlib import Path; from pipeline.recording import content_digest;"
        "print(content_digest(Path(sys.argv[1])))"
    )
    out = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "alpha.mcap")],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[1],
    )
    assert out.stdout.strip() == content_digest(tmp_path / "alpha.mcap")


# --- broken files -----------------------------------------------------------------------------------------------------


def read_everything(path: Path) -> None:
    for record in read_log(path):
        record.message()
    info(path)


def test_a_flipped_bit_anywhere_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "alpha.mcap"
    write_updates(path, "alpha", [0, 1, 2])
    sound = path.read_bytes()
    with path.open("r+b", buffering=0) as stream:
        for offset, byte in enumerate(sound):
            stream.seek(offset)
            stream.write(bytes([byte ^ 1 << (offset % 8)]))
            with pytest.raises(DuagError, match=r"alpha\.mcap: "):
                verify(path)
            stream.seek(offset)
            stream.write(bytes([byte]))
    assert path.read_bytes() == sound
    read_everything(path)


def test_a_file_cut_anywhere_is_an_error(tmp_path: Path) -> None:
    path = write_camera(tmp_path / "alpha.mcap")
    sound = path.read_bytes()
    for length in (*range(0, len(sound), 61), len(sound) - 1):
        path.write_bytes(sound[:length])
        with pytest.raises(DuagError, match=r"alpha\.mcap: (is cut short|the file is empty|does not begin)"):
            read_everything(path)
        with pytest.raises(DuagError):
            open_rgbd(path)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1))
def test_files_broken_behind_right_checksums_are_one_line(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    """Other programs may write no checksums: then a damaged file either reads or is one DuagError."""
    rng = np.random.default_rng(seed)
    path = tmp_path_factory.mktemp("log") / "x.mcap"
    with path.open("wb") as stream:
        writer = Writer(
            stream, compression=rng.choice([CompressionType.NONE, CompressionType.ZSTD]), enable_crcs=False
        )
        writer.start(library="another")
        writer.add_metadata("text", {"a": "b"})
        writer.add_attachment(1, 2, "file", "text/plain", b"content")
        data = schemas.descriptor_set("duagc.v1.MapUpdate")
        channel = writer.register_channel(
            "/alpha/map_update", "protobuf", writer.register_schema("duagc.v1.MapUpdate", "protobuf", data)
        )
        for index in range(3):
            writer.add_message(channel, index, update("alpha", index).pack().SerializeToString(), index)
        writer.finish()
    broken = bytearray(path.read_bytes())
    for offset in rng.integers(8, len(broken) - 8, rng.integers(1, 4)):
        broken[offset] = rng.integers(256)
    path.write_bytes(broken)
    for read in (read_everything, content_digest, log_metadata):
        line = error_of(read, path)
        assert line is None or ("x.mcap" in line and "\n" not in line)


def error_of(read: Callable[[Path], object], path: Path) -> str | None:
    """The line of the DuagError that `read` raises; anything else that it raises is a failure of the test."""
    try:
        read(path)
    except DuagError as error:
        return str(error)
    return None


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "No such file"),
        (b"", "is empty"),
        (b"x" * 100, "does not begin"),
        (b"\x89MCAP0\r\n", "cut short"),
    ],
)
def test_files_that_are_no_logs(tmp_path: Path, content: bytes | None, words: str) -> None:
    path = tmp_path / "x.mcap"
    if content is not None:
        path.write_bytes(content)
    for read in (read_everything, content_digest, open_rgbd, log_metadata):
        with pytest.raises(DuagError, match=words):
            read(path)
    with pytest.raises(DuagError, match="Is a directory"):
        content_digest(tmp_path)


def test_a_changed_file_is_verified_again(tmp_path: Path) -> None:
    path = tmp_path / "alpha.mcap"
    write_updates(path, "alpha", [0, 1, 2])
    verify(path)
    broken = bytearray(path.read_bytes())
    broken[200] ^= 1
    path.write_bytes(broken)
    with pytest.raises(DuagError, match="checksum"):
        verify(path)


def test_messages_that_are_not_of_their_schema(tmp_path: Path) -> None:
    good = update("alpha", 0).pack()
    descriptors = schemas.descriptor_set("duagc.v1.MapUpdate")

    def record(schema: str, data: bytes, schema_data: bytes) -> Record:
        return Record(tmp_path / "x.mcap", "/a", schema, 7, 7, 0, data, schema_data)

    with pytest.raises(DuagError, match=r"x\.mcap: /a at 7 ns has 2 bytes that are no duagc\.v1\.MapUpdate"):
        record("duagc.v1.MapUpdate", b"\xff\xff", descriptors).message()
    for name, data in (("", b""), ("other.Thing", b""), ("other.Thing", b"\xff\xff")):
        with pytest.raises(DuagError, match=r"x\.mcap: /a at 7 ns"):
            record(name, good.SerializeToString(), data).message()
    with pytest.raises(DuagError, match=r"x\.mcap: /a at 7 ns: Odometry\.status"):
        record("duagc.v1.Odometry", b"", b"").message()


# --- colour and depth -------------------------------------------------------------------------------------------------


def test_frames_come_back_in_any_order(tmp_path: Path) -> None:
    with open_rgbd(write_camera(tmp_path / "alpha.mcap", frames=9)) as log:
        assert (log.robot, log.camera, log.depth_scale, len(log)) == ("alpha", CAMERA, 0.001, 9)
        for frame in [*log.frames(), log.frame(7), log.frame(0)]:
            assert frame.stamp_ns == frame.index * FRAME_NS
            assert np.array_equal(frame.color, image(frame.index)[:, :, ::-1])  # OpenCV encodes BGR
            assert np.array_equal(frame.depth, depth(frame.index) * np.float32(0.001))
            assert frame.depth.dtype == np.float32
        with pytest.raises(IndexError):
            log.frame(9)


def usable(index: int) -> np.ndarray:
    return np.random.default_rng(2000 + index).random((CAMERA.height, CAMERA.width)) < 0.6


def test_masks_come_with_their_images(tmp_path: Path) -> None:
    """Some frames have one; a masked pixel keeps its depth, but not its usable depth."""
    masks = {k: m.pack_mask(k * FRAME_NS, "alpha", usable(k)) for k in (1, 4, 5)}
    with open_rgbd(write_camera(tmp_path / "alpha.mcap", frames=7, masks=masks)) as log:
        for frame in [*log.frames(), log.frame(4)]:
            if frame.index in masks:
                assert frame.mask is not None
                assert np.array_equal(frame.mask, usable(frame.index))
                assert np.array_equal(frame.usable_depth, frame.depth * usable(frame.index))
            else:
                assert frame.mask is None
                assert frame.usable_depth is frame.depth


def test_masks_can_be_recorded(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        for k in range(3):
            robot.add_frame(k * FRAME_NS, png(image(k)), "png", depth(k), mask=usable(k) if k else None)
        with pytest.raises(ValueError, match="an image is"):
            robot.add_frame(3 * FRAME_NS, png(image(3)), "png", depth(3), mask=usable(3).T)
    with open_rgbd(tmp_path / "rec" / "alpha.mcap") as log:
        assert [frame.mask is None for frame in log.frames()] == [True, False, False]


def odd_mask(**fields: Any) -> Any:
    message = m.pack_mask(0, "alpha", usable(0))
    for name, value in fields.items():
        setattr(message, name, value)
    return message


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (odd_mask(encoding="mono8"), "at 0 ns is mono8, expected 8UC1"),
        (odd_mask(step=15), "has rows of 15 bytes for 16x12 pixels"),
        (odd_mask(data=b"x"), "has 1 bytes, expected 192"),
        (
            odd_mask(data=bytes([255] * 191 + [7])),
            "has the value 7, expected 0 (ignore) and 255 (usable) only",
        ),
        (odd_mask(width=8, height=24, step=8), "is 8x24, expected 16x12"),
    ],
)
def test_unsound_masks_are_one_line(tmp_path: Path, mask: Any, words: str) -> None:
    path = write_camera(tmp_path / "alpha.mcap", masks={0: mask})
    with pytest.raises(DuagError) as caught:
        list(open_rgbd(path).frames())
    assert str(caught.value).startswith(f"{path}: /alpha/camera/mask")
    assert words in str(caught.value)


def test_a_mask_of_no_image_is_an_error(tmp_path: Path) -> None:
    skipped = {"skip_color": (2,), "skip_depth": (2,)}
    masks = {2: m.pack_mask(2 * FRAME_NS, "alpha", usable(2))}
    with pytest.raises(DuagError, match="has a mask at 66666666 ns, expected one in /alpha/camera/color"):
        open_rgbd(write_camera(tmp_path / "alpha.mcap", masks=masks, **skipped))


def test_frames_stream(tmp_path: Path) -> None:
    """Only a few chunks are in memory, however long the log."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 2**16, (480, 640), dtype=np.uint16)
    camera = PinholeCamera(640, 480, 500, 500, 320, 240)
    picture = png(np.zeros((480, 640, 3), np.uint8))
    path = write_camera(
        tmp_path / "a.mcap", 12, cameras={0: camera}, color=lambda _: picture, depth=lambda _: noise
    )
    log = open_rgbd(path)
    for frame in log.frames():
        assert frame.depth[0, 0] == np.float32(noise[0, 0]) * np.float32(0.001)
        assert sum(len(chunk) for chunk in log._log._chunks.values()) < 6_000_000


COLOR, DEPTH, CALIBRATION = "/alpha/camera/color", "/alpha/camera/depth", "/alpha/camera/calibration"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"skip_color": (0, 2), "skip_depth": (1, 3)}, "none of them within 20 ms of each other"),
        ({"skip_depth": (0, 1, 2, 3)}, "has a message, expected depth from one of them"),
        ({"frames": 0}, "expected exactly one robot"),
        ({"cameras": {}}, f"{CALIBRATION} has no message"),
        ({"cameras": {1: CAMERA}}, f"{CALIBRATION} begins at 33333333 ns"),
        ({"cameras": {0: CAMERA, 2: CAMERA.halved()}}, f"{CALIBRATION} changes at 66666666 ns"),
        ({"cameras": {0: CAMERA.halved()}}, f"{COLOR} at 0 ns is 16x12, expected 8x6"),
        ({"cameras": {0: PinholeCamera(16, 12, np.nan, 1, 1, 1)}}, f"{CALIBRATION}: K is"),
        ({"scale": None}, f"{DEPTH}: channel metadata depth_scale is None"),
        ({"scale": "-1"}, f"{DEPTH}: channel metadata depth_scale is '-1'"),
        ({"scale": "nan"}, "depth_scale is 'nan'"),
        ({"color": lambda _: b"no image"}, f"{COLOR} at 0 ns has 8 bytes that no decoder reads"),
        ({"color": lambda _: b""}, f"{COLOR} at 0 ns has 0 bytes"),
        ({"depth": lambda _: np.zeros((3, 4), np.uint16)}, f"{DEPTH} at 0 ns is 4x3, expected 16x12"),
    ],
)
def test_unsound_cameras_are_one_line(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    path = write_camera(tmp_path / "alpha.mcap", **change)
    with pytest.raises(DuagError) as caught:
        list(open_rgbd(path).frames())
    assert str(caught.value).startswith(str(path))
    assert words in str(caught.value)


def test_images_without_a_partner_are_no_frames(tmp_path: Path) -> None:
    path = write_camera(tmp_path / "alpha.mcap", 8, skip_color=(1,), skip_depth=(4, 5))
    with open_rgbd(path) as log:
        assert [f.stamp_ns // FRAME_NS for f in log.frames()] == [0, 2, 3, 6, 7]
        assert [f.index for f in log.frames()] == [0, 1, 2, 3, 4]
        for frame in log.frames():
            assert np.array_equal(frame.depth, depth(frame.stamp_ns // FRAME_NS) * np.float32(0.001))
        assert log.pairing.color_alone == (4 * FRAME_NS, 5 * FRAME_NS)
        assert log.pairing.depth_alone == (FRAME_NS,)
    warnings = info(path)["warnings"]
    assert f"{COLOR}: 2 images have none of {DEPTH} within 20 ms and are no frames" in warnings
    assert f"{DEPTH}: 1 images have none of {COLOR} within 20 ms and are no frames" in warnings


def test_colour_and_depth_may_come_at_their_own_rates(tmp_path: Path) -> None:
    """Colour at 30 Hz, depth at 10 Hz and 7 ms late: every third colour image has its nearest depth."""
    path = tmp_path / "alpha.mcap"
    events = [(k * FRAME_NS, topics.COLOR, k) for k in range(9)]
    events += [(3 * k * FRAME_NS + 7_000_000, topics.DEPTH, k) for k in range(3)]
    with LogWriter(path, "alpha") as log:
        log.channel(DEPTH, topics.DEPTH.schema, {"depth_scale": "0.001"})
        log.write(CALIBRATION, m.pack_calibration(0, "alpha", CAMERA), 0)
        for stamp, topic, k in sorted(events, key=lambda event: event[0]):
            color = topic is topics.COLOR
            message = (
                m.pack_color(stamp, "alpha", png(image(k)), "png")
                if color
                else m.pack_depth(stamp, "alpha", depth(k))
            )
            log.write(topic.of("alpha"), message, stamp)
    with open_rgbd(path) as log:
        frames = list(log.frames())
    assert [f.stamp_ns // FRAME_NS for f in frames] == [0, 3, 6]
    assert [f.depth_offset_ns for f in frames] == [7_000_000] * 3
    for k, frame in enumerate(frames):
        assert np.array_equal(frame.color, image(3 * k)[:, :, ::-1])
        assert np.array_equal(frame.depth, depth(k) * np.float32(0.001))
    assert f"{DEPTH}: up to 7.0 ms from {COLOR}" in info(path)["warnings"]


@settings(max_examples=50, deadline=None)
@given(
    color=st.lists(st.integers(0, 10**9), unique=True, min_size=1, max_size=20),
    depth_times=st.lists(st.integers(0, 10**9), unique=True, min_size=1, max_size=20),
)
def test_pairs_are_each_others_nearest(color: list[int], depth_times: list[int]) -> None:
    found = pair(color, depth_times)
    for c, d in found.pairs:
        assert abs(c - d) <= TOLERANCE_NS
        assert abs(c - d) == min(abs(c - other) for other in depth_times)
        assert abs(c - d) == min(abs(other - d) for other in color)
    assert sorted([c for c, _ in found.pairs] + list(found.color_alone)) == sorted(color)
    assert sorted([d for _, d in found.pairs] + list(found.depth_alone)) == sorted(depth_times)
    assert len({d for _, d in found.pairs}) == len(found.pairs)


# --- depth of other sensors -------------------------------------------------------------------------------------------

WIDE = PinholeCamera(64, 48, 56.0, 56.0, 31.5, 23.5)
DEPTH_CAMERA = PinholeCamera(60, 44, 50.0, 51.0, 29.0, 22.5)
T_CAMERA_DEPTH = se3.exp([0.025, -0.004, 0.01, 0.01, -0.02, 0.015])
WALL = (np.array([0.2, -0.1, -1.0]), 2.0)  # n . X = -d in the colour camera


def plane_depth(camera: PinholeCamera, T_plane_camera: np.ndarray) -> np.ndarray:
    """Depth image of the wall, given in the colour camera, from a camera at T_plane_camera."""
    n, d = WALL
    rays = camera.rays() @ T_plane_camera[:3, :3].T
    return -(d + T_plane_camera[:3, 3] @ n) / (rays @ n)


def test_depth_of_another_camera_is_exact_on_a_wall() -> None:
    raw = plane_depth(DEPTH_CAMERA, T_CAMERA_DEPTH).astype(np.float32)
    seen = register_depth(raw, DEPTH_CAMERA, T_CAMERA_DEPTH, WIDE)
    truth = plane_depth(WIDE, np.eye(4))
    inner = seen[6:-6, 6:-6]
    assert (inner > 0).all()  # no gaps
    # a sample falls up to half a pixel beside the centre, where the wall is up to 0.2 / 56 / 2 of its depth away
    np.testing.assert_allclose(inner, truth[6:-6, 6:-6], rtol=3e-3)
    assert abs(float(np.mean(inner - truth[6:-6, 6:-6]))) < 5e-4


def test_the_nearer_surface_hides_the_farther() -> None:
    """A card before the wall: what lies behind it, seen by the depth camera only, does not shine through."""
    raw = np.full((DEPTH_CAMERA.height, DEPTH_CAMERA.width), 3.0, np.float32)
    raw[:, 30:] = 1.0
    aside = se3.exp([-0.3, 0, 0, 0, 0, 0])
    seen = register_depth(raw, DEPTH_CAMERA, aside, DEPTH_CAMERA)
    row = seen[20]
    near = np.flatnonzero(np.abs(row - 1) < 0.01)
    assert np.array_equal(near, np.arange(near[0], near[-1] + 1))
    assert not np.any((row > 1.05) & (row < 2.9))  # nothing between the two


def test_unregistered_depth_is_read_by_its_calibration_and_transform(tmp_path: Path) -> None:
    path = tmp_path / "alpha.mcap"
    raw = np.rint(plane_depth(DEPTH_CAMERA, T_CAMERA_DEPTH) * 5000).astype(np.uint16)
    picture = png(np.zeros((WIDE.height, WIDE.width, 3), np.uint8))

    def write(without: str = "", transforms: int = 1) -> Path:
        with LogWriter(path, "alpha") as log:
            log.channel("/alpha/depth_camera/depth", topics.RAW_DEPTH.schema, {"depth_scale": "0.0002"})
            rows = [
                (CALIBRATION, m.pack_calibration(0, "alpha", WIDE)),
                (COLOR, m.pack_color(0, "alpha", picture, "png")),
                ("/alpha/depth_camera/calibration", m.pack_calibration(0, "alpha", DEPTH_CAMERA)),
                ("/alpha/depth_camera/depth", m.pack_depth(0, "alpha", raw)),
            ]
            for k in range(transforms):
                T = T_CAMERA_DEPTH @ se3.exp([0.1 * k, 0, 0, 0, 0, 0])
                transform = m.pack_transform(0, "alpha/camera", "alpha/depth_camera", T)
                rows.append(("/alpha/depth_camera/transform", transform))
            for topic, message in rows:
                if topic != without:
                    log.write(topic, message, 0)
        return path

    with open_rgbd(write()) as log:
        frame = log.frame(0)
    truth = plane_depth(WIDE, np.eye(4))
    np.testing.assert_allclose(frame.depth[6:-6, 6:-6], truth[6:-6, 6:-6], rtol=3e-3)
    for without in ("/alpha/depth_camera/calibration", "/alpha/depth_camera/transform"):
        with pytest.raises(DuagError, match=f"{without} has no message"):
            open_rgbd(write(without))
    with pytest.raises(DuagError, match="/alpha/depth_camera/transform changes"):
        open_rgbd(write(transforms=2))


def test_points_without_coordinates_are_one_line() -> None:
    message = m.pack_points(0, "alpha/lidar", np.zeros((2, 3)))
    assert m.unpack_points(message, "here").shape == (2, 3)
    del message.fields[2]
    with pytest.raises(DuagError, match=r"here has fields \['x', 'y'\]"):
        m.unpack_points(message, "here")


# --- motion by other sensors -----------------------------------------------------------------------------------------


def spin(time_s: float) -> np.ndarray:
    """T_odometry_camera of a constant twist."""
    return se3.exp(np.array([0.3, -0.1, 0.2, 0.4, 0.7, -0.5]) * time_s)


def test_odometry_prior_is_interpolated_and_has_limits(tmp_path: Path) -> None:
    path = write_camera(tmp_path / "alpha.mcap")
    assert open_rgbd(path).motion_prior() is None
    times = [*range(0, 10**9, 100_000_000), 2 * 10**9]
    with LogWriter(tmp_path / "b.mcap", "alpha") as log:
        copy_camera(path, log, 0)
        for time in times:
            log.write(
                "/alpha/odometry_prior", m.pack_pose_in_frame(time, "odometry", spin(time * 1e-9)), time
            )
    prior = open_rgbd(tmp_path / "b.mcap").motion_prior()
    assert prior is not None
    for start, stop in ((0, 900_000_000), (130_000_000, 470_000_000), (200_000_000, 233_000_000)):
        motion = prior.between(start, stop)
        assert motion is not None
        assert motion.knows_translation
        np.testing.assert_allclose(motion.T_start_stop, spin((stop - start) * 1e-9), atol=1e-9)
    for start, stop in ((0, 1_500_000_000), (500_000_000, 2_100_000_000)):  # a gap, and beyond the end
        assert prior.between(start, stop) is None


def test_gyro_prior_turns_as_the_camera_does(tmp_path: Path) -> None:
    """An IMU that is mounted askew, at 200 Hz, with a rate that changes."""
    path = write_camera(tmp_path / "alpha.mcap")
    T_camera_imu = se3.exp([0.1, 0, 0, 0.5, -1.0, 0.3])
    times = list(range(0, 600_000_000, 5_000_000))
    rates = [np.array([0.5, -1.0, 0.2]) * (1 + time * 1e-9) for time in times]

    def write(transform: bool) -> Path:
        with LogWriter(tmp_path / "b.mcap", "alpha") as log:
            copy_camera(path, log, 0)
            if transform:
                log.write(
                    "/alpha/imu/transform", m.pack_transform(0, "alpha/camera", "alpha/imu", T_camera_imu), 0
                )
            for time, rate in zip(times, rates, strict=True):
                own = T_camera_imu[:3, :3].T @ rate
                log.write("/alpha/imu", m.pack_imu(time, "alpha", own, [0, 9.8, 0]), time)
        return tmp_path / "b.mcap"

    prior = open_rgbd(write(True)).motion_prior()
    assert prior is not None
    motion = prior.between(102_000_000, 411_000_000)
    assert motion is not None
    assert not motion.knows_translation
    turned = np.array([0.5, -1.0, 0.2]) * (0.309 + 0.5 * (0.411**2 - 0.102**2))  # the axis is constant
    np.testing.assert_allclose(motion.T_start_stop, se3.exp([0, 0, 0, *turned]), atol=1e-4)
    assert prior.between(102_000_000, 700_000_000) is None
    with pytest.raises(DuagError, match="/alpha/imu/transform has no message"):
        open_rgbd(write(False)).motion_prior()


def copy_camera(source: Path, log: LogWriter, time: int) -> None:
    """The images of a camera log, all at one log time."""
    log.channel(DEPTH, topics.DEPTH.schema, {"depth_scale": "0.001"})
    for record in read_log(source):
        log.write(record.topic, record.proto(), time, record.publish_time_ns)


# --- recordings -------------------------------------------------------------------------------------------------------


def write_robot(robot: RobotWriter, frames: int, exact: bool = False) -> None:
    for index in range(frames):
        T_world_camera = se3.exp([0.1 * index, 0, 0, 0, 0, 0.01 * index])
        truth = depth(50 + index) if exact else None
        robot.add_frame(index * FRAME_NS, png(image(index)), "png", depth(index), T_world_camera, truth)


def write_recording(out: Path, robots: int = 2, frames: int = 3, **arguments: Any) -> Path:
    with RecordingWriter(out, source={"dataset": "test"}, converter="test", **arguments) as recording:
        for name in robot_names(robots):
            with recording.robot(name, CAMERA, 0.001) as robot:
                write_robot(robot, frames)
    return out


def test_a_recording_reads_back(tmp_path: Path) -> None:
    recording = Recording(write_recording(tmp_path / "rec"))
    assert recording.name == "rec"
    assert recording.robots == ["alpha", "bravo"]
    assert len(open_rgbd(recording.log("bravo"))) == 3
    truth = recording.groundtruth("alpha")
    assert truth is not None
    poses = [m.unpack_pose_in_frame(r.proto()) for r in read_log(truth, ["/alpha/groundtruth/pose"])]
    np.testing.assert_allclose(
        poses, [se3.exp([0.1 * i, 0, 0, 0, 0, 0.01 * i]) for i in range(3)], atol=1e-14
    )
    assert not any("groundtruth" in r.topic for r in read_log(recording.log("alpha")))
    truth.unlink()
    assert recording.groundtruth("alpha") is None  # optional even where it is listed
    with pytest.raises(DuagError, match="expected 'charlie' among them"):
        recording.log("charlie")


def test_robots_written_apart_make_the_same_recording(tmp_path: Path) -> None:
    """As parallel workers do: one RobotWriter each, in any order."""
    together = write_recording(tmp_path / "a" / "rec")
    with RecordingWriter(tmp_path / "b" / "rec", source={"dataset": "test"}, converter="test") as recording:
        for name in reversed(robot_names(2)):
            with RobotWriter(recording.folder, name, CAMERA, 0.001) as robot:
                write_robot(robot, 3)
            recording.add(json.loads(json.dumps(robot.summary)))  # plain enough to cross processes
    for path in sorted(together.iterdir()):
        assert path.read_bytes() == (tmp_path / "b" / "rec" / path.name).read_bytes(), path.name


def test_exact_depth_and_geometry_lie_apart(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "rec") as writer:
        with writer.robot("alpha", CAMERA, 0.0002, {"depth_noise": "kinect"}) as robot:
            write_robot(robot, 2, exact=True)
        writer.add_geometry(lambda path: path.write_text("ply\n") and None)
    recording = Recording(tmp_path / "rec")
    truth = recording.groundtruth("alpha")
    assert truth is not None
    exact = [m.unpack_depth(r.proto(), "") for r in read_log(truth, ["/alpha/groundtruth/depth"])]
    assert np.array_equal(exact, [depth(50), depth(51)])
    assert recording.geometry() == tmp_path / "rec" / "groundtruth.ply"
    assert log_metadata(recording.log("alpha")) == {"robot": "alpha", "depth_noise": "kinect"}


def test_an_unfinished_recording_leaves_nothing(tmp_path: Path) -> None:
    def write_and_fail(error: type[BaseException]) -> None:
        with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
            write_robot(robot, 1)
            raise error

    for error in (RuntimeError, KeyboardInterrupt):
        with pytest.raises(error):
            write_and_fail(error)
        assert list(tmp_path.iterdir()) == []
    with pytest.raises(DuagError, match="no robot"), RecordingWriter(tmp_path / "rec"):
        pass
    with (
        pytest.raises(DuagError, match="no frame"),
        RecordingWriter(tmp_path / "rec") as recording,
        recording.robot("alpha", CAMERA, 0.001),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_existing_outputs_are_kept(tmp_path: Path) -> None:
    out = write_recording(tmp_path / "rec", robots=1)
    with pytest.raises(DuagError, match="exists already"):
        write_recording(out)
    assert Recording(out).robots == ["alpha"]
    write_recording(out, robots=2, force=True)
    assert Recording(out).robots == ["alpha", "bravo"]
    other = tmp_path / "precious"
    other.mkdir()
    (other / "file").write_text("x")
    with pytest.raises(DuagError, match="--force replaces nothing else"):
        write_recording(other, force=True)
    assert (other / "file").read_text() == "x"


def test_bugs_of_converters_are_errors(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "rec") as recording, recording.robot("alpha", CAMERA, 0.001) as robot:
        robot.add_frame(5, png(image(0)), "png", depth(0))
        for stamp, kind, array in ((5, "png", depth(0)), (6, "bmp", depth(0)), (6, "png", depth(0).T)):
            with pytest.raises(ValueError, match=r"expected|comes after"):
                robot.add_frame(stamp, b"", kind, array)
    with pytest.raises(DuagError, match="robot 'A b'"):
        RobotWriter(tmp_path, "A b", CAMERA, 0.001)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("not json", "expected the JSON of a recording"),
        ("[]", "format is 'list'"),
        ({"format": "other"}, "format is 'other'"),
        ({"schema": 99}, "schema is 99, expected 1"),
        ({"robots": {}}, "no robots"),
        ({"robots": {"alpha": {}}}, "'alpha' has no log"),
        ({"robots": {"../alpha": {"log": "alpha.mcap"}}}, "robot '../alpha'"),
        ({"robots": {"alpha": {"log": "../alpha.mcap"}}}, "alpha.log is '../alpha.mcap'"),
        ({"robots": {"alpha": {"log": "a.mcap", "groundtruth": 5}}}, "alpha.groundtruth is 5"),
        ({"geometry": "/etc/passwd"}, "geometry is '/etc/passwd'"),
    ],
)
def test_broken_descriptions_are_one_line(tmp_path: Path, change: str | dict[str, Any], words: str) -> None:
    path = write_recording(tmp_path / "rec", robots=1, frames=1) / "recording.json"
    path.write_text(
        change if isinstance(change, str) else json.dumps({**json.loads(path.read_text()), **change})
    )
    with pytest.raises(DuagError, match=r"recording\.json") as caught:
        Recording(path.parent)
    assert words in str(caught.value)


def test_missing_parts_of_a_recording(tmp_path: Path) -> None:
    with pytest.raises(DuagError, match=r"recording\.json: no such file"):
        Recording(tmp_path)
    out = write_recording(tmp_path / "rec", robots=1)
    (out / "alpha.mcap").unlink()
    with pytest.raises(DuagError, match=r"alpha\.mcap: no such file"):
        Recording(out).log("alpha")


# --- info -------------------------------------------------------------------------------------------------------------


def test_info_of_a_recording(tmp_path: Path) -> None:
    content = info(write_recording(tmp_path / "rec", frames=4))
    alpha = content["robots"]["alpha"]
    assert (content["kind"], alpha["frames"], alpha["messages"]) == ("recording", 4, 9)
    assert alpha["topics"][COLOR]["rate_hz"] == pytest.approx(30, rel=1e-6)
    assert alpha["topics"][DEPTH]["metadata"] == {"depth_scale": "0.001"}
    assert alpha["path"]["high_m"][0] == pytest.approx(0.3, rel=1e-3)  # the path is slightly bent
    assert content["warnings"] == []
    assert json.loads(json.dumps(content)) == content
    assert "alpha: 4 frames in 0.10 s" in format_info(content)


def test_info_tells_gaps_and_exchanged_logs(tmp_path: Path) -> None:
    out = write_recording(tmp_path / "rec", robots=1)
    write_camera(out / "alpha.mcap", 9, skip_color=(4, 5), skip_depth=(4, 5))
    (out / "alpha.groundtruth.mcap").unlink()
    content = info(out)
    text = format_info(content)
    assert f"{COLOR}: 1 gaps, the longest 0.100 s" in text
    assert "alpha.mcap has digest" in text
    assert content["robots"]["alpha"]["groundtruth"] is None


def test_info_of_logs_and_runs(tmp_path: Path) -> None:
    (tmp_path / "robots").mkdir()
    digest = write_updates(tmp_path / "robots" / "frontend.mcap", "alpha", [0, 10**9, 2 * 10**9])
    log = info(tmp_path / "robots" / "frontend.mcap")
    assert (log["kind"], log["robot"], log["messages"], log["digest"]) == ("log", "alpha", 3, digest)
    assert log["topics"]["/alpha/map_update"]["rate_hz"] == pytest.approx(1.0)
    run = info(tmp_path)
    assert (run["kind"], list(run["logs"])) == ("run", ["robots/frontend.mcap"])
    assert digest in format_info(log)
    assert digest in format_info(run)
    with pytest.raises(DuagError, match="no such file"):
        info(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DuagError, match="a folder without logs"):
        info(tmp_path / "empty")


# --- other programs ---------------------------------------------------------------------------------------------------


def test_rerun_reads_our_files(tmp_path: Path) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    recording = Recording(write_recording(tmp_path / "rec", robots=1))
    seen: dict[str, set[str]] = {}
    for path in (recording.log("alpha"), recording.groundtruth("alpha")):
        for piece in chunk.McapReader(path).stream():
            seen.setdefault(piece.entity_path, set()).update(piece.to_record_batch().schema.names)
    assert "EncodedImage:blob" in seen[COLOR]
    assert "Image:buffer" in seen[DEPTH]
    assert "Pinhole:image_from_camera" in seen[CALIBRATION]
    assert "InstancePoses3D:translations" in seen["/alpha/groundtruth/pose"]


def test_rerun_reads_our_own_messages(tmp_path: Path) -> None:
    """By reflection on the schema that the log carries."""
    chunk = pytest.importorskip("rerun.chunk")
    write_updates(tmp_path / "alpha.mcap", "alpha", [0, 1])
    names = {
        n
        for c in chunk.McapReader(tmp_path / "alpha.mcap").stream()
        for n in c.to_record_batch().schema.names
    }
    assert "duagc.v1.MapUpdate:message" in names


def test_logs_of_other_programs_are_listed() -> None:
    paths = sorted(LOGS.glob("*.mcap"))
    if not paths:
        pytest.skip("needs ../shared/data/logs")
    for path in paths:
        content = info(path)
        assert content["messages"] == sum(1 for _ in read_log(path)) > 0
        assert len(content_digest(path)) == 64
        with pytest.raises(DuagError, match="expected exactly one robot"):
            open_rgbd(path)
