"""Where the camera should be is computed once, and again as soon as anything has changed that it follows from."""

import numpy as np
import pytest

from duagc.pipeline.frontend.failure import FrameIntervals, RecentMedian
from duagc.pipeline.frontend.prediction import LastPrediction, Prediction


def test_a_prediction_is_computed_again_when_its_basis_changes() -> None:
    last, calls = LastPrediction(), []

    def predict() -> Prediction:
        calls.append(len(calls))
        return Prediction(np.eye(4), None, float(calls[-1]))

    pose, velocity = np.eye(4), np.zeros(6)
    assert last.of((1, pose, velocity), predict).sigma_px == 0
    assert last.of((1, pose, velocity), predict).sigma_px == 0
    assert last.of((2, pose, velocity), predict).sigma_px == 1
    assert last.of((2, pose.copy(), velocity), predict).sigma_px == 2
    assert last.of((1, pose, velocity), predict).sigma_px == 3


def test_the_median_is_that_of_the_last_values() -> None:
    median = RecentMedian(3)
    assert median.median == 0
    for value, wanted in ((4.0, 4.0), (1.0, 2.5), (9.0, 4.0), (9.0, 9.0), (0.0, 9.0)):
        median.add(value)
        assert median.median == wanted
    assert median.values == (9.0, 9.0, 0.0)


def test_intervals_lie_between_stamps() -> None:
    intervals = FrameIntervals(2)
    intervals.update(5_000_000_000)
    assert intervals.median_s == 0
    for stamp_ns, wanted in ((5_100_000_000, 0.1), (5_300_000_000, 0.15), (5_700_000_000, 0.3)):
        intervals.update(stamp_ns)
        assert intervals.median_s == pytest.approx(wanted)
