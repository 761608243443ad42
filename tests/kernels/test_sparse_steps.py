"""What the steps of a training leave out."""

import numpy as np

from duagc.pipeline.config.training import SparseStepsConfig
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels.sparse_steps import SparseSteps, checkerboards
from duagc.pipeline.kernels.training import TrainingView

CAMERA = PinholeCamera(26, 18, 20.0, 20.0, 12.5, 8.5)


def test_black_and_white_blocks_are_the_image() -> None:
    black, white = checkerboards(18, 26)
    assert black.shape == (18, 26)
    np.testing.assert_array_equal(black, ~white)
    assert black[:4, :4].all()
    assert white[:4, 4:8].all()
    assert white[4:8, :4].all()
    assert black[4:8, 4:8].all()


def test_a_view_is_seen_by_halves_and_blended_to_the_end_at_last() -> None:
    mask = np.random.default_rng(0).random((18, 26)) < 0.7
    image = np.zeros((18, 26), np.float32)
    steps = SparseSteps(SparseStepsConfig(closing_until=0.5, closing=0.02), CAMERA, 10)
    for whole in (None, mask):
        view = TrainingView(np.zeros((18, 26, 3), np.float32), image, np.eye(4), whole)
        first, second = (steps.at(step, visit).of(view) for step, visit in ((4, 3), (9, 4)))
        assert first.mask is not None
        assert second.mask is not None
        assert not (first.mask & second.mask).any()
        np.testing.assert_array_equal(first.mask | second.mask, np.ones_like(mask) if whole is None else mask)
    assert steps.at(4, 0).closing == 0.02
    assert steps.at(5, 0).closing == 0


def test_nothing_is_left_out_unless_it_is_asked_for() -> None:
    everything = SparseSteps(SparseStepsConfig(checkerboard=False, closing=0.0), CAMERA, 10).at(0, 0)
    assert everything.pixels is None
    assert everything.closing == 0
