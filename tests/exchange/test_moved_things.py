"""Loop closures that show something that moved between two recordings."""

from dataclasses import replace

import numpy as np

from duagc.pipeline.base import random_streams
from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.config.exchange import ExchangeConfig, VerificationConfig
from duagc.pipeline.exchange.keyframe_database import KeyframeDatabase
from duagc.pipeline.exchange.loop_closing import Tried
from duagc.pipeline.exchange.moved_things import without_moved_things
from duagc.pipeline.exchange.place_recognition import Candidate
from duagc.pipeline.exchange.verification import Verdict, Verified, verify
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.loop_closures import KeyframePoses
from duagc.pipeline.posegraph.moved_things import TwoMotions
from duagc.pipeline.posegraph.relative_poses import LoopClosure
from duagc.pipeline.registration.descriptors import matches

CONFIG = LoopClosureConfig()
PLACE, THING = se3.exp([1.0, 0.2, 0, 0, 0.3, 0]), se3.exp([1.4, 0.2, 0, 0, 0.3, 0])
KEYFRAMES = np.array([se3.exp([0.1 * k, 0, 0.05 * k, 0, 0.02 * k, 0]) for k in range(8)])
POSES = KeyframePoses(KEYFRAMES, np.zeros((8, 2)))


def closure(own: int, peer: int, T_ownmap_peermap: np.ndarray) -> LoopClosure:
    T = se3.inverse(KEYFRAMES[own]) @ T_ownmap_peermap @ KEYFRAMES[peer]
    return LoopClosure(own, peer, T, np.diag([1e4] * 3 + [1e5] * 3))


def tried(own: int, peer: int, T: np.ndarray | None, T_moved: np.ndarray | None = None) -> Tried:
    found, moved = (None if X is None else closure(own, peer, X) for X in (T, T_moved))
    verdict = Verdict.FEW_INLIERS if found is None else Verdict.KEPT
    shown = None if found is None or moved is None else TwoMotions(found, moved)
    return Tried(Candidate(own, peer, 20), Verified(verdict, 40, 20, "", found, shown=shown))


def verdicts(candidates: list[Tried]) -> list[Verdict]:
    return [t.result.verdict for t in without_moved_things(candidates, POSES, POSES, CONFIG)]


def test_views_of_a_thing_alone_count_no_more_where_others_show_that_it_moved() -> None:
    place = [tried(0, 0, PLACE, THING), tried(1, 1, PLACE)]
    thing = [tried(k, k, THING) for k in range(2, 7)]
    candidates = [*thing, *place, tried(7, 7, None)]
    assert verdicts(candidates) == [*[Verdict.SOMETHING_MOVED] * 5, *[Verdict.KEPT] * 2, Verdict.FEW_INLIERS]
    left = without_moved_things(candidates, POSES, POSES, CONFIG)
    assert all(t.result.closure is None and "0.40 m" in t.result.detail for t in left[:5])
    assert left[5:] == candidates[5:]


def test_without_views_of_both_nothing_is_left_out() -> None:
    candidates = [tried(k, k, THING if k < 5 else PLACE) for k in range(8)]
    assert without_moved_things(candidates, POSES, POSES, CONFIG) == candidates


def test_one_pair_of_views_that_ascribes_its_motions_the_wrong_way_round_is_outvoted() -> None:
    both = [tried(0, 0, THING, PLACE), tried(1, 1, PLACE, THING), tried(2, 2, PLACE, THING)]
    assert verdicts(both) == [Verdict.SOMETHING_MOVED, Verdict.KEPT, Verdict.KEPT]


def test_as_many_votes_for_either_decide_nothing() -> None:
    both = [tried(0, 0, THING, PLACE), tried(1, 1, PLACE, THING)]
    assert verdicts(both) == [Verdict.KEPT, Verdict.KEPT]


def test_of_two_motions_that_views_show_the_wider_spread_one_is_that_of_the_place(make_robot) -> None:
    """Most features lie on a thing that stands elsewhere; the others are few, all around it."""
    alpha, truth_a = make_robot("alpha", 0.0, keyframes=1, gaussians=10)
    bravo, truth_b = make_robot("bravo", 0.1, keyframes=1, gaussians=10)
    own, peer = (KeyframeDatabase(data, ExchangeConfig()) for data in (alpha, bravo))
    sample, config = peer.sample(0), VerificationConfig()
    points = sample.features.points.copy()
    shared = matches(own.features[0].descriptors, sample.features.descriptors, config.ratio)[:, 1]
    middle = np.median(points[shared], axis=0)
    by_distance = shared[np.argsort(np.linalg.norm(points[shared] - middle, axis=1))]
    points[by_distance[: int(0.6 * len(shared))]] += np.float32([0.5, 0.0, 0.3])
    sample = replace(sample, features=replace(sample.features, points=points))
    rng = random_streams.generator(0, "test")
    result = verify(Candidate(0, 0, 0), own.features[0], own.pyramid(0), sample, config=config, rng=rng)
    assert result.verdict is Verdict.KEPT
    assert result.closure is not None
    T_true = se3.inverse(truth_a[0]) @ truth_b[0]
    assert se3.distance(result.closure.T_own_peer, T_true)[0] < 0.01
    assert result.matches == len(shared)
    assert 50 < result.inliers < 0.5 * len(shared)  # more follow the thing
    assert result.shown is None  # dense registration does not confirm the thing: images show it where it was
