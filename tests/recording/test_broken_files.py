"""A broken file is one line, never a wrong message."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from duagc import schemas
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.recording import Record, content_digest, info, log_metadata, open_rgbd, read_log, verify
from tests.fixtures.recording_logs import update, write_camera, write_updates


def error_of(read: Callable[[Path], object], path: Path) -> str | None:
    """The line of the DuagError that `read` raises; anything else that it raises is a failure of the test."""
    try:
        read(path)
    except DuagError as error:
        return str(error)
    return None


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


def test_times_that_no_clock_shows_are_refused(tmp_path: Path) -> None:
    """Also those of publication, which the index does not tell."""
    for times in ((2**63, 0), (0, 2**63)):
        with (tmp_path / "x.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            schema = writer.register_schema("s", "", b"")
            writer.add_message(writer.register_channel("/a", "x", schema), times[0], b"", times[1])
            writer.finish()
        with pytest.raises(DuagError, match="a message is of 9223372036854775808 ns, expected less than"):
            list(read_log(tmp_path / "x.mcap"))


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
