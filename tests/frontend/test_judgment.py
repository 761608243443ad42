"""Optimized keyframe poses are judged again by features and depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.experiments.disturbed_tracking import Undisturbed
from duagc.pipeline.frontend.bundle import Images
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.judgment import Judgment, PairVerdict, judge
from duagc.pipeline.frontend.keyframe_graph import solve_pose_graph
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.registration import RgbdPyramid
from duagc.pipeline.registration.features import Features
from tests.fixtures.films import CAMERA
from tests.frontend.conftest import CONFIG, STARTS

OFF = se3.exp(np.array([0.12, 0.0, 0.05, 0.0, 0.03, 0.0]))


@pytest.fixture(scope="module")
def tracker(run: Undisturbed) -> Tracker:
    return run.tracker(STARTS[-1])


@pytest.fixture(scope="module")
def images(tracker: Tracker, run: Undisturbed) -> Images:
    shots = {shot.index: shot for shot in run.shots}

    def of(index: int, levels: int) -> RgbdPyramid:
        shot = shots[tracker.keyframes[index].frame_index]
        return RgbdPyramid.build(shot.color.astype(np.float32) / 255, shot.depth, CAMERA, levels)

    return of


def no_images(index: int, levels: int) -> RgbdPyramid:
    raise AssertionError("features leave nothing to be asked of images")


def judged(tracker: Tracker, T_map_keyframe: np.ndarray, *, features: bool = True) -> Judgment:
    none = Features(np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.float32))
    views = [k if features else replace(k, features=none) for k in tracker.keyframes]
    return judge(T_map_keyframe, views, tracker.pairs, CONFIG, images=no_images, seed=0, robot="alpha")


def poses(tracker: Tracker) -> np.ndarray:
    return np.array([keyframe.T_map_keyframe for keyframe in tracker.keyframes])


def test_true_poses_are_confirmed(tracker: Tracker) -> None:
    found = judged(tracker, poses(tracker))
    assert not found.contradicted
    assert set(found.verdicts.values()) == {PairVerdict.CONFIRMED}


def test_the_smaller_part_is_contradicted_where_the_path_breaks(tracker: Tracker) -> None:
    T = poses(tracker)
    last = len(T) - 2
    T[last:] = T[last - 1] @ OFF @ se3.inverse(T[last - 1]) @ T[last:]
    found = judged(tracker, T)
    assert found.contradicted == dict.fromkeys(range(last, len(T)), Reason.CONTRADICTED_BY_FEATURES)
    assert found.verdicts[last, last + 1] is PairVerdict.CONFIRMED


def test_no_registration_between_parts_counts_where_features_have_them_elsewhere(tracker: Tracker) -> None:
    """What features say nothing of was made from the same wrong poses, and says that it is exact."""
    T = poses(tracker)
    last = len(T) - 2
    T[last:] = T[last - 1] @ OFF @ se3.inverse(T[last - 1]) @ T[last:]
    found = judged(tracker, T)

    def pair(i: int, j: int) -> RelativePose:
        return RelativePose(i, j, se3.inverse(T[i]) @ T[j], 1e8 * np.eye(6))

    unjudged = pair(0, len(T) - 1)
    assert (0, len(T) - 1) not in found.verdicts
    within = [pair(k, k + 1) for k in range(last - 1)]
    corrected = found.corrected([*within, pair(last - 1, last), unjudged])
    assert corrected == [*within, *found.by_features]
    moved = solve_pose_graph(T, [*corrected, pair(last, last + 1)], 1e9).T_map_keyframe
    for k in range(len(T)):
        assert max(se3.distance(moved[k], poses(tracker)[k])) < 0.01


def test_of_parts_that_only_depth_contradicts_other_registrations_count(tracker: Tracker) -> None:
    T = poses(tracker)
    T[-1] = T[-1] @ se3.exp(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    found = judged(tracker, T, features=False)
    last = len(T) - 1
    others = [ends for ends, verdict in found.verdicts.items() if not verdict.contradicts and last in ends]
    pairs = [RelativePose(i, j, np.eye(4), np.eye(6)) for i, j in [*found.verdicts, (0, last)]]
    left = [(pair.i, pair.j) for pair in found.corrected(pairs) if pair.j == last]
    assert left == [*others, (0, last)]


def test_one_wrong_keyframe_is_contradicted_alone(tracker: Tracker) -> None:
    T = poses(tracker)
    T[2] = T[2] @ OFF
    assert judged(tracker, T).contradicted == {2: Reason.CONTRADICTED_BY_FEATURES}


def test_without_features_depth_contradicts(tracker: Tracker) -> None:
    T = poses(tracker)
    assert not judged(tracker, T, features=False).contradicted
    T[-1] = T[-1] @ se3.exp(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    found = judged(tracker, T, features=False)
    assert found.contradicted == {len(T) - 1: Reason.CONTRADICTED_BY_DEPTH}


@pytest.mark.parametrize("given_is_true", [True, False])
def test_where_features_show_two_motions_images_decide(
    tracker: Tracker, images: Images, given_is_true: bool
) -> None:
    """Most are of hands that move with the camera; or tracking went wrong, and some are of what looks alike."""
    T = poses(tracker)[:2]
    truth = se3.inverse(T[0]) @ T[1]
    other = truth @ se3.exp(np.array([0.05, 0.0, 0.02, 0.0, 0.04, 0.0]))
    if not given_is_true:
        T[1] = T[0] @ other
    of_most, of_some = (other, truth) if given_is_true else (truth, other)
    rng = np.random.default_rng(0)
    theirs = rng.uniform([-0.8, -0.6, 1.0], [0.8, 0.6, 2.0], (100, 3))
    moves = [of_most] * 60 + [of_some] * 40
    ours = np.array([se3.transform(move, point[None])[0] for move, point in zip(moves, theirs, strict=True)])
    descriptors = rng.integers(0, 256, (100, 128)).astype(np.uint8)
    views = [
        replace(keyframe, features=Features(descriptors, points.astype(np.float32)))
        for keyframe, points in zip(tracker.keyframes, (ours, theirs), strict=False)
    ]
    found = judge(T, views, [], CONFIG, images=images, seed=0, robot="alpha")
    assert found.verdicts[0, 1].contradicts is not given_is_true
