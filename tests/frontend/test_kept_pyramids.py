"""Pyramids of keyframes are read once, as far as memory allows, and are those that were read."""

import numpy as np

from duagc.pipeline.frontend.kept_pyramids import KeptPyramids, size_bytes
from duagc.pipeline.registration import RgbdPyramid
from tests.fixtures.room import CAMERA, pose, render


class Log:
    """Pyramids by frame, and which were read."""

    def __init__(self) -> None:
        self.read: list[int] = []

    def __call__(self, index: int, levels: int) -> RgbdPyramid:
        self.read.append(index)
        return RgbdPyramid.build(*render(pose(yaw=0.1 * index)), CAMERA, levels)


def assert_same(found: RgbdPyramid, wanted: RgbdPyramid) -> None:
    assert len(found.levels) == len(wanted.levels)
    for level, other in zip(found.levels, wanted.levels, strict=True):
        assert level.camera == other.camera
        np.testing.assert_array_equal(level.gray, other.gray)
        np.testing.assert_array_equal(level.inverse_depth, other.inverse_depth)


def test_a_pyramid_is_read_once_whatever_number_of_levels_is_asked_for():
    log = Log()
    kept = KeptPyramids(log)
    for levels in (1, 3, 2):
        assert_same(kept(5, levels), Log()(5, levels))
    assert log.read == [5]


def test_the_first_ones_stay_and_memory_is_bounded():
    log = Log()
    one = size_bytes(log(0, 2))
    kept = KeptPyramids(log, max_bytes=2 * one)
    log.read.clear()
    for _ in range(3):
        for index in range(4):
            kept(index, 2)
    assert log.read == [0, 1, 2, 3, 2, 3, 2, 3]
