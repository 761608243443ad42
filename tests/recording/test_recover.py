"""Damaged logs: every message that is whole comes back as it was, and nothing else does."""

from __future__ import annotations

import errno
import json
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from typer.testing import CliRunner

from duagc.converters.writer import RecordingWriter
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.checks import check
from duagc.pipeline.cli import app
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import LogWriter, Record, Recording, content_digest, read_log, recovery
from tests.fixtures.recording_logs import COLOR, FRAME_NS, png, update

BLOBS = 12


def long_log(path: Path) -> list[Record]:
    """A log of some chunks with incompressible messages and one topic more."""
    rng = np.random.default_rng(0)
    with LogWriter(path, "alpha", {"note": "x"}) as log:
        for index in range(BLOBS):
            log.write(COLOR, m.pack_color(index, "alpha", rng.bytes(300_000), "jpeg"), index)
            log.write("/alpha/map_update", update("alpha", index), index)
    return list(read_log(path))


def large_recording(out: Path) -> Path:
    """Two robots with images that do not compress: some blocks of the compressor in every log."""
    camera = PinholeCamera(320, 240, 300.0, 300.0, 159.5, 119.5)
    rng = np.random.default_rng(0)
    with RecordingWriter(out) as recording:
        for name in ("alpha", "bravo"):
            with recording.robot(name, camera, 0.001, {"depth": "noise"}) as robot:
                for index in range(9):
                    color = png(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8))
                    depth = rng.integers(0, 5000, (240, 320), dtype=np.uint16)
                    robot.add_frame(index * FRAME_NS, color, "png", depth, T_world_camera=np.eye(4))
    return out


def key(record: Record) -> tuple[str, int, int, int, bytes]:
    return record.topic, record.log_time_ns, record.publish_time_ns, record.sequence, record.data


def chunks_of(data: bytes) -> list[tuple[int, int]]:
    """Beginning and end of the chunks of a log."""
    at, found = 8, []
    while at < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == 6:
            found.append((at, at + 9 + length))
        at += 9 + length
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Record]]:
    path = tmp_path_factory.mktemp("log") / "alpha.mcap"
    return path, long_log(path)


def test_a_sound_log_comes_back_the_same(whole: tuple[Path, list[Record]], tmp_path: Path) -> None:
    (salvage,) = recovery.recover(whole[0], tmp_path / "x.mcap")
    assert salvage.whole
    assert content_digest(tmp_path / "x.mcap") == content_digest(whole[0]) == salvage.digest
    assert (tmp_path / "x.mcap").read_bytes() == whole[0].read_bytes()


@pytest.mark.parametrize("part", [0.05, 0.3, 0.5, 0.7, 0.95, 0.999])
def test_a_cut_log_keeps_all_before_the_cut(
    whole: tuple[Path, list[Record]], tmp_path: Path, part: float
) -> None:
    path, records = whole
    data = path.read_bytes()
    cut = int(part * len(data))
    (tmp_path / "cut.mcap").write_bytes(data[:cut])
    if cut < 310_000:  # not even the first message
        with pytest.raises(DuagError, match="no message that is whole"):
            recovery.recover(tmp_path / "cut.mcap", tmp_path / "x.mcap")
        assert [p.name for p in tmp_path.iterdir()] == ["cut.mcap"]
        return
    (salvage,) = recovery.recover(tmp_path / "cut.mcap", tmp_path / "x.mcap")
    assert not salvage.whole
    assert (tmp_path / "cut.mcap").read_bytes() == data[:cut]
    back = list(read_log(tmp_path / "x.mcap"))
    assert [key(r) for r in back] == [key(r) for r in records[: len(back)]]
    behind = sum(len(r.data) for r in records[len(back) :])
    assert behind < len(data) - cut + 310_000 + (1 << 17)  # of the message in the cut; zstd works in blocks


def test_a_damaged_chunk_is_left_out_and_counted(whole: tuple[Path, list[Record]], tmp_path: Path) -> None:
    path, records = whole
    data = path.read_bytes()
    for start, end in chunks_of(data):
        broken = bytearray(data)
        broken[(start + end) // 2] ^= 16
        (tmp_path / "broken.mcap").write_bytes(broken)
        (salvage,) = recovery.recover(tmp_path / "broken.mcap", tmp_path / "x.mcap", force=True)
        assert not salvage.whole
        assert len(salvage.damage) == 1
        back = [key(r) for r in read_log(tmp_path / "x.mcap")]
        assert set(back) < {key(r) for r in records}
        assert len(records) - len(back) <= 10
        assert salvage.lost == len(records) - len(back) > 0


@pytest.mark.parametrize("place", [0, 4], ids=["kind", "length"])
def test_a_chunk_whose_head_is_damaged_costs_itself_at_most(
    whole: tuple[Path, list[Record]], tmp_path: Path, place: int
) -> None:
    path, records = whole
    data = path.read_bytes()
    for start, _ in chunks_of(data):
        for bit in range(8):
            broken = bytearray(data)
            broken[start + place] ^= 1 << bit
            (tmp_path / "broken.mcap").write_bytes(broken)
            (salvage,) = recovery.recover(tmp_path / "broken.mcap", tmp_path / "x.mcap", force=True)
            back = [key(r) for r in read_log(tmp_path / "x.mcap")]
            assert set(back) <= {key(r) for r in records}
            assert len(records) - len(back) <= 10
            assert salvage.damage
            assert not salvage.cut
            assert salvage.lost == len(records) - len(back)


def test_records_are_found_again_after_garbage(whole: tuple[Path, list[Record]], tmp_path: Path) -> None:
    """The length of a record is destroyed, and a hole of zeros is where another was."""
    path, records = whole
    data = bytearray(path.read_bytes())
    places = chunks_of(bytes(data))
    data[places[0][0] + 1 : places[0][0] + 9] = b"\xff" * 8
    data[places[2][0] : places[2][0] + 5000] = bytes(5000)
    (tmp_path / "broken.mcap").write_bytes(data)
    (salvage,) = recovery.recover(tmp_path / "broken.mcap", tmp_path / "x.mcap")
    back = [key(r) for r in read_log(tmp_path / "x.mcap")]
    assert set(back) < {key(r) for r in records}
    assert len(back) >= len(records) - 20
    assert not salvage.cut
    assert len(salvage.damage) == 2


def test_an_index_that_is_lost_is_made_again(whole: tuple[Path, list[Record]], tmp_path: Path) -> None:
    path, records = whole
    data = path.read_bytes()
    end = chunks_of(data)[-1][1]
    for cut in (end, end + 60):
        (tmp_path / "cut.mcap").write_bytes(data[:cut])
        recovery.recover(tmp_path / "cut.mcap", tmp_path / "x.mcap", force=True)
        assert [key(r) for r in read_log(tmp_path / "x.mcap")] == [key(r) for r in records]
    broken = bytearray(data)
    broken[-20] ^= 1
    (tmp_path / "cut.mcap").write_bytes(broken)
    (salvage,) = recovery.recover(tmp_path / "cut.mcap", tmp_path / "y.mcap")
    assert content_digest(tmp_path / "y.mcap") == content_digest(path)
    assert (salvage.lost, salvage.cut) == (0, False)


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4])
def test_logs_of_other_programs(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1000, compression=compression)
        writer.start(library="another")
        channel = writer.register_channel("/thing", "json", 0)
        for index in range(50):
            writer.add_message(channel, 50 - index, b"%d" % index * 100, index, 7)
        writer.finish()
    data = path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    (salvage,) = recovery.recover(tmp_path / "cut.mcap", tmp_path / "x.mcap")
    assert salvage.lost == 0
    assert salvage.messages > 10
    numbers = sorted(int(r.publish_time_ns) for r in read_log(tmp_path / "x.mcap"))
    assert numbers == list(range(salvage.messages))


def test_a_recording_is_recovered_as_a_whole(tmp_path: Path) -> None:
    rec = large_recording(tmp_path / "rec")
    data = (rec / "alpha.mcap").read_bytes()
    (rec / "alpha.mcap").write_bytes(data[: int(0.55 * len(data))])
    result = CliRunner().invoke(app, ["recover", str(rec), "--out", str(tmp_path / "saved")])
    assert result.exit_code == 3
    assert "and all after the cut" in result.stdout
    saved = Recording(tmp_path / "saved")
    assert saved.robots == ["alpha", "bravo"]
    assert 0 < saved.description["robots"]["alpha"]["frames"] < 9
    assert saved.description["robots"]["bravo"] == Recording(rec).description["robots"]["bravo"]
    assert not [f for f in check.check(saved.path).findings if f.check in ("log", "digest")]
    assert any("recovered: alpha.mcap" in text for text in saved.description["warnings"])
    assert (rec / "alpha.mcap").stat().st_size == int(0.55 * len(data))
    with pytest.raises(DuagError, match="exists already"):
        recovery.recover(rec, tmp_path / "saved")


def test_a_description_that_is_lost_is_a_loss(tmp_path: Path) -> None:
    rec = large_recording(tmp_path / "rec")
    (rec / "recording.json").unlink()
    (rec / "groundtruth.ply").write_bytes(b"ply")
    result = CliRunner().invoke(app, ["recover", str(rec), "--out", str(tmp_path / "saved")])
    assert result.exit_code == 3
    assert "recording.json: made again from the logs" in result.stdout
    assert "groundtruth.ply: is not carried over" in result.stdout
    assert Recording(tmp_path / "saved").robots == ["alpha", "bravo"]


def test_a_robot_whose_log_holds_nothing_is_said_to_be_lost(tmp_path: Path) -> None:
    rec = large_recording(tmp_path / "rec")
    (rec / "alpha.mcap").write_bytes(b"garbage")
    result = CliRunner().invoke(app, ["recover", str(rec), "--out", str(tmp_path / "saved")])
    assert result.exit_code == 3
    assert "alpha.mcap: 0 messages" in result.stdout
    assert Recording(tmp_path / "saved").robots == ["bravo"]


def test_a_disk_that_is_full_saves_no_half(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rec = large_recording(tmp_path / "rec")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(recovery.os, "replace", full)
    with pytest.raises(DuagError, match="No space left on device"):
        recovery.recover(rec, tmp_path / "saved")
    assert not (tmp_path / "saved").exists()


def test_a_conversion_that_was_killed_is_saved(tmp_path: Path) -> None:
    """Without recording.json, with a log that has not its name yet."""
    rec = large_recording(tmp_path / "rec")
    description = json.loads((rec / "recording.json").read_text())
    (rec / "recording.json").unlink()
    part = rec / "bravo.mcap.part"
    shutil.move(rec / "bravo.mcap", part)
    part.write_bytes(part.read_bytes()[:-300_000])
    (rec / "bravo.groundtruth.mcap").write_bytes(b"nothing")
    recovery.recover(rec, tmp_path / "saved")
    saved = Recording(tmp_path / "saved")
    assert saved.description["robots"]["alpha"]["digests"] == description["robots"]["alpha"]["digests"]
    assert saved.description["robots"]["alpha"]["camera"] == description["robots"]["alpha"]["camera"]
    assert saved.groundtruth("bravo") is None
    assert saved.description["robots"]["bravo"]["frames"] > 0
    assert any("bravo.groundtruth.mcap is lost" in text for text in saved.description["warnings"])


@pytest.mark.parametrize("shorter", ["bravo.mcap", "bravo.mcap.part"])
def test_of_two_logs_of_one_name_the_longer_one_is_kept(tmp_path: Path, shorter: str) -> None:
    """What a program left that was killed while it wrote the log anew does not replace the log."""
    rec = large_recording(tmp_path / "rec")
    data, digest = (rec / "bravo.mcap").read_bytes(), content_digest(rec / "bravo.mcap")
    for name in ("bravo.mcap", "bravo.mcap.part"):
        (rec / name).write_bytes(data[: len(data) // 2] if name == shorter else data)
    found = {salvage.path: salvage for salvage in recovery.recover(rec, tmp_path / "saved")}
    assert content_digest(tmp_path / "saved" / "bravo.mcap") == digest
    assert min(salvage.messages for salvage in found.values()) == found[shorter].messages > 0
    assert "is not carried over" in found[shorter].line()


def test_what_holds_nothing_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(1000))
    (tmp_path / "empty").mkdir()
    for source, words in (("x.mcap", "no message"), ("empty", "no log"), ("none", "no such file")):
        with pytest.raises(DuagError, match=words):
            recovery.recover(tmp_path / source, tmp_path / "out")
    assert not (tmp_path / "out").exists()
