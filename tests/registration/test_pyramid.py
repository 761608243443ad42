"""Coarser levels of a pyramid know of a frame what the full one knows."""

from __future__ import annotations

import numpy as np

from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import Reference, RgbdPyramid, register
from tests.fixtures.room import CAMERA, pose, render

START, END = pose(yaw=0.3), pose(x=0.02, y=-0.01, z=-0.03, yaw=0.32)


def test_levels_that_are_built_again_still_have_no_depth() -> None:
    """In what order depth and pixels are taken away is no matter."""
    pyramid = RgbdPyramid.build(*render(END), CAMERA)
    mask = np.ones((CAMERA.height, CAMERA.width), dtype=bool)
    mask[:, : CAMERA.width // 4] = False
    expected, found = pyramid.masked(mask).without_depth(), pyramid.without_depth().masked(mask)
    assert [level.has_depth for level in found.levels] == [False] * 3
    reference = Reference.from_pyramid(RgbdPyramid.build(*render(START), CAMERA))
    by_color, same = (register(reference, target, np.eye(4)) for target in (expected, found))
    np.testing.assert_array_equal(same.T_reference_target, by_color.T_reference_target)
    assert se3.distance(by_color.T_reference_target, se3.inverse(START) @ END)[0] < 0.005
