"""Our logs in other programs, and theirs in ours."""

from pathlib import Path

import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.recording import Recording, content_digest, info, open_rgbd, read_log
from tests.fixtures.recording_logs import CALIBRATION, COLOR, DEPTH, LOGS, write_recording, write_updates


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
