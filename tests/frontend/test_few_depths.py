"""A camera that has depth on less than half of its image, or with holes elsewhere in every frame."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from duagc.pipeline.experiments.disturbed_tracking import Undisturbed, track
from duagc.pipeline.experiments.shots import Shot
from duagc.pipeline.frontend import bearing_registration, bundle, feature_checks
from duagc.pipeline.frontend.current_frame import PoseCandidate
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.frame_images import RgbdImages
from duagc.pipeline.frontend.hidden_pixels import HiddenPixels
from duagc.pipeline.frontend.nearby_registration import register_nearby
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import RgbdPyramid
from duagc.pipeline.registration.features import extract_from_pyramid
from tests.fixtures.films import CAMERA
from tests.frontend.conftest import CONFIG

FEATURES = CONFIG.tracking.relocalization.max_width_px, CONFIG.tracking.relocalization.features
FAR_M = 3.6  # in a room whose depth is 3.8 to 4.4 m in the median


def with_holes(shot: Shot, far_m: float, missing: float) -> Shot:
    """A shot by a time-of-flight camera: smooth errors of 0.4 %, nothing beyond its range, and holes."""
    rng = np.random.default_rng([0, shot.index])
    holes = cv2.GaussianBlur(rng.normal(size=shot.depth.shape), (0, 0), 8)
    error = cv2.GaussianBlur(rng.normal(size=shot.depth.shape), (0, 0), 12)
    depth = shot.depth * (1 + 0.004 * error / error.std())
    depth[(shot.depth > far_m) | (holes > np.quantile(holes, 1 - missing))] = 0
    return replace(shot, depth=depth.astype(np.float32))


def filmed(run: Undisturbed, every: int, far_m: float, missing: float) -> list[Shot]:
    """Some of the shots, numbered from 1: the first frame of ten is held out."""
    shots = [replace(shot, index=k + 1) for k, shot in enumerate(run.shots[::every])]
    return [with_holes(shot, far_m, missing) for shot in shots]


def tracked(shots: list[Shot]) -> tuple[Tracker, dict[int, np.ndarray]]:
    """A tracker after some shots, and T_map_camera of those that have a pose, by their place."""
    tracker, poses = Tracker(CAMERA, CONFIG), {}
    for k, shot in enumerate(shots):
        frame, T_map_camera = track(tracker, shot)
        if frame.status is not Status.LOST:
            poses[k] = T_map_camera
    return tracker, poses


def worst_m(run: Undisturbed, poses: dict[int, np.ndarray], every: int) -> float:
    first = min(poses)
    T_map_map = poses[first] @ se3.inverse(run.poses[first * every])
    return max(
        float(se3.distance(T_map_map @ run.poses[k * every], T_map_camera)[0])
        for k, T_map_camera in poses.items()
    )


@pytest.mark.parametrize("every", [4, 8])
def test_features_without_depth_hold_a_camera_that_measures_little(run: Undisturbed, every: int) -> None:
    shots = filmed(run, every, FAR_M, 0.35)
    assert np.mean([np.count_nonzero(shot.depth) / shot.depth.size for shot in shots]) < 0.25
    _, poses = tracked(shots)
    assert len(poses) == len(shots)
    assert worst_m(run, poses, every) < 0.03


def test_without_them_it_is_lost(run: Undisturbed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bearing_registration.BearingMatches, "of", lambda *_: None)
    shots = filmed(run, 4, FAR_M, 0.35)
    assert len(tracked(shots)[1]) < 0.7 * len(shots)


def test_the_joint_optimization_knows_of_features_without_depth(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    every = 4
    shots = filmed(run, every, FAR_M, 0.35)
    tracker, _ = tracked(shots)
    keyframes, levels = tracker.keyframes, len(CONFIG.tracking.strides)

    def images(index: int, count: int) -> RgbdPyramid:
        shot = shots[keyframes[index].frame_index - 1]
        return RgbdPyramid.build(shot.color, shot.depth, CAMERA, levels)

    def optimized_m() -> float:
        start = np.array([keyframe.T_map_keyframe for keyframe in keyframes])
        settings = {"config": CONFIG.keyframes, "registration": CONFIG.tracking.registration}
        solution, _ = bundle.optimize(start, keyframes, images, tracker.pairs, **settings)
        poses = {k.frame_index - 1: T for k, T in zip(keyframes, solution.T_map_keyframe, strict=True)}
        return worst_m(run, poses, every)

    with_bearings_m = optimized_m()
    monkeypatch.setattr(bundle.BearingMatches, "of", lambda *_: None)
    assert with_bearings_m < min(0.006, 0.9 * optimized_m())


def test_an_image_is_searched_once_for_features_of_a_frame_without_some_pixels(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    shot = with_holes(run.shots[0], FAR_M - 0.4, 0.35)
    frame = Tracker(CAMERA, CONFIG).prepared(
        RgbdImages(frame_index=1, stamp_ns=0, image=shot.color, depth_m=shot.depth)
    )
    mask = np.zeros(frame.pyramid.levels[-1].gray.shape, bool)
    mask[:, :20] = True
    clear = frame.without(HiddenPixels(mask, 0.2, 1.0))
    alone = extract_from_pyramid(clear.pyramid, *FEATURES)
    assert len(frame.features)
    monkeypatch.setattr(cv2.SIFT, "create", None)
    for one, other in ((clear.features, alone), (clear.features.bearings, alone.bearings)):
        np.testing.assert_array_equal(one.descriptors, other.descriptors)
    assert 0 < len(alone.bearings.rays) < len(frame.features.bearings.rays)


def test_holes_that_wander_leave_features_in_one_view_or_the_other(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each view has depth on more than half of its image, few features have it in both: others confirm the pose."""
    shots, last = filmed(run, 4, np.inf, 0.45), 5
    tracker, _ = tracked(shots[:last])
    state, shot = tracker.state, shots[last]
    image = shot.color.astype(np.float32) / 255
    frame = tracker.prepared(
        RgbdImages(frame_index=shot.index, stamp_ns=shot.stamp_ns, image=image, depth_m=shot.depth)
    )
    assert not frame.has_few_depths
    more = {"min_overlap": 0.999}
    usual = state.config.tracking
    settings = {name: getattr(usual, name).model_copy(update=more) for name in ("registration", "recovery")}
    state.config = state.config.model_copy(update={"tracking": usual.model_copy(update=settings)})
    monkeypatch.setattr(feature_checks, "features_agree", lambda *_: False)
    found = register_nearby(state, frame)
    assert isinstance(found, PoseCandidate)
    assert found.by_bearings
    T_map_map = tracker.keyframes[0].T_map_keyframe @ se3.inverse(run.poses[0])
    assert se3.distance(state.in_map(found), T_map_map @ run.poses[4 * last])[0] < 0.005
    monkeypatch.setattr(bearing_registration.BearingMatches, "of", lambda *_: None)
    assert register_nearby(state, frame) is Reason.LOW_OVERLAP


def test_a_pose_that_features_without_depth_contradict_is_not_good(
    run: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However it was found: by bearings, from the prediction, or from features."""
    shots = filmed(run, 4, FAR_M, 0.35)
    tracker, _ = tracked(shots[:5])
    for module in (bearing_registration, feature_checks):
        monkeypatch.setattr(module, "bearings_contradict", lambda *_: True)
    assert track(tracker, shots[5])[0].status is Status.LOST
    monkeypatch.undo()
    assert track(tracker, shots[6])[0].status is Status.RELOCALIZED
