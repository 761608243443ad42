"""A gyroscope that turns otherwise than the images do is reported."""

from collections.abc import Callable

import numpy as np
import pytest

from duagc.pipeline.checks.gyroscope import check_gyroscope
from duagc.pipeline.checks.moves import Move
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.recording import Motion

QUARTER = so3.exp([0.0, 0.0, np.pi / 2])
PAIRS = 8
TURNS = 0.1 * np.random.default_rng(0).standard_normal((PAIRS, 3))


class Gyro:
    """Rotations between the frames of pairs, as rates make them."""

    def __init__(self, of: Callable[[np.ndarray], np.ndarray]) -> None:
        self.of = of

    def between(self, start_ns: int, stop_ns: int) -> Motion:
        R = so3.exp(self.of(TURNS[start_ns]))
        return Motion(se3.from_rotation_translation(R, np.zeros(3)), knows_translation=False)


def moves(registered: int) -> list[Move]:
    T = [se3.from_rotation_translation(so3.exp(turn), [0.1, 0.0, 0.0]) for turn in TURNS]
    return [Move(k, k + 1, T[k] if k < registered else None) for k in range(PAIRS)]


@pytest.mark.parametrize(
    ("of", "reported"),
    [
        (lambda turn: turn, False),
        (lambda turn: np.add(turn, [0.01, 0.0, -0.01]), False),  # a bias
        (lambda turn: QUARTER @ turn, True),
        (lambda turn: np.rad2deg(turn) % 3, True),
    ],
)
def test_mounting_and_unit_are_reported(of: Callable[[np.ndarray], np.ndarray], reported: bool) -> None:
    found = list(check_gyroscope("alpha", moves(PAIRS), Gyro(of)))
    assert len(found) == reported
    assert not reported or found[0].confidence > 0.95


def test_few_pairs_and_no_gyroscope_tell_nothing() -> None:
    assert not list(check_gyroscope("alpha", moves(2), Gyro(lambda turn: QUARTER @ turn)))
    assert not list(check_gyroscope("alpha", moves(PAIRS), None))
