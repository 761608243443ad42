"""Something that moves with the camera fills much of the view: what follows it is not called good."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from duagc.pipeline.experiments.disturbed_tracking import Undisturbed
from duagc.pipeline.experiments.shots import Shot
from duagc.pipeline.frontend import followed_things
from duagc.pipeline.frontend.components import whole
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.followed_things import (
    WeakerFeatures,
    Witnesses,
    much_of_them,
    spreads_much_wider,
)
from duagc.pipeline.frontend.judgment import PairVerdict, judge
from duagc.pipeline.frontend.pose_optimization import OptimizedPath, PathOptimization
from duagc.pipeline.frontend.rejected_parts import RejectedPart, separated
from duagc.pipeline.frontend.submaps import TrackedLog, TrackedSubmap
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import RgbdPyramid
from duagc.pipeline.registration.features import Bearings, Features
from tests.fixtures.films import CAMERA, filmed
from tests.fixtures.frame_images import of_shot
from tests.frontend.conftest import CONFIG, STARTS

FRAMES = (25, 40)  # 22 mm apart; of one keyframe, and of two
WRONG_M = 0.1
AHEAD = se3.exp(np.array([0.0, 0.0, 1.6, 0.0, 0.0, 0.0]))
SHAPE = (CAMERA.height, CAMERA.width)


def with_thing(shots: list[Shot]) -> list[Shot]:
    """A robot ahead, 0.6 m away, that keeps its distance but for some wobbling; it fills half of the view."""
    h, w = SHAPE
    rng = np.random.default_rng(3)
    pattern = cv2.resize(
        rng.integers(20, 236, (h // 6, w // 6, 3), dtype=np.uint8), (w, h), interpolation=cv2.INTER_CUBIC
    )
    there = np.zeros(SHAPE, dtype=bool)
    there[h // 6 : -h // 6, w // 8 : -w // 8] = True
    out = []
    for shot in shots:
        by = round(3 * np.sin(0.7 * shot.index)), round(4 * np.sin(0.5 * shot.index + 1))
        thing, seen = np.roll(pattern, by, (0, 1)), np.roll(there, by, (0, 1))
        color = np.where(seen[..., None], thing, shot.color)
        out.append(replace(shot, color=color, depth=np.where(seen, np.float32(0.6), shot.depth)))
    return out


def optimized(shots: list[Shot]) -> tuple[Tracker, OptimizedPath]:
    tracker = Tracker(CAMERA, CONFIG)
    frames = [tracker.track(of_shot(s)) for s in shots]

    def images(index: int, levels: int) -> RgbdPyramid:
        return RgbdPyramid.build(
            shots[index].color.astype(np.float32) / 255, shots[index].depth, CAMERA, levels
        )

    optimization = PathOptimization(images, CONFIG, 0, "alpha")
    return tracker, optimization.run(tracker.keyframes, frames, tracker.pairs)


@pytest.mark.parametrize("count", FRAMES)
def test_poses_that_follow_what_moves_with_the_camera_are_not_called_good(
    run: Undisturbed, count: int
) -> None:
    tracker, path = optimized(with_thing(filmed(0, count)))
    last = tracker.state
    T_tracked = last.keyframe.T_map_keyframe @ last.T_keyframe_camera
    assert not last.lost
    assert se3.distance(T_tracked, run.poses[count - 1])[0] > 2 * WRONG_M
    for frame in path.frames:
        if frame.status is not Status.LOST:
            T = path.solution.T_map_keyframe[frame.keyframe_index] @ frame.T_keyframe_camera
            assert se3.distance(run.poses[frame.frame_index], T)[0] < WRONG_M
    assert path.frames[-1].reason is Reason.SOMETHING_MOVED


def features(points: np.ndarray, descriptors: np.ndarray) -> Features:
    return Features(descriptors, points.astype(np.float32))


@pytest.fixture
def scene() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points of a small thing and of a wide place, descriptors, and a motion of the place."""
    rng = np.random.default_rng(1)
    thing, place = (
        rng.uniform([-0.1, -0.1, 0.6], [0.1, 0.1, 0.7], (60, 3)),
        rng.uniform([-2, -1.5, 2], [2, 1.5, 4], (40, 3)),
    )
    descriptors = rng.integers(0, 256, (100, 128)).astype(np.uint8)
    return thing, place, descriptors, se3.exp(np.array([0.4, 0.0, 0.1, 0.0, 0.2, 0.0]))


def test_the_wider_of_two_motions_is_that_of_the_place(scene) -> None:
    thing, place, descriptors, T = scene
    first = features(np.concatenate([thing, se3.transform(T, place)]), descriptors)
    second = features(np.concatenate([thing, place]), descriptors)
    limits = CONFIG.keyframes.judgment
    assert spreads_much_wider(first, second, (np.eye(4), T), limits)
    assert not spreads_much_wider(first, second, (T, np.eye(4)), limits)


def test_what_one_pair_knows_to_move_holds_in_others(run: Undisturbed, scene) -> None:
    """The first two views show the place, too. The third shows the thing alone, or the place alone."""
    thing, place, descriptors, T = scene
    limits, base = CONFIG.keyframes.judgment, run.tracker(50).keyframes[:3]
    of_first = features(np.concatenate([thing, se3.transform(T, place)]), descriptors)
    of_second = features(np.concatenate([thing, place]), descriptors)
    still = np.repeat(np.eye(4)[None], 3, axis=0)
    for shown, follows in ((slice(0, 60), True), (slice(60, 100), False)):
        of_third = features(of_second.points[shown], descriptors[shown])
        views = [replace(k, features=f) for k, f in zip(base, (of_first, of_second, of_third), strict=True)]
        found = much_of_them({(0, 1): T}, [(1, 2)], still, views=views, config=limits)
        assert found == ({(1, 2)} if follows else set())


@pytest.mark.parametrize(("T_given", "wrong"), [(np.eye(4), True), (AHEAD, False)])
def test_what_is_far_witnesses_that_a_camera_over_equal_pieces_moves(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch, T_given: np.ndarray, wrong: bool
) -> None:
    """Ground of equal tiles, which has depth, between houses that have none."""
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-4, 4, 140), np.full(140, 1.5), rng.uniform(4, 14, 140)])
    sides = rng.choice([-1.0, 1.0], 120)
    houses = np.column_stack([9 * sides, rng.uniform(-6, 1, 120), rng.uniform(17, 40, 120)])
    descriptors = rng.integers(0, 256, (260, 128)).astype(np.uint8)
    moved = se3.transform(se3.inverse(AHEAD), houses)
    seen = [
        Features(
            descriptors[:140],
            ground.astype(np.float32),
            Bearings(descriptors[140:], (points / points[:, 2:]).astype(np.float32), 1 / 228),
        )
        for points in (houses, moved)  # taken from the end: of the frame first
    ]
    monkeypatch.setattr(followed_things, "extract_from_pyramid", lambda *_: seen.pop())
    keyframe, shot = run.tracker(STARTS[0]).keyframes[0], filmed(0, 1)[0]
    frame = TrackedFrame(
        frame_index=1,
        stamp_ns=1,
        keyframe_index=0,
        T_keyframe_camera=T_given @ se3.exp(np.full(6, 1e-9)),
        information=np.eye(6),
        status=Status.OK,
        overlap=0.9,
        rms_depth_m=0.0,
        rms_gray=0.0,
    )

    def images(_: int, levels: int) -> RgbdPyramid:
        return RgbdPyramid.build(shot.color.astype(np.float32) / 255, shot.depth, CAMERA, levels)

    weaker = WeakerFeatures([keyframe], images, CONFIG, Witnesses([frame], images))
    assert weaker.witnessed(0, rng) is wrong


def test_frames_that_followed_it_from_a_rejected_keyframe_are_lost(run: Undisturbed) -> None:
    tracker = run.tracker(50)
    keyframes, made = tracker.keyframes, {k.frame_index for k in tracker.keyframes}
    anchors = [max(k.keyframe_index for k in keyframes if k.frame_index <= index) for index in range(50)]
    frames = [
        TrackedFrame(
            frame_index=index,
            stamp_ns=index,
            keyframe_index=anchor,
            T_keyframe_camera=np.eye(4),
            information=np.eye(6),
            status=Status.OK,
            overlap=1.0,
            rms_depth_m=0.0,
            rms_gray=0.0,
        )
        for index, anchor in enumerate(anchors)
    ]
    submap = TrackedSubmap(1, keyframes, tracker.pairs)
    log = TrackedLog(frames, [1] * len(frames), [submap])
    last = [len(keyframes) - 2, len(keyframes) - 1]
    part = RejectedPart(last, np.array([keyframes[k].T_map_keyframe for k in last]), [], frozenset(last[1:]))
    limits = CONFIG.submaps.model_copy(update={"min_frames": 1, "min_keyframes": 1})
    now = separated(log, whole(submap), [part], limits)
    lost = {f.frame_index for f in now.log.frames if f.reason is Reason.SOMETHING_MOVED}
    assert lost == {index for index, anchor in enumerate(anchors) if anchor == last[1]} - made


def test_of_a_still_scene_nothing_is_said_to_move(run: Undisturbed) -> None:
    tracker, shots = run.tracker(50), filmed(0, 50)

    def images(index: int, levels: int) -> RgbdPyramid:
        shot = shots[tracker.keyframes[index].frame_index]
        return RgbdPyramid.build(shot.color.astype(np.float32) / 255, shot.depth, CAMERA, levels)

    T = np.array([k.T_map_keyframe for k in tracker.keyframes])
    found = judge(T, tracker.keyframes, tracker.pairs, CONFIG, images=images, seed=0, robot="alpha")
    assert PairVerdict.MOVED not in found.verdicts.values()
    assert not found.following
