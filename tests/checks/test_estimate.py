"""What a run takes is predicted from what was measured."""

import numpy as np
import pytest

from duagc.pipeline.checks.estimate import estimate, keyframes
from duagc.pipeline.checks.geometry import Move

# frames, pixels and predicted keyframes of every robot, and seconds that the stages of a run took on two idle cores
MEASURED = {
    "demo": ([(160, 480 * 360, 12), (160, 480 * 360, 15)], 123),
    "redkitchen": ([(333, 640 * 480, 13), (333, 640 * 480, 14)], 207),
}


def robots(rows: list[tuple[int, int, int]]) -> dict[str, dict[str, int]]:
    return {str(k): {"frames": f, "pixels": p, "keyframes": n} for k, (f, p, n) in enumerate(rows)}


@pytest.mark.parametrize("name", MEASURED)
def test_measured_runs_lie_within_the_range(name: str) -> None:
    rows, seconds = MEASURED[name]
    found = estimate(robots(rows))
    assert found["seconds_from"] < seconds < found["seconds_to"]
    assert found["seconds_to"] < 3 * found["seconds_from"]


def test_small_images_take_more_than_their_share_of_pixels() -> None:
    large, small = (estimate(robots([(100, pixels, 8)] * 2)) for pixels in (640 * 480, 160 * 120))
    assert small["seconds_to"] > large["seconds_to"] / 16 * 2
    assert small["seconds_to"] < large["seconds_to"]
    alone = estimate(robots([(100, 640 * 480, 8)]))
    assert alone["seconds_to"] < large["seconds_to"]
    assert estimate({})["bytes"] == 0


def moves(lost: list[float], every_ns: int = 100_000_000) -> list[Move]:
    return [Move(k * every_ns, (k + 1) * every_ns, np.eye(4), lost=share) for k, share in enumerate(lost)]


def test_keyframes_come_as_often_as_views_are_lost() -> None:
    """A keyframe is made when a fifth of the view is lost."""
    assert keyframes(moves([0.1] * 8), 100, 4_000_000_000) == 21
    assert keyframes(moves([0.0] * 8), 100, 4_000_000_000) == 1
    assert keyframes(moves([1.0] * 8), 100, 4_000_000_000) == 100  # no more than there are frames
    assert keyframes([Move(0, 1, None)], 30, 10**9) == 30
