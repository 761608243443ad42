"""Blocks of frames that were read before are kept until they are asked for, and are those of the frame read again."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.writer import RecordingWriter
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.frontend import color_blocks
from duagc.pipeline.frontend.color_blocks import BlocksOfLog, ColorBlocks
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import RgbdFrame, RgbdLog, open_rgbd

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
FRAME_NS = 100_000_000
LATE = 2  # frame whose depth is taken later
WIDTH_PX = 16


class CountingBlocks(BlocksOfLog):
    """Counts frames of which blocks are computed."""

    computed = 0

    def _of(self, frame: RgbdFrame) -> ColorBlocks:
        self.computed += 1
        return super()._of(frame)


@pytest.fixture
def log(tmp_path: Path) -> Iterator[RgbdLog]:
    rng = np.random.default_rng(0)
    with (
        RecordingWriter(tmp_path / "recording") as recording,
        recording.robot("alpha", CAMERA, 0.001, find_regions=False) as robot,
    ):
        for k in range(6):
            color = rng.integers(0, 256, (48, 64, 3)).astype(np.uint8)
            depth = rng.integers(0, 3, (12, 16)).astype(np.uint16).repeat(4, axis=0).repeat(4, axis=1) * 1000
            stamp_ns = k * FRAME_NS
            robot.add_frame(
                stamp_ns,
                cv2.imencode(".png", color)[1].tobytes(),
                "png",
                depth,
                depth_stamp_ns=stamp_ns + (FRAME_NS // 10 if k == LATE else 0),
            )
    with open_rgbd(tmp_path / "recording" / "alpha.mcap") as opened:
        yield opened


def test_blocks_of_other_depth_are_not_taken_for_those_of_a_frame(log: RgbdLog) -> None:
    """Where depth is delayed by the time between images, each image has the depth of the next one."""
    blocks = BlocksOfLog(log, WIDTH_PX)
    blocks.keep(log.frame(3))
    log.delay_depth(FRAME_NS)
    assert log.frame_offset_ns(3) == 0
    assert_equal(blocks.of(3), ColorBlocks.of(log.frame(3), log.camera, WIDTH_PX))


def assert_equal(found: ColorBlocks, expected: ColorBlocks) -> None:
    assert found.camera == expected.camera
    np.testing.assert_array_equal(found.color, expected.color)
    np.testing.assert_array_equal(found.inverse_depth, expected.inverse_depth)


def test_blocks_that_are_kept_are_those_of_the_frame(log: RgbdLog) -> None:
    blocks = CountingBlocks(log, WIDTH_PX)
    for frame in log.frames():
        blocks.keep(frame)
    kept = sum(not is_held_out(k) for k in range(6) if k != LATE)
    assert blocks.computed == kept
    for k in range(6):
        assert_equal(blocks.of(k), ColorBlocks.of(log.frame(k), CAMERA, WIDTH_PX))
    assert blocks.computed == kept + (6 - kept)  # those alone are read again that were not kept
    assert_equal(blocks.of(0), ColorBlocks.of(log.frame(0), CAMERA, WIDTH_PX))  # nor are they kept for longer
    assert blocks.computed == 7


def test_blocks_are_forgotten_where_depth_turns_out_to_be_late(log: RgbdLog) -> None:
    blocks = CountingBlocks(log, WIDTH_PX)
    blocks.keep(log.frame(0))
    blocks.keep(log.frame(1))
    log.delay_depth(FRAME_NS // 5)
    assert_equal(blocks.of(1), ColorBlocks.of(log.frame(1), CAMERA, WIDTH_PX))
    assert blocks.computed == 3
    log.delay_depth(0)
    blocks.forget([0, 1])
    blocks.of(0)
    assert blocks.computed == 4


def test_so_many_are_kept_as_have_room(log: RgbdLog, monkeypatch: pytest.MonkeyPatch) -> None:
    of_one = ColorBlocks.of(log.frame(0), CAMERA, WIDTH_PX).nbytes
    assert of_one == 16 * 12 * 4 * 4
    monkeypatch.setattr(color_blocks, "MOST_KEPT_BYTES", 2 * of_one)
    blocks = CountingBlocks(log, WIDTH_PX)
    for frame in log.frames():
        blocks.keep(frame)
    assert blocks.computed == 2
    blocks.forget([0])
    blocks.keep(log.frame(3))
    assert blocks.computed == 3


def test_clipped_colors_are_no_colors() -> None:
    color = np.repeat(np.arange(256, dtype=np.uint8).reshape(16, 16), 3).reshape(16, 16, 3)
    camera = PinholeCamera(16, 16, 16.0, 16.0, 7.5, 7.5)
    found = ColorBlocks.of(RgbdFrame(0, 0, color, np.ones((16, 16), np.float32)), camera, 16).color
    low, high = color_blocks.CLIPPED
    clipped = (color < low) | (color > high)
    np.testing.assert_array_equal(np.isnan(found), clipped)
    np.testing.assert_array_equal(found[~clipped], (color * np.float32(1 / 255))[~clipped])
