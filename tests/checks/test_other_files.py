"""Advice about files that are no log of a robot's camera."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.pipeline import messages as m
from duagc.pipeline.checks import check
from duagc.pipeline.recording import LogWriter
from duagc.schemas import topics


@pytest.mark.parametrize(
    ("name", "content", "advice"),
    [
        ("alpha.mcap", b"", ""),
        ("alpha.mcap", b"not a log at all" * 10, ""),
        ("alpha.bag", b"#ROSBAG V2.0\n", "duagc convert ros makes a recording of it"),
    ],
)
def test_what_is_no_log_is_not_to_be_recovered(
    tmp_path: Path, name: str, content: bytes, advice: str
) -> None:
    (tmp_path / name).write_bytes(content)
    (finding,) = check.check(tmp_path / name).findings
    assert (finding.severity, finding.advice) == ("error", advice)


def test_a_check_leaves_no_thread_of_opencv_behind(tmp_path: Path) -> None:
    """A copy of the process would wait for it, and loops of several threads need not keep their order."""
    cv2.setNumThreads(2)
    (tmp_path / "alpha.mcap").touch()
    check.check(tmp_path / "alpha.mcap")
    assert cv2.getNumThreads() == 1


def test_a_sound_log_without_a_camera_is_not_to_be_recovered(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "alpha.mcap", "alpha") as log:
        reading = m.pack_imu(0, "alpha", np.zeros(3), np.array([0.0, 0.0, 9.8]))
        log.write(topics.IMU.of("alpha"), reading, 0)
    (finding,) = [f for f in check.check(tmp_path / "alpha.mcap").findings if f.severity == "error"]
    assert "expected exactly one robot" in finding.line()
    assert finding.advice == "duagc info says what is in it"
