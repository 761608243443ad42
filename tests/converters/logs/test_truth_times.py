"""True poses whose times are not those of the images: what the user reads, and that what it names helps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from duagc.converters import registry
from duagc.converters.layouts import tum_layout
from duagc.pipeline.checks import check
from tests.fixtures.image_folders import make_tum
from tests.fixtures.ros_bags import FRAMES, START_NS, STEP_NS, Ros, scene

UPTIME_NS = START_NS - 1_000_000_000_000  # from the origin of the images' clock to that of the poses'


def log_of(folder: Path, *, poses_from_ns: int = 0, every: int = 1) -> Path:
    """Poses by a clock that counts from another time, or only some of them."""
    r, rows, count = Ros(2), [], 0
    for topic, log_ns, message in scene(r):
        if topic == "/odom":
            count += 1
            if (count - 1) % every:
                continue
            stamp_ns = log_ns - poses_from_ns
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        rows.append((topic, log_ns, message))
    return r.write(folder / "log", rows, "mcap")


def warnings_of(log: Path, out: Path, *options: str) -> list[str]:
    registry.convert("ros", log, out, options=["truth=/odom", *options])
    found = json.loads((out / "recording.json").read_text())["warnings"]
    return [text for text in found if "true pose" in text]


def test_poses_of_another_clock_are_named_with_both_spans(tmp_path: Path) -> None:
    log = log_of(tmp_path, poses_from_ns=UPTIME_NS)
    (words,) = warnings_of(log, tmp_path / "rec")
    begin, end = ((START_NS + k * STEP_NS) / 1e9 for k in (1, FRAMES))
    assert f"{FRAMES} of {FRAMES} frames have no true pose" in words
    assert (
        f"images are of {begin:.3f} to {end:.3f} s, poses of 1000.050 to 1000.200 s, 0 of {FRAMES}" in words
    )
    assert "expected one clock, or --set truth_offset_s=SECONDS to add to the poses' times" in words
    found = [f for f in check.check(tmp_path / "rec").findings if f.check == "clock"]
    assert all(finding.severity is check.Severity.WARNING for finding in found)
    assert [f"{finding.found}; expected {finding.expected}" in words for finding in found] == [False, True]
    assert found[0].found.startswith(
        f"/odom is recorded {UPTIME_NS / 1e9:.3f} s after the times of its headers"
    )
    offset = f"truth_offset_s={UPTIME_NS / 1e9}"
    assert warnings_of(log, tmp_path / "shifted", offset) == []
    stated = json.loads((tmp_path / "shifted" / "recording.json").read_text())["warnings"]
    assert not [text for text in stated if "clock" in text]
    (words,) = warnings_of(log, tmp_path / "recorded", "time_source=log")
    assert f"1 of {FRAMES} frames" in words
    assert f"poses of {begin:.3f}" in words


def test_poses_that_are_far_apart_are_named_with_their_gap(tmp_path: Path) -> None:
    log = log_of(tmp_path, every=3)
    (words,) = warnings_of(log, tmp_path / "rec")
    gaps = "2 images between poses that are 0.150 s apart; expected at most 0.1 s, or --set max_pose_gap_s="
    assert f"2 of 2 of them among the images, {gaps}" in words
    assert warnings_of(log, tmp_path / "wide", "max_pose_gap_s=0.2") == []


@pytest.mark.parametrize("late_s", [0.0, 3600.0])
def test_a_list_of_poses_of_another_clock_is_named(late_s: float, tmp_path: Path) -> None:
    src = make_tum(tmp_path)
    path = src / "groundtruth.txt"
    rows = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]
    path.write_text("".join(" ".join([f"{float(t) + late_s:.4f}", *pose]) + "\n" for t, *pose in rows))
    warnings = tum_layout.frames_of(src, tum_layout.SequenceOptions())[2]
    found = [text for text in warnings if text.startswith("no image has a true pose: images are of 13050314")]
    assert len(found) == (late_s > 0)
    assert all("0 of 30 of them among the images; expected one clock, or times of ground" in t for t in found)
