"""As many robots at a time as fit into memory."""

import pytest

from duagc.pipeline.cache.footprint import MARGIN, fitting, robot_bytes
from duagc.pipeline.cache.stage_key import StageKey
from duagc.pipeline.cache.store import StoredResults

SIZE = {"frames": 300, "pixels": 640 * 480}


def front_end(peak_mb: float) -> StoredResults:
    key = StageKey("frontend", "alpha", {}, {}, {}, {"log": "a"})
    return StoredResults(key, {}, {**SIZE, "keyframes": 18}, {"peak_rss_mb": peak_mb})


def test_no_more_robots_than_fit_and_at_least_one() -> None:
    assert fitting(4, [1e9] * 8, 10_000_000_000) == 4
    assert fitting(4, [1e9] * 8, 2_500_000_000) == 2
    assert fitting(4, [1e9] * 8, 100) == 1
    assert fitting(4, [3e9, 1e9, 1e9, 1e9], 5_000_000_000) == 2
    assert fitting(4, [1e9] * 8, None) == 4


def test_what_was_measured_here_counts_if_it_is_more() -> None:
    usual = robot_bytes(SIZE)
    assert robot_bytes(SIZE, [front_end(1.0)]) == usual
    assert robot_bytes(SIZE, [front_end(9e3), front_end(1.0)]) == MARGIN * 9e9
    assert robot_bytes({"frames": 30, "pixels": 160 * 120}) < usual


@pytest.mark.parametrize(
    ("frames", "pixels", "peak_mb"),
    [(333, 640 * 480, 511), (150, 640 * 480, 524), (120, 128 * 96, 168), (16, 160 * 120, 147)],
)
def test_what_was_measured_once_is_within_what_is_estimated(frames: int, pixels: int, peak_mb: int) -> None:
    """RedKitchen, fr1_desk, eight robots of an office one after the other in two processes, tiny ones."""
    needed_mb = robot_bytes({"frames": frames, "pixels": pixels}) / 1e6
    assert peak_mb < needed_mb < 1.5 * peak_mb
