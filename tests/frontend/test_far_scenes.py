"""What is far away is seen as what is near: limits in meters grow with the distance."""

from dataclasses import replace

import numpy as np

from duagc.pipeline.experiments.disturbed_tracking import Undisturbed, track
from duagc.pipeline.experiments.shots import Shot
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3
from tests.fixtures.films import CAMERA
from tests.frontend.conftest import CONFIG

FACTOR = 15.0  # surfaces are seen some 25 m away, and frames are 33 cm apart
INTERVAL_NS = 66_666_667


def far(run: Undisturbed, frames: int, *, black: range = range(0), no_depth: range = range(0)) -> list[Shot]:
    """The film of a room that is so many times as large; the lens is covered for a while, or depth is missing."""
    out = []
    for k, shot in enumerate(run.shots[:frames]):
        color = shot.color if k not in black else np.zeros_like(shot.color)
        depth = FACTOR * shot.depth if k not in black and k not in no_depth else np.zeros_like(shot.depth)
        out.append(replace(shot, stamp_ns=k * INTERVAL_NS, color=color, depth=depth))
    return out


def followed(run: Undisturbed, shots: list[Shot]) -> list[bool]:
    """Which frames have a pose, which then is right."""
    tracker, out = Tracker(CAMERA, CONFIG), []
    for shot in shots:
        frame, T_map_camera = track(tracker, shot)
        out.append(frame.status is not Status.LOST)
        if out[-1]:
            T_true = run.poses[shot.index].copy()
            T_true[:3, 3] *= FACTOR
            moved_m, turned_rad = se3.distance(T_true, T_map_camera)
            assert moved_m < 0.005 * FACTOR
            assert turned_rad < 0.003
    return out


def test_a_camera_that_was_covered_is_found_by_the_second_frame(run: Undisturbed) -> None:
    covered = range(12, 18)
    found = followed(run, far(run, 26, black=covered))
    assert found == [k not in covered and k != covered.stop for k in range(26)]


def test_a_frame_without_depth_is_followed_by_its_color(run: Undisturbed) -> None:
    assert all(followed(run, far(run, 20, no_depth=range(9, 10))))


VEHICLE_FACTOR, VEHICLE_STEP, VEHICLE_FRAMES = 4.0, 8, 11  # surfaces 16 m away, frames 70 cm apart
VEHICLE_NS = 33_333_333


def test_a_log_of_a_vehicle_may_begin_in_motion(run: Undisturbed) -> None:
    """At 21 m/s, as nobody carries a camera; covered for two frames, it is found 2 m farther on."""
    tracker, covered = Tracker(CAMERA, CONFIG), range(5, 7)
    found = []
    for k, shot in enumerate(run.shots[: VEHICLE_FRAMES * VEHICLE_STEP : VEHICLE_STEP]):
        seen = k not in covered
        shot = replace(
            shot,
            index=k,
            stamp_ns=k * VEHICLE_NS,
            color=shot.color * seen,
            depth=VEHICLE_FACTOR * shot.depth * seen,
        )
        frame, T_map_camera = track(tracker, shot)
        found.append(frame.status is not Status.LOST)
        if found[-1]:
            T_true = run.poses[VEHICLE_STEP * k].copy()
            T_true[:3, 3] *= VEHICLE_FACTOR
            assert se3.distance(T_true, T_map_camera)[0] < 0.005 * VEHICLE_FACTOR
    assert found == [k not in covered for k in range(VEHICLE_FRAMES)]
