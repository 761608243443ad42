"""Tracking of a camera that walks through an exact room, and what happens when the images fail it."""

from collections.abc import Callable

import numpy as np
import pytest

from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.config.frontend import FrontendConfig, KeyframeConfig, TrackingConfig
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.keyframe_graph import solve_pose_graph
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import ate_rmse_m
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import Motion
from duagc.pipeline.registration import Reference, RgbdPyramid, register
from tests.fixtures.frame_images import rgbd
from tests.fixtures.room import CAMERA, pose, render

CONFIG = FrontendConfig(tracking=TrackingConfig(strides=(2, 1, 1, 1)))
STEPS = 36


def walk(step: float) -> np.ndarray:
    """T_world_camera of a slow turn with a sideways step, 2 cm and 1 degree a frame."""
    t = step / STEPS
    return pose(
        x=-0.4 + 0.8 * t,
        y=0.1 * np.sin(3 * t),
        z=-0.9 + 0.3 * t,
        yaw=0.5 - 0.7 * t,
        pitch=0.05 * np.sin(5 * t),
    )


def positions(tracker: Tracker, frames: list[TrackedFrame]) -> np.ndarray:
    return np.array(
        [(tracker.keyframes[f.keyframe_index].T_map_keyframe @ f.T_keyframe_camera)[:3, 3] for f in frames]
    )


@pytest.fixture(scope="module")
def walked() -> tuple[Tracker, list[TrackedFrame], list[np.ndarray]]:
    tracker = Tracker(CAMERA, CONFIG)
    truth = [walk(k) for k in range(STEPS)]
    frames = [tracker.track(rgbd(k, *render(T))) for k, T in enumerate(truth)]
    return tracker, frames, truth


def test_walk_is_tracked_to_less_than_a_millimeter(walked) -> None:
    tracker, frames, truth = walked
    assert [f.status for f in frames] == [Status.OK] * STEPS
    assert ate_rmse_m(np.array(truth)[:, :3, 3], positions(tracker, frames)) < 1e-3
    np.testing.assert_array_equal(frames[0].T_keyframe_camera, np.eye(4))
    assert all(np.linalg.eigvalsh(f.information)[0] > 0 for f in frames[1:])


def test_keyframes_are_made_and_are_never_held_out(walked) -> None:
    tracker, frames, _ = walked
    assert 3 <= len(tracker.keyframes) <= 12
    for keyframe in tracker.keyframes:
        assert not is_held_out(keyframe.frame_index)
        tracked = frames[keyframe.frame_index]
        assert tracked.keyframe_index == keyframe.keyframe_index
        np.testing.assert_array_equal(tracked.T_keyframe_camera, np.eye(4))
    assert {pair.j for pair in tracker.pairs} == set(range(1, len(tracker.keyframes)))


def test_refinement_does_not_spoil_exact_tracking(walked) -> None:
    tracker = walked[0]
    start = np.array([k.T_map_keyframe for k in tracker.keyframes])
    result = solve_pose_graph(start, tracker.pairs, 3.0)
    optimized, covariance = result.T_map_keyframe, result.covariance(range(len(start)))
    np.testing.assert_array_equal(optimized[0], np.eye(4))
    assert np.max(se3.distance(start, optimized)[0]) < 2e-3
    assert np.linalg.eigvalsh(covariance[6:, 6:])[0] > 0


def covered(gray: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros_like(gray), np.zeros_like(depth)


def black(gray: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros_like(gray), depth


def foreign(gray: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return render(pose(x=0.5, z=0.5, yaw=np.pi), texture_seed=3)


@pytest.mark.parametrize("spoil", [covered, black, foreign])
def test_failed_images_are_lost_and_the_camera_is_found_again(spoil) -> None:
    tracker = Tracker(CAMERA, CONFIG)
    frames = []
    for k in range(12):
        images = render(walk(0.5 * k))
        frames.append(tracker.track(rgbd(k, *(spoil(*images) if 5 <= k < 8 else images))))
    status = [f.status for f in frames]
    assert status[5:8] == [Status.LOST] * 3
    for frame in frames[5:8]:
        np.testing.assert_array_equal(frame.information, 0)
        np.testing.assert_array_equal(frame.T_keyframe_camera, frames[4].T_keyframe_camera)
    assert status[8] is Status.RELOCALIZED
    assert status[9:] == [Status.OK] * 3
    truth = np.array([walk(0.5 * k)[:3, 3] for k in range(12)])
    seen = [k for k in range(12) if not 5 <= k < 8]
    assert ate_rmse_m(truth[seen], positions(tracker, frames)[seen]) < 1e-3


def keyframes_of(gains: np.ndarray) -> list[int]:
    """Frames that become keyframes of a camera that stands for ten frames, and then walks."""
    tracker = Tracker(CAMERA, CONFIG)
    for k, gain in enumerate(gains):
        gray, depth = render(walk(1.5 * max(0, k - 9)))
        assert tracker.track(rgbd(k, gray * np.float32(gain), depth)).status is not Status.LOST
    return [keyframe.frame_index for keyframe in tracker.keyframes]


def test_an_exposure_that_drifts_does_not_keep_frames_from_being_keyframes() -> None:
    steady = keyframes_of(np.ones(20))
    assert len(steady) > 1
    assert keyframes_of(np.maximum(0.93 ** np.arange(20), 0.55)) == steady
    jumping = np.where(np.arange(20) % 2 == 0, 1.0, 0.55)
    assert all(jumping[k] == 1.0 for k in keyframes_of(jumping))


def test_a_moving_object_behind_a_mask_leaves_the_poses_alone() -> None:
    """A box that follows the camera fills two fifths of the view: seen, it drags the pose along; masked, not."""
    usable = np.ones((CAMERA.height, CAMERA.width), bool)
    usable[:, 40:100] = False
    gray, depth = render(walk(0))
    errors = {}
    for masked in (False, True):
        tracker, frames = Tracker(CAMERA, CONFIG), []
        for k in range(10):
            image, depth_m = render(walk(k))
            image, depth_m = np.where(usable, image, gray), np.where(usable, depth_m, np.minimum(depth, 0.8))
            frames.append(tracker.track(rgbd(k, image, depth_m, mask=usable if masked else None)))
        truth = np.array([walk(k)[:3, 3] for k in range(10)])
        errors[masked] = ate_rmse_m(truth, positions(tracker, frames))
        assert not masked or all(f.status is Status.OK for f in frames)
    assert errors[True] < 2e-3
    assert errors[False] > 10 * errors[True]


def test_a_frame_without_a_usable_pixel_is_lost_and_said() -> None:
    tracker, none = Tracker(CAMERA, CONFIG), np.zeros((CAMERA.height, CAMERA.width), bool)
    frames = []
    for k in range(6):
        frames.append(tracker.track(rgbd(k, *render(walk(0.5 * k)), mask=none if k in (0, 3) else None)))
    assert [(f.status, f.reason) for f in frames] == [
        (Status.LOST, Reason.NO_PIXEL),
        (Status.OK, Reason.NONE),
        (Status.OK, Reason.NONE),
        (Status.LOST, Reason.NO_PIXEL),
        (Status.RELOCALIZED, Reason.NONE),
        (Status.OK, Reason.NONE),
    ]


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_a_saturated_frame_is_lost_and_said_and_never_the_first_keyframe(value: float) -> None:
    tracker, frames = Tracker(CAMERA, CONFIG), []
    for k in range(6):
        gray, depth_m = render(walk(0.5 * k))
        shown = np.full_like(gray, value) if k in (0, 3) else gray
        frames.append(tracker.track(rgbd(k, shown, depth_m)))
    assert [f.reason for f in frames] == [
        Reason.NO_PIXEL, Reason.NONE, Reason.NONE, Reason.NO_PIXEL, Reason.NONE, Reason.NONE,
    ]  # fmt: skip
    assert [k.frame_index for k in tracker.keyframes] == [1]


def test_color_alone_does_not_see_what_is_masked() -> None:
    """Without a depth image the mask is all that keeps a sticker in front of the lens out of the registration."""
    usable = np.ones((CAMERA.height, CAMERA.width), bool)
    usable[:, 40:100] = False
    pyramids = {}
    for k in (0, 1):
        image, depth_m = render(walk(k))
        for sticker in (0.0, 1.0):
            shown = np.where(usable, image, np.float32(sticker) * (1 + np.arange(CAMERA.width) % 2) / 2)
            pyramids[k, sticker] = RgbdPyramid.build(shown, depth_m, CAMERA, 3, mask=usable)
    found = [
        register(Reference.from_pyramid(pyramids[0, s]), pyramids[1, s].without_depth(), np.eye(4))
        for s in (0.0, 1.0)
    ]
    assert found[0].ok
    np.testing.assert_array_equal(found[0].T_reference_target, found[1].T_reference_target)
    np.testing.assert_array_equal(found[0].information, found[1].information)
    truth = se3.inverse(walk(0)) @ walk(1)
    assert se3.distance(found[0].T_reference_target, truth)[0] < 5e-3


def test_a_small_image_that_is_mostly_masked_begins_a_map() -> None:
    camera = CAMERA.scaled(80, 60)
    usable = np.zeros((camera.height, camera.width), dtype=bool)
    usable[:, : 2 * camera.width // 5] = True
    tracker = Tracker(camera, CONFIG)
    frames = []
    for k in range(STEPS // 2):
        image, depth_m = render(walk(k), camera=camera)
        frames.append(tracker.track(rgbd(k, image, depth_m, mask=usable)))
    reference = tracker.keyframes[0].reference
    assert len(reference.levels[2]) < CONFIG.tracking.registration.min_samples < len(reference.levels[0])
    assert all(frame.status is Status.OK for frame in frames)
    truth = np.array([walk(k) for k in range(len(frames))])
    assert ate_rmse_m(truth[:, :3, 3], positions(tracker, frames)) < 2e-3


def test_depth_of_long_before_makes_no_keyframe() -> None:
    tracker = Tracker(CAMERA, CONFIG)
    far_ns = 50_000_000
    first = tracker.track(rgbd(0, *render(walk(0)), depth_offset_ns=far_ns))
    assert (first.status, first.reason) == (Status.LOST, Reason.NO_DEPTH)
    frames = [tracker.track(rgbd(k, *render(walk(k)))) for k in (1, 2, 3)]
    for k in range(4, 14):
        late = render(walk(k + 1.5))[1]
        frames.append(tracker.track(rgbd(k, render(walk(k))[0], late, depth_offset_ns=far_ns)))
    assert all(f.status is Status.OK for f in frames)
    assert len(tracker.keyframes) == 1
    frames.append(tracker.track(rgbd(14, *render(walk(14)))))
    assert len(tracker.keyframes) == 2


def test_a_copy_takes_depth_from_as_far_in_time() -> None:
    far_ns = 50_000_000
    wide = Tracker(CAMERA, CONFIG, max_depth_offset_s=0.06)
    for tracker in (wide, wide.copied(), wide.copied(CONFIG.model_copy())):
        assert tracker.track(rgbd(0, *render(walk(0)), depth_offset_ns=far_ns)).status is Status.OK


def test_too_large_a_motion_is_not_called_tracked() -> None:
    tracker = Tracker(CAMERA, CONFIG)
    tracker.track(rgbd(0, *render(walk(0))))
    turned = tracker.track(rgbd(1, *render(pose(x=0.9, z=0.3, yaw=-1.2))))
    assert turned.status is Status.LOST


class Walked:
    """A motion prior that knows the walk, a little wrongly."""

    def __init__(self, pose_at: Callable[[int], np.ndarray], knows_translation: bool) -> None:
        self.pose_at, self.knows_translation = pose_at, knows_translation

    def between(self, start_ns: int, stop_ns: int) -> Motion:
        T = se3.inverse(self.pose_at(start_ns)) @ self.pose_at(stop_ns)
        xi = se3.log(T) * 1.02
        if not self.knows_translation:
            xi[:3] = 0
        return Motion(se3.exp(xi), self.knows_translation)


def test_a_prior_carries_over_what_the_images_do_not_tell() -> None:
    """Before one bare wall three directions are unknown: lost, but with an odometry they come from it."""
    gray = np.full((CAMERA.height, CAMERA.width), 0.5, np.float32)
    truth = [pose(x=-0.2 + 0.01 * k, y=0.3, z=0.4, yaw=0.0) for k in range(8)]
    depth = [np.full_like(gray, 2.0 - T[2, 3]) for T in truth]
    prior = Walked(lambda ns: truth[round(ns / 33_333_333)], knows_translation=True)
    for motion, status in ((None, Status.LOST), (prior, Status.OK)):
        tracker = Tracker(CAMERA, CONFIG, motion)
        frames = [tracker.track(rgbd(k, gray, depth[k])) for k in range(len(truth))]
        assert [f.status for f in frames[1:]] == [status] * 7
    expected = se3.inverse(truth[0]) @ truth[-1]
    moved_m, turned_rad = se3.distance(expected, frames[-1].T_keyframe_camera)
    assert moved_m < 0.003  # 2 % of 7 cm, which is what the prior is wrong by
    assert turned_rad < 0.01
    # the information of the images is their own: nothing along the wall
    assert np.linalg.eigvalsh(frames[-1].information)[0] < 1.0


@pytest.mark.parametrize("knows_translation", [False, True])
def test_a_prior_does_not_spoil_what_the_images_tell(walked, knows_translation: bool) -> None:
    _, _, truth = walked
    prior = Walked(lambda ns: truth[round(ns / 33_333_333)], knows_translation)
    tracker = Tracker(CAMERA, CONFIG, prior)
    frames = [tracker.track(rgbd(k, *render(truth[k]))) for k in range(16)]
    assert [f.status for f in frames] == [Status.OK] * 16
    assert ate_rmse_m(np.array(truth)[:16, :3, 3], positions(tracker, frames)) < 1e-3


def test_a_prior_follows_a_jerky_turn() -> None:
    """23 degrees a frame, every frame to the other side: no velocity predicts that; without features it is lost."""
    truth = [pose(x=-0.2, z=-0.9, yaw=0.4 * (k % 2)) for k in range(7)]
    prior = Walked(lambda ns: truth[round(ns / 33_333_333)], knows_translation=False)
    without_features = FrontendConfig.model_validate(
        {"tracking": {"strides": (2, 1, 1, 1), "relocalization": {"min_inliers": 1000}}}
    )
    for motion, statuses in ((None, {Status.LOST}), (prior, {Status.OK})):
        tracker = Tracker(CAMERA, without_features, motion)
        frames = [tracker.track(rgbd(k, *render(truth[k]))) for k in range(len(truth))]
        assert {frame.status for frame in frames[1::2]} == statuses
    for frame, T in zip(frames, truth, strict=True):
        found = tracker.keyframes[frame.keyframe_index].T_map_keyframe @ frame.T_keyframe_camera
        moved_m, turned_rad = se3.distance(se3.inverse(truth[0]) @ T, found)
        assert moved_m < 2e-3
        assert turned_rad < 2e-3


def test_equal_frames_give_equal_bits(walked) -> None:
    _, frames, truth = walked
    again = Tracker(CAMERA, CONFIG)
    for k in range(8):
        repeated = again.track(rgbd(k, *render(truth[k])))
        np.testing.assert_array_equal(repeated.T_keyframe_camera, frames[k].T_keyframe_camera)
        np.testing.assert_array_equal(repeated.information, frames[k].information)


def test_keyframe_rules_can_be_loosened() -> None:
    rare = KeyframeConfig(min_overlap=0.3, max_translation_of_depth=9, max_rotation_rad=9)
    tracker = Tracker(CAMERA, CONFIG.model_copy(update={"keyframes": rare}))
    for k in range(0, STEPS, 4):
        tracker.track(rgbd(k, *render(walk(k))))
    assert len(tracker.keyframes) == 1


def chain(k: int, rng: np.random.Generator) -> np.ndarray:
    """Poses [k, 4, 4] of a random walk that starts at the origin."""
    poses = [np.eye(4)]
    for _ in range(k - 1):
        poses.append(poses[-1] @ se3.exp(rng.normal(scale=0.3, size=6)))
    return np.array(poses)


def test_refine_finds_poses_and_their_covariance() -> None:
    rng = np.random.default_rng(0)
    sigma = np.array([0.01, 0.02, 0.01, 0.005, 0.01, 0.02])
    information = np.diag(sigma**-2.0)
    truth = chain(6, rng)
    ends = [(i, j) for i in range(6) for j in range(i + 1, min(i + 4, 6))]

    def draw() -> list[RelativePose]:
        return [
            RelativePose(
                i, j, se3.inverse(truth[i]) @ truth[j] @ se3.exp(sigma * rng.standard_normal(6)), information
            )
            for i, j in ends
        ]

    exact = [RelativePose(i, j, se3.inverse(truth[i]) @ truth[j], information) for i, j in ends]
    start = truth @ se3.exp(np.concatenate([np.zeros((1, 6)), 0.05 * rng.standard_normal((5, 6))]))
    np.testing.assert_allclose(solve_pose_graph(start, exact, 3.0).T_map_keyframe, truth, atol=1e-8)
    chi2 = []
    for _ in range(30):
        drawn = solve_pose_graph(truth, draw(), 1e9)
        T = drawn.T_map_keyframe
        error = se3.log(se3.inverse(se3.inverse(T[2]) @ T[5]) @ se3.inverse(truth[2]) @ truth[5])
        chi2.append(error @ drawn.relative_information(2, 5) @ error)
    # expected 6 with a standard deviation of 0.6 over 30 draws; contradiction only ever enlarges the covariance
    assert 3.5 < np.mean(chi2) < 7.5


def test_refine_withstands_a_wrong_pair() -> None:
    rng = np.random.default_rng(1)
    truth = chain(5, rng)
    information = np.eye(6) * 1e4
    pairs = [
        RelativePose(i, j, se3.inverse(truth[i]) @ truth[j], information)
        for i in range(5)
        for j in range(i + 1, 5)
    ]
    wrong = pairs[3].T_i_j @ se3.exp(np.array([0.3, 0, 0, 0, 0.2, 0]))
    pairs[3] = RelativePose(pairs[3].i, pairs[3].j, wrong, information)
    robust, plain = solve_pose_graph(truth, pairs, 1.0), solve_pose_graph(truth, pairs, 1e9)
    far = se3.distance(truth, plain.T_map_keyframe)[0].max()
    assert se3.distance(truth, robust.T_map_keyframe)[0].max() < 0.3 * far
    assert np.argmin(robust.weights) == 3
    assert robust.weights[3] < 0.2
    np.testing.assert_array_equal(plain.weights, 1)
    assert plain.variance_factor > robust.variance_factor > 1
    clean = solve_pose_graph(truth, pairs[:3] + pairs[4:], 1.0)
    np.testing.assert_allclose(clean.T_map_keyframe, truth, atol=1e-8)
    # the contradiction shows in the covariance: the first pose's neighbor is known worse than by one pair alone
    assert robust.covariance([1])[0, 0] > 1e-4 / len(pairs)


def test_the_rule_of_held_out_frames() -> None:
    assert [i for i in range(30) if is_held_out(i)] == [4, 12, 20, 28]


def test_refine_solves_thousands_of_keyframes() -> None:
    """A long walk with neighbors and a few closed loops: sparse work, the exact answer."""
    rng = np.random.default_rng(2)
    k = 2000
    truth = chain(k, rng)
    ends = [(i, i + d) for d in (1, 2, 3) for i in range(k - d)] + [(0, k - 1), (100, 1500)]
    information = np.diag([1e4, 1e4, 1e4, 1e5, 1e5, 1e5])
    pairs = [RelativePose(i, j, se3.inverse(truth[i]) @ truth[j], information) for i, j in ends]
    drift = np.concatenate([np.zeros((1, 6)), 1e-4 * rng.standard_normal((k - 1, 6)).cumsum(axis=0)])
    found = solve_pose_graph(truth @ se3.exp(drift), pairs, 1e9)
    np.testing.assert_allclose(found.T_map_keyframe, truth, atol=1e-4)
    assert found.normal_matrix.nnz < 36 * 10 * k
    # the loop holds its ends against each other as one registration does, and better
    assert np.linalg.eigvalsh(found.relative_information(0, k - 1) - information)[0] > -1e-3
