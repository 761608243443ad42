"""Coarser levels of a pyramid know of a frame what the full one knows."""

from __future__ import annotations

import numpy as np

from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import Reference, RgbdPyramid, register
from tests.fixtures.room import CAMERA, pose, render

FAR, NEAR, NOISE = 0.2, 0.6, 0.02
"""Inverse depth of a wall and of a box before it, and the standard deviation of both, 1/m: a tenth of the wall's."""
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


def noisy_wall() -> tuple[np.ndarray, RgbdPyramid]:
    """Exact inverse depth of the finest image, and the pyramid of a measured one."""
    exact = np.full((CAMERA.height, CAMERA.width), FAR)
    exact[10:37, 12:41] = NEAR
    noise = NOISE * np.random.default_rng(3).standard_normal(exact.shape)
    depth_m = (1 / (exact + noise)).astype(np.float32)
    return exact, RgbdPyramid.build(np.full(exact.shape, 0.5, np.float32), depth_m, CAMERA, 4)


def test_noise_does_not_bring_coarser_levels_nearer() -> None:
    """A block that keeps its nearest pixels only would: by 6 % of the depth, from level to level."""
    _, pyramid = noisy_wall()
    for level in pyramid.levels:
        wall = level.inverse_depth[level.inverse_depth < 0.5 * (FAR + NEAR)]
        assert np.count_nonzero(wall) > 0.95 * wall.size
        assert abs(np.mean(wall[wall > 0]) - FAR) < 0.01 * FAR
    assert np.std(wall[wall > 0]) < 0.3 * NOISE  # of 64 pixels each


def test_noise_does_not_mix_what_lies_farther_apart() -> None:
    exact, pyramid = noisy_wall()
    half = pyramid.levels[1].inverse_depth
    blocks = exact.reshape(half.shape[0], 2, half.shape[1], 2)
    edge = blocks.max(axis=(1, 3)) > blocks.min(axis=(1, 3))
    shown = half[edge & (half > 0)]
    assert len(shown) > 20
    assert np.all(np.abs(shown - NEAR) < 4 * NOISE)
