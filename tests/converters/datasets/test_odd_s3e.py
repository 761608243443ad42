"""Bags of S3E in which images are broken or have no time, and calibrations and options that cannot be."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from duagc.converters import registry
from duagc.converters.layouts.stereo import StereoOptions, StereoRig
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import Recording, open_rgbd
from tests.fixtures.s3e import (
    FRAMES,
    START_NS,
    STEP_NS,
    change_messages,
    cut_message,
    write_bag,
    write_calibration,
)

LEFT, RIGHT, IMU = "/Alpha/left_camera/compressed", "/Alpha/right_camera/compressed", "/Alpha/imu/data"
POINTS = "/Alpha/velodyne_points"
Change = Callable[[int, Any], None]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("S3Ev1")
    write_bag(root / "S3E_Playground_2", ("Alpha",))
    write_calibration(root / "Calibration" / "alpha.yaml", "alpha")
    return root


@pytest.fixture
def sequence(made: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    shutil.copytree(made, tmp_path / "S3Ev1")
    return tmp_path / "S3Ev1" / "S3E_Playground_2"


def converted(sequence: Path, *options: str) -> Recording:
    out = sequence.parent / "recording"
    registry.convert("s3e", sequence, out, options=["shrink=1", *options])
    return Recording(out)


def cut(numbers: range) -> Change:
    def change(number: int, message: Any) -> None:
        if number in numbers:
            message.data = message.data[:50]

    return change


def without_time(number: int, message: Any) -> None:
    message.header.stamp.sec = message.header.stamp.nanosec = 0


@pytest.mark.parametrize(("topic", "depth"), [(LEFT, "stereo"), (RIGHT, "stereo"), (LEFT, "lidar")])
def test_a_broken_image_costs_its_frame_alone(sequence: Path, topic: str, depth: str) -> None:
    change_messages(sequence, topic, "CompressedImage", cut(range(1, 2)))
    recording = converted(sequence, f"depth={depth}")
    stamps = [START_NS + k * STEP_NS for k in range(FRAMES) if k != 1]
    with open_rgbd(recording.log("alpha")) as log:
        assert [frame.stamp_ns for frame in log.frames()] == stamps
    assert any(
        "1 frames have images that are cut short" in text for text in recording.description["warnings"]
    )


@pytest.mark.parametrize(
    ("depth", "kept", "words"),
    [("stereo", range(FRAMES), "that test the scale of stereo "), ("lidar", [0, 2], "")],
)
def test_a_sweep_that_is_cut_short_costs_no_more_than_it_gives(
    sequence: Path, depth: str, kept: Sequence[int], words: str
) -> None:
    change_messages(sequence, POINTS, "PointCloud2", cut(range(1, 2)))
    recording = converted(sequence, f"depth={depth}")
    with open_rgbd(recording.log("alpha")) as log:
        assert [frame.stamp_ns for frame in log.frames()] == [START_NS + k * STEP_NS for k in kept]
    warning = f"alpha (Alpha): 1 frames {words}have a sweep that is cut short; left out"
    assert warning in recording.description["warnings"]


@pytest.mark.parametrize("left", [5, 22])
@pytest.mark.parametrize(
    ("topic", "depth", "kept"),
    [
        (LEFT, "stereo", [0, 2]),
        (RIGHT, "stereo", [0, 2]),
        (POINTS, "stereo", range(FRAMES)),
        (POINTS, "lidar", [0, 2]),
        (IMU, "stereo", range(FRAMES)),
    ],
)
def test_a_message_that_is_none_costs_itself(
    sequence: Path, topic: str, depth: str, kept: Sequence[int], left: int
) -> None:
    """Its bytes end in its header, or behind it."""
    count = cut_message(sequence, topic, 1, left)
    recording = converted(sequence, f"depth={depth}")
    with open_rgbd(recording.log("alpha")) as log:
        assert [frame.stamp_ns for frame in log.frames()] == [START_NS + k * STEP_NS for k in kept]
    start = f"alpha (Alpha): {topic}: 1 of {count} messages left out; the first, recorded at 16"
    assert [text for text in recording.description["warnings"] if text.startswith(start)]


@pytest.mark.parametrize("left", [5, 22])
@pytest.mark.parametrize("topic", [LEFT, RIGHT, IMU])
def test_most_of_a_topic_is_refused(sequence: Path, topic: str, left: int) -> None:
    for number in range(30):
        cut_message(sequence, topic, number, left)
    with pytest.raises(DuagError, match=rf"{topic} holds {left} bytes.*; so it is with \d+ of its \d+ mess"):
        converted(sequence)


def test_sweeps_that_are_all_cut_short_are_refused(sequence: Path) -> None:
    change_messages(sequence, POINTS, "PointCloud2", cut(range(FRAMES)))
    with pytest.raises(DuagError, match=r"velodyne_points has fields .* and 50 bytes for"):
        converted(sequence, "depth=lidar")


def test_broken_images_alone_are_refused(sequence: Path) -> None:
    change_messages(sequence, LEFT, "CompressedImage", cut(range(FRAMES)))
    with pytest.raises(DuagError, match="left_camera/compressed: 50 bytes of jpeg"):
        converted(sequence)


def test_images_without_times_are_refused(sequence: Path) -> None:
    """One frame at time 0 would be left."""
    for topic in (LEFT, RIGHT):
        change_messages(sequence, topic, "CompressedImage", without_time)
    with pytest.raises(DuagError, match=r"left_camera/compressed: all times are zero, expected times$"):
        converted(sequence)


def test_an_imu_of_another_clock_is_said(sequence: Path) -> None:
    change_messages(sequence, IMU, "Imu", without_time)
    warnings = converted(sequence).description["warnings"]
    assert (
        "alpha (Alpha): /Alpha/imu/data: its times have none in common with the images; expected one clock"
        in warnings
    )


def test_numbers_of_a_calibration_that_are_not_finite_are_named(sequence: Path) -> None:
    file = sequence.parent / "Calibration" / "alpha.yaml"
    file.write_text(file.read_text().replace("294.02", ".Nan", 1))
    with pytest.raises(
        DuagError, match=r"alpha.yaml: LEFT.K is \[\[294.09, 0.0, 155.4\], \[0.0, nan, .* all finite"
    ):
        converted(sequence)


@pytest.mark.parametrize("nearest_m", [1e-9, 0.01, 1.0])
def test_no_disparity_is_larger_than_the_image(nearest_m: float) -> None:
    camera = PinholeCamera(160, 120, 150.0, 150.0, 79.5, 59.5)
    rig = StereoRig.rectified(camera, camera, 0.3, "here", options=StereoOptions(min_depth_m=nearest_m))
    assert rig.disparities == (48 if nearest_m == 1.0 else 160)
