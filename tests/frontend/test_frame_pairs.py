"""Frames that several estimates compare are read once, as far as memory allows, and are those that the log reads."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline.config.motion_times import DelayConfig, ReadoutConfig
from duagc.pipeline.frontend.depth_delay import certain_delay_ns
from duagc.pipeline.frontend.frame_pairs import FramePairs
from duagc.pipeline.frontend.readout_time import certain_readout
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import RgbdFrame, RgbdLog
from duagc.pipeline.recording.rolling_shutter import Readout
from tests.fixtures.carried_camera import FRAME_NS, true_path, walk, write
from tests.fixtures.room import CAMERA, render

FRAMES = 30


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("pairs") / "log", CAMERA, (render(walk(k)) for k in range(FRAMES)))


class NotingLog(RgbdLog):
    """Notes which frames it reads."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.read: list[int] = []

    def frame(self, index: int, *, still: bool = True, depth: bool = True) -> RgbdFrame:
        self.read.append(index)
        return super().frame(index, still=still, depth=depth)


@pytest.fixture
def log(path: Path) -> Iterator[NotingLog]:
    with NotingLog(path) as opened:
        yield opened


def assert_as_read(pairs: FramePairs, index: int) -> None:
    found, expected = pairs.frame(index), pairs.log.frame(index)
    np.testing.assert_array_equal(found.color, expected.color)
    np.testing.assert_array_equal(found.depth, expected.depth)


def test_estimates_of_one_log_read_each_frame_once(log: NotingLog) -> None:
    pairs = FramePairs(log, [true_path(FRAMES)])
    assert certain_delay_ns(pairs, DelayConfig(min_pairs=20)) == 0
    assert not certain_readout(pairs, ReadoutConfig(min_pairs=20)).rolls
    assert len(log.read) == len(set(log.read)) > FRAMES / 2


def test_frames_are_those_of_the_delay_and_the_readout_of_the_log(log: NotingLog) -> None:
    path = true_path(FRAMES)
    pairs, still = FramePairs(log, [path]), Trajectory(path.stamps_ns, np.tile(np.eye(4), (FRAMES, 1, 1)))
    for change in (
        lambda: None,
        lambda: log.delay_depth(FRAME_NS),  # each image has the depth of the next one
        lambda: setattr(log, "readout", Readout(0.03, 0.03)),
        lambda: log.move_depth(path),
        lambda: setattr(log, "readout", Readout()),
        lambda: log.delay_depth(FRAME_NS // 5),
        lambda: log.move_depth(still),
    ):
        change()
        assert_as_read(pairs, 5)
    before = pairs.spread(10)
    assert pairs.spread(10) is before
    log.delay_depth(0)
    assert pairs.spread(10) is not before


def test_memory_is_bounded(log: NotingLog) -> None:
    pairs = FramePairs(log, [], max_bytes=2 * log.frame(0).nbytes)
    log.read.clear()
    for _ in range(2):
        for index in range(4):
            assert_as_read(pairs, index)
    assert log.read == [0, 0, 1, 1, 2, 2, 3, 3, 0, 1, 2, 2, 3, 3]
