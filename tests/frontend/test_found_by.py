"""What a disturbed camera is compared with: the last good frame, the latest keyframe, and the prediction."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.experiments import disturbances as d
from duagc.pipeline.experiments.disturbed_tracking import Undisturbed, track
from duagc.pipeline.experiments.shots import Shot
from duagc.pipeline.frontend.current_frame import CurrentFrame, PoseCandidate
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.relocalization import Relocalizer, by_latest_keyframe
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import RgbdPyramid, register
from tests.fixtures.films import CAMERA, filmed
from tests.frontend.conftest import CONFIG
from tests.frontend.conftest import START_OF_COMPARISONS as START


def pyramid_of(shot: Shot) -> RgbdPyramid:
    return RgbdPyramid.build(shot.color.astype(np.float32) / 255, shot.depth, CAMERA, 4)


@pytest.fixture(scope="module")
def misfit() -> Undisturbed:
    """Depth that does not fit the color, by two pixels: what a poor calibration does."""
    shots = [replace(shot, depth=np.roll(shot.depth, 2, axis=1)) for shot in filmed(0, START + 8)]
    return Undisturbed(Tracker(CAMERA, CONFIG), shots, (START,))


def test_color_alone_goes_on_from_the_last_frame_with_depth(misfit: Undisturbed) -> None:
    """Against the keyframe, color and depth that do not fit together are centimeters apart; the pose must not jump."""
    tracker, shot = misfit.tracker(START), misfit.shots[START]
    keyframe = tracker.keyframes[-1]
    guess = se3.inverse(keyframe.T_map_keyframe) @ misfit.poses[START]
    against_keyframe = register(keyframe.reference, pyramid_of(shot).without_depth(), guess)
    apart_m, _ = se3.distance(guess, against_keyframe.T_reference_target)
    (row,) = list(misfit.disturbed(START, d.depthless, frames=1))
    assert row.good
    assert row.moved_m < 0.4 * apart_m
    assert apart_m > 0.005


def test_color_alone_is_followed_for_a_short_distance(run: Undisturbed) -> None:
    """The distance counts from the last frame with depth; the frames are 22 mm apart."""
    short = FrontendConfig.model_validate(
        {"tracking": {"strides": (2, 1, 1, 1), "failure": {"max_translation_without_depth_m": 0.05}}}
    )
    for config, most in ((short, 2), (CONFIG, 5)):
        rows = run.disturbed(START, d.depthless, frames=7, config=config)
        assert [row.good for row in rows] == [True] * most + [False] * (7 - most)
        assert all(row.frame.reason is Reason.NO_DEPTH for row in rows)


def test_color_alone_says_how_little_it_knows(run: Undisturbed) -> None:
    """Its standard deviation includes a share of the distance."""
    rows = [row for row in run.disturbed(START, d.depthless, frames=5) if row.good]
    T_sound = run.poses[START - 1]
    share = CONFIG.tracking.failure.sigma_of_translation_without_depth
    for row in rows:
        way_m = float(np.linalg.norm((se3.inverse(T_sound) @ run.poses[row.shot.index])[:3, 3]))
        covariance = np.linalg.inv(row.frame.information)
        assert np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[0]) > 0.99 * share * way_m


def test_color_alone_knows_no_more_than_the_frame_it_went_on_from(run: Undisturbed) -> None:
    tracker, shot = run.tracker(START), run.shots[START]
    last_good = tracker.state.last_good
    assert last_good is not None
    tracker.state.last_good = replace(last_good, information=1e2 * np.eye(6))  # 10 cm, 0.1 rad
    frame, _ = track(tracker, replace(shot, depth=np.zeros_like(shot.depth)))
    covariance = np.linalg.inv(frame.information)
    assert np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[0]) > 0.099


def test_color_alone_must_look_as_before(run: Undisturbed) -> None:
    """Without depth, and darker by more than a keyframe may be: nothing is known any more."""
    tracker, shot = run.tracker(START), run.shots[START]
    darker = (0.6 * shot.color.astype(np.float32)).astype(np.uint8)
    blind = replace(shot, depth=np.zeros_like(shot.depth))
    frame, _ = track(run.tracker(START), blind)
    assert (frame.status, frame.reason) == (Status.OK, Reason.NO_DEPTH)
    frame, _ = track(tracker, replace(blind, color=darker))
    assert frame.status is Status.LOST


def test_what_looks_unlike_is_followed_only_where_it_was_expected(run: Undisturbed) -> None:
    """A frame from 15 cm farther on is followed if it looks as usual; if it does not, it is another place."""
    here, beyond = run.shots[START], run.shots[START + 6]
    moved_m, _ = se3.distance(run.poses[START], run.poses[START + 6])
    assert moved_m > CONFIG.tracking.failure.slack_m
    noise = np.random.default_rng(0).normal(0, 60, here.color.shape)

    def unlike(shot: Shot) -> Shot:
        return replace(shot, color=np.clip(shot.color + noise, 0, 255).astype(np.uint8))

    beyond = replace(beyond, index=here.index, stamp_ns=here.stamp_ns)
    found = [track(run.tracker(START), shot)[0] for shot in (here, beyond, unlike(here), unlike(beyond))]
    assert [frame.status for frame in found] == [Status.OK, Status.OK, Status.OK, Status.LOST]
    all_of_it = {"tracking": {"strides": (2, 1, 1, 1), "failure": {"min_overlap_unlike": 1.0}}}
    for shot, status in ((here, Status.OK), (unlike(here), Status.LOST)):
        tracker = run.tracker(START, FrontendConfig.model_validate(all_of_it))
        assert track(tracker, shot)[0].status is status


def _drifted(run: Undisturbed) -> Tracker:
    """A tracker whose keyframes after the first have moved by 4 cm in the map, as tracking drifts on a long path."""
    tracker = run.tracker(START)
    drift = se3.exp(np.array([0.04, 0, 0, 0, 0, 0]))
    first, *later = tracker.keyframes
    tracker.state.keyframes = [first, *(replace(k, T_map_keyframe=drift @ k.T_map_keyframe) for k in later)]
    return tracker


def _found_by_the_first(run: Undisturbed, tracker: Tracker) -> tuple[PoseCandidate, PoseCandidate | None]:
    """A place that the first keyframe shows, and what is made of it."""
    shot = run.shots[START]
    pyramid = pyramid_of(shot)
    result = register(tracker.keyframes[0].reference, pyramid, run.poses[START])
    assert result.ok
    place = PoseCandidate(0, result)
    frame = CurrentFrame(shot.index, shot.stamp_ns, pyramid, CONFIG.tracking.relocalization)
    return place, by_latest_keyframe(tracker.state, frame, place)


def test_a_place_counts_from_the_latest_keyframe_that_shows_it(run: Undisturbed) -> None:
    tracker = _drifted(run)
    _, found = _found_by_the_first(run, tracker)
    assert found is not None
    assert found.keyframe_index == len(tracker.keyframes) - 1
    T_map_camera = tracker.keyframes[-1].T_map_keyframe @ found.result.T_reference_target
    assert se3.distance(T_map_camera, run.poses[START])[0] == pytest.approx(0.04, abs=0.003)


def test_a_later_keyframe_that_has_the_camera_elsewhere_contradicts(run: Undisturbed) -> None:
    """Without features the later keyframes are not plausible; whether they agree still counts."""
    for tracker, agrees in ((run.tracker(START), True), (_drifted(run), False)):
        first, *later = tracker.keyframes
        none = replace(
            first.features, descriptors=first.features.descriptors[:0], points=first.features.points[:0]
        )
        tracker.state.keyframes = [first, *(replace(k, features=none) for k in later)]
        tracker.state.lost, tracker.state.stamp_ns = True, run.shots[START].stamp_ns - 10**9
        place, found = _found_by_the_first(run, tracker)
        assert found == (place if agrees else None)


def test_copied_and_stored_relocalizers_index_their_own_keyframes() -> None:
    relocalizer = Relocalizer()
    relocalizer._index.add(np.zeros((2, 128), np.uint8))
    for other in (copy.copy(relocalizer), pickle.loads(pickle.dumps(relocalizer))):
        assert len(other._index) == 0
    assert len(relocalizer._index) == 1
