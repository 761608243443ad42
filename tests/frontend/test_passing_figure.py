"""A figure that comes into the view slowly and passes: no keyframe contains it, and no pose follows it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from duagc.pipeline import registration
from duagc.pipeline.experiments.disturbed_tracking import WRONG_M, Undisturbed
from duagc.pipeline.experiments.shots import Shot
from duagc.pipeline.frontend import occluded_frames
from duagc.pipeline.frontend.current_frame import CurrentFrame
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.frame_images import RgbdImages
from duagc.pipeline.frontend.hidden_pixels import HiddenPixels, carried, hidden_pixels
from duagc.pipeline.frontend.occluded_frames import LITTLE, register_visible
from duagc.pipeline.frontend.submaps import SubmapTracker, TrackedLog
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.frontend.tracking_state import TrackingState
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.registration import Level, Registration
from tests.fixtures.films import CAMERA, FRAMES, filmed
from tests.frontend.conftest import CONFIG, STARTS

ENTERS, PASSES = 20, 60  # frame at which it comes in; frames that it takes
WIDTH = 0.3  # of the view
SHAPE = (CAMERA.height, CAMERA.width)


def passing(t: float) -> float:
    """Left edge of a figure that crosses the view, in widths of the image, at time 0..1 of its stay."""
    return -WIDTH + t * (1 + WIDTH)


def visiting(t: float) -> float:
    """The same of one that comes in, waits in the middle, and leaves where it came from."""
    return -WIDTH + min(1.0, 3 * t, 3 - 3 * t) * (0.5 + 0.5 * WIDTH)


def with_figure(shots: Sequence[Shot], left: Callable[[float], float], depth_m: float) -> Iterator[Shot]:
    """Frames in which a blurred figure moves by itself."""
    h, w = SHAPE
    pattern = np.random.default_rng(3).integers(20, 236, (h // 24, 8, 3), dtype=np.uint8)
    pattern = cv2.resize(pattern, (round(WIDTH * w), h), interpolation=cv2.INTER_CUBIC)
    for shot in shots:
        t = (shot.index - ENTERS) / PASSES
        begin = round(w * left(t))
        seen = slice(max(begin, 0), min(begin + pattern.shape[1], w))
        if not 0 <= t <= 1 or seen.stop <= seen.start:
            yield shot
            continue
        color, depth = shot.color.copy(), shot.depth.copy()
        nearer = depth[:, seen] > depth_m
        color[:, seen][nearer] = pattern[:, seen.start - begin : seen.stop - begin][nearer]
        depth[:, seen][nearer] = depth_m
        yield replace(shot, color=color, depth=depth, disturbed=bool(nearer.mean() > 0.5))


def tracked(shots: Iterator[Shot]) -> TrackedLog:
    tracker = SubmapTracker(CAMERA, CONFIG)
    for shot in shots:
        tracker.track(
            RgbdImages(frame_index=shot.index, stamp_ns=shot.stamp_ns, image=shot.color, depth_m=shot.depth)
        )
    return tracker.finish()


@pytest.mark.parametrize(("left", "depth_m"), [(passing, 0.9), (visiting, 0.8)])
def test_poses_do_not_follow_a_figure(
    run: Undisturbed, left: Callable[[float], float], depth_m: float
) -> None:
    log = tracked(with_figure(filmed(0, FRAMES), left, depth_m))
    (submap,) = log.submaps
    placed = [frame for frame in log.frames if frame.status is not Status.LOST]
    assert len(placed) >= FRAMES - 3
    for frame in placed:
        T = submap.keyframes[frame.keyframe_index].T_map_keyframe @ frame.T_keyframe_camera
        assert se3.distance(run.poses[frame.frame_index], T)[0] < WRONG_M
    during = [k for k in submap.keyframes if ENTERS + 15 < k.frame_index < ENTERS + PASSES - 15]
    assert during
    for keyframe in during:  # whose samples are of the room
        true = filmed(0, FRAMES)[keyframe.frame_index].depth
        points = keyframe.reference.levels[0].points.astype(np.float64)
        u, v = np.rint(CAMERA.project(points)).astype(int).T
        assert (np.abs(points[:, 2] - true[v, u]) < 0.1).mean() > 0.97


def level(depth_m: np.ndarray) -> Level:
    camera = CAMERA.halved().halved().halved()
    assert depth_m.shape == (camera.height, camera.width)
    inverse = (1 / depth_m).astype(np.float32)
    return Level(camera, np.zeros_like(inverse), inverse)


def test_a_surface_is_an_object_as_a_whole_where_enough_of_it_is_in_free_space() -> None:
    """Half of it is where the earlier view saw a wall, the other half where that view measured nothing."""
    h, w = SHAPE[0] // 8, SHAPE[1] // 8
    wall, now = np.full((h, w), 3.0), np.full((h, w), 3.0)
    now[5:15, 8:20] = 1.0
    before = level(wall)
    before.inverse_depth[:, 14:] = 0
    hidden = hidden_pixels(level(now), np.eye(4), [(before, np.eye(4))] * 2, CONFIG)
    assert hidden.mask[5:15, 8:20].all()
    assert hidden.share == pytest.approx(120 / (h * w))
    still = hidden_pixels(before, np.eye(4), [(level(wall), np.eye(4))] * 2, CONFIG)
    assert not still.mask.any()


def stereo_street(rng: np.random.Generator, behind_m: float = 0.0, thing_m: float | None = None) -> Level:
    """A ground 1.2 m below a stereo camera that is some way behind, a wall 14 m ahead, and a thing before it."""
    camera = PinholeCamera(320, 240, 228.0, 228.0, 159.5, 119.5)
    ray = (np.arange(camera.height) - camera.cy) / camera.fy
    inverse = np.repeat(np.maximum(ray / 1.2, 1 / (14.0 + behind_m))[:, None], camera.width, axis=1)
    if thing_m is not None:
        inverse[60:180, 100:220] = np.maximum(inverse[60:180, 100:220], 1 / thing_m)
    noise = cv2.GaussianBlur(rng.standard_normal(inverse.shape), (0, 0), 1.0)
    noisy = (inverse + 5.5e-3 * noise / noise.std()).astype(np.float32)
    found = Level(camera, np.zeros_like(noisy), np.where(noisy > 1 / 30, noisy, np.float32(0)))
    for _ in range(3):
        found = found.halved()
    return found


def test_noise_of_far_surfaces_is_no_object_and_an_object_before_them_is_found() -> None:
    """Depth that is wrong by a tenth passes a gate of 5 %: half of a street seemed to be an object before it."""
    rng, seen = np.random.default_rng(2), []
    for k in range(1, 17):
        back = se3.exp(np.array([0, 0, -0.5 * k, 2e-3 * k / 16, 0, 0]))  # as tracking drifts
        seen.append((stereo_street(rng, behind_m=0.5 * k), back))
    for _ in range(3):
        assert hidden_pixels(stereo_street(rng), np.eye(4), seen, CONFIG).share == 0.0
        view = stereo_street(rng, thing_m=5.0)
        there = hidden_pixels(view, np.eye(4), seen, CONFIG)
        assert (
            np.mean(view.inverse_depth > 0) > 0.99
        )  # noise leaves no holes, so the share is one of the whole view
        assert there.share == pytest.approx(0.16, abs=0.02)
        assert there.mask[7:19, 12:28].all()  # its upper three quarters


def test_an_object_is_carried_into_the_next_view_until_it_is_gone() -> None:
    h, w = SHAPE[0] // 8, SHAPE[1] // 8
    before, after = np.full((h, w), 3.0), np.full((h, w), 3.0)
    before[5:15, 8:14] = after[5:15, 9:15] = 1.0
    mask = carried(before < 2, 1 / before, level(after), min_region=0.002)
    np.testing.assert_array_equal(mask, after < 2)
    assert not carried(before < 2, 1 / before, level(np.full((h, w), 3.0)), min_region=0.002).any()


def thing(share: float) -> HiddenPixels:
    """What may hide a share of the view, at its left border."""
    mask = np.zeros((SHAPE[0] // 8, SHAPE[1] // 8), dtype=bool)
    mask[:, : round(share * mask.shape[1])] = True
    return HiddenPixels(mask, share, 1.0)


@pytest.mark.parametrize(
    ("share", "moved_m", "again"), [(0.05, 0.0, False), (0.05, 0.03, True), (0.2, 0.0, True)]
)
def test_a_frame_is_registered_without_an_object_only_where_that_may_change_it(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch, share: float, moved_m: float, again: bool
) -> None:
    tracker, shot = run.tracker(STARTS[0]), run.shots[STARTS[0]]
    image = shot.color.astype(np.float32) / 255
    frame = tracker.prepared(
        RgbdImages(frame_index=shot.index, stamp_ns=shot.stamp_ns, image=image, depth_m=shot.depth)
    )
    asked: list[CurrentFrame] = []

    def without(state: TrackingState, frame: CurrentFrame, T_map_camera: np.ndarray) -> None:
        asked.append(frame)

    def register(*arguments: Any) -> Registration:
        result = registration.register(*arguments)
        T = result.T_reference_target @ se3.exp(np.array([moved_m, 0, 0, 0, 0, 0]))
        return replace(result, T_reference_target=T)

    limit = CONFIG.tracking.failure.max_free_space_violations
    assert LITTLE * limit < 0.05 < limit < 0.2
    monkeypatch.setattr(occluded_frames, "_hidden", lambda *_: thing(share))
    monkeypatch.setattr(occluded_frames, "_register_without", without)
    monkeypatch.setattr(occluded_frames, "register", register)
    found, _ = register_visible(tracker.state, frame)
    assert bool(asked) == again
    assert found.suspected is not None
    assert found.suspected.share == share


@pytest.mark.parametrize(("gray", "off_m"), [(2.0, 0.0), (0.5, 0.1)])
def test_of_two_places_without_an_object_the_one_that_fits_better_counts(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch, gray: float, off_m: float
) -> None:
    """From a prediction that is far off, a registration ends in a wrong minimum; features had led to the right one."""
    start = STARTS[0]
    tracker, shot = run.tracker(start), run.shots[start]
    image = shot.color.astype(np.float32) / 255
    frame = tracker.prepared(
        RgbdImages(frame_index=shot.index, stamp_ns=shot.stamp_ns, image=image, depth_m=shot.depth)
    )
    right = occluded_frames._register_without(tracker.state, frame, run.poses[start])
    assert right is not None
    T = right[1].result.T_reference_target @ se3.exp(np.array([off_m or 0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    result = replace(right[1].result, T_reference_target=T, rms_gray=gray * right[1].result.rms_gray)
    wrong = frame.without(thing(0.2)), replace(right[1], result=result)
    monkeypatch.setattr(occluded_frames, "_hidden", lambda *_: thing(0.2))
    monkeypatch.setattr(occluded_frames, "_register_without", lambda *_: wrong)
    monkeypatch.setattr(occluded_frames, "_usual", lambda *_: True)
    _, found = register_visible(tracker.state, frame)
    assert not isinstance(found, Reason)
    distance_m = se3.distance(tracker.state.in_map(found), run.poses[start])[0]
    assert distance_m == pytest.approx(off_m, abs=5e-3)
