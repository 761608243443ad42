"""Frames of a driver that was stuck have no pose, unless the camera stood still."""

import numpy as np
import pytest

from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.repeated_frames import without_stuck
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3
from tests.fixtures.frame_images import rgbd
from tests.fixtures.room import CAMERA, render
from tests.frontend.test_frame_times import CONFIG, walk

STEP_S = 0.033333333


def frames_at(places_m: list[float | None], repeats: list[int]) -> list[TrackedFrame]:
    """Frames along x; None: lost."""
    out = []
    for k, x in enumerate(places_m):
        T = se3.from_rotation_translation(np.eye(3), [x or 0.0, 0.0, 0.0])
        status = Status.LOST if x is None else Status.OK
        stamp_ns = round(1e9 * STEP_S * k)
        out.append(
            TrackedFrame(
                k, stamp_ns, 0, T, np.eye(6), status, 0.9, 0.01, 0.01, Reason.NONE, repeats=k in repeats
            )
        )
    return out


@pytest.mark.parametrize(
    ("places_m", "repeats", "stuck"),
    [
        ([0.00, 0.02, 0.02, 0.02, 0.10, 0.12], [2, 3], [2, 3]),  # 8 cm in one interval, of 2 cm afterwards
        ([0.00, 0.02, 0.02, 0.02, 0.04, 0.06], [2, 3], []),  # it stood still
        ([0.00, 0.10, 0.10, 0.30, 0.40, 0.50], [2], []),  # 20 cm in one interval, of 10 cm afterwards
        ([0.00, 0.02, 0.02, None, None, 0.16, 0.18], [2], []),  # 14 cm in three intervals, 2 cm a frame
        ([0.00, 0.02, 0.02, None, None, 0.36, 0.38], [2], [2]),
        ([0.00, 0.02, 0.02, 0.02], [2, 3], []),  # nothing comes after them
        ([0.00, 0.02, 0.02, 0.02, 0.10], [2, 3], [2, 3]),  # nothing says how fast it went
        ([0.00, 0.00, 0.20, 0.22, 0.22], [0, 1, 4], [0, 1]),  # the first ones, as they are followed backward
    ],
)
def test_which_repeated_frames_are_lost(
    places_m: list[float | None], repeats: list[int], stuck: list[int]
) -> None:
    frames = frames_at(places_m, repeats)
    found = without_stuck(frames, np.eye(4)[None])
    for k, (before, after) in enumerate(zip(frames, found, strict=True)):
        if k in stuck:
            assert after.status is Status.LOST
            assert after.reason is Reason.REPEATED
            assert not after.information.any()
        else:
            assert after is before


def test_the_tracker_says_which_frames_repeat_both_images() -> None:
    tracker = Tracker(CAMERA, CONFIG)
    shown = [0, 1, 2, 2, 2, 3]
    found = [tracker.track(rgbd(k, *render(walk(step)))) for k, step in enumerate(shown)]
    assert [frame.repeats for frame in found] == [False, False, False, True, True, False]
