"""Closures of a pair: who agrees, on which frame, who holds them, and how frames chain."""

import time
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph import least_squares, loop_closures
from duagc.pipeline.posegraph.loop_closures import (
    KeyframePoses,
    consistent,
    drift,
    frame_variance,
    holder,
    plausible,
    robust_frame,
)
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePoses, closures_as_relative_poses
from duagc.pipeline.posegraph.spanning_tree import chain_frames
from tests.fixtures.pose_worlds import random_information, random_poses

CONFIG = LoopClosureConfig()


def agreeing(closures, own, peer, grown):
    """`consistent` with the same drift at both ends."""
    return consistent(closures, KeyframePoses(own, grown), KeyframePoses(peer, grown), CONFIG)


def pair(seed, good=8, bad=6, aliased=0):
    """Two robots in one room, good closures, random ones, and some that agree on one wrong frame."""
    rng = np.random.default_rng(seed)
    own, peer = random_poses(rng, 12), random_poses(rng, 12)
    T_own_peer, wrong = random_poses(rng, 1, 3.0)[0], random_poses(rng, 1, 3.0)[0]
    closures = []
    for frame, count, sigma in ((T_own_peer, good, 0.002), (None, bad, 0.0), (wrong, aliased, 0.002)):
        for _ in range(count):
            i, j = int(rng.integers(12)), int(rng.integers(12))
            T = random_poses(rng, 1)[0] if frame is None else se3.inverse(own[i]) @ frame @ peer[j]
            closures.append(LoopClosure(i, j, T @ se3.exp(sigma * rng.normal(size=6)), 1e5 * np.eye(6)))
    chain = RelativePoses(
        np.arange(11), np.arange(1, 12), se3.inverse(own[:-1]) @ own[1:], np.tile(1e5 * np.eye(6), (11, 1, 1))
    )
    truth = np.arange(len(closures)) < good
    return closures, own, peer, drift(chain, 12, CONFIG), truth, T_own_peer


def test_the_consistent_group_is_found_among_outliers():
    closures, own, peer, grown, truth, T_own_peer = pair(0, good=8, bad=12, aliased=4)
    found = agreeing(closures, own, peer, grown)
    np.testing.assert_array_equal(found.keep, truth)
    assert found.support == 8
    meters, radians = se3.distance(found.T_ownmap_peermap, T_own_peer)
    assert meters < 0.02
    assert radians < 0.01
    assert [reason == "consistent" for reason in found.reasons] == truth.tolist()


def test_a_group_that_nowhere_looks_alike_does_not_count():
    """One thing in two places: more loop closures agree on it than on the place."""
    closures, own, peer, grown, truth, T_own_peer = pair(0, good=4, bad=6, aliased=8)
    limit = CONFIG.min_alike
    aliased = np.arange(len(closures)) >= 10
    unlike = [
        replace(c, alike=limit - 0.1) if thing else c for c, thing in zip(closures, aliased, strict=True)
    ]
    found = agreeing(unlike, own, peer, grown)
    np.testing.assert_array_equal(found.keep, truth)
    np.testing.assert_array_equal(found.unlike, aliased)
    assert "55% of the common texture look alike, 65% needed" in found.reasons[-1]
    assert se3.distance(found.T_ownmap_peermap, T_own_peer)[0] < 0.02
    unlike[-1] = closures[-1]  # one view is enough
    assert agreeing(unlike, own, peer, grown).keep.tolist() == aliased.tolist()
    only = [replace(c, alike=limit - 0.1) for c in closures]
    alone = agreeing(only, own, peer, grown)
    assert alone.T_ownmap_peermap is None
    assert alone.unlike[truth].all()


def test_the_group_does_not_depend_on_the_order_or_the_end():
    closures, own, peer, grown, truth, _ = pair(1)
    order = np.random.default_rng(2).permutation(len(closures))
    found = consistent(
        [closures[k] for k in order], KeyframePoses(own, grown), KeyframePoses(peer, grown), CONFIG
    )
    np.testing.assert_array_equal(found.keep, truth[order])
    turned = consistent(
        [c.reversed() for c in closures], KeyframePoses(peer, grown), KeyframePoses(own, grown), CONFIG
    )
    np.testing.assert_array_equal(turned.keep, truth)
    both = turned.T_ownmap_peermap @ agreeing(closures, own, peer, grown).T_ownmap_peermap
    np.testing.assert_allclose(both, np.eye(4), atol=0.02)  # the mean is taken in either frame


def test_one_closure_alone_is_not_enough():
    closures, own, peer, grown, _, _ = pair(3, good=1, bad=5)
    found = agreeing(closures, own, peer, grown)
    assert not found.keep.any()
    assert found.T_ownmap_peermap is None
    assert "needs 2" in found.reasons[0]
    assert agreeing([], own, peer, grown).T_ownmap_peermap is None


def test_long_odometry_between_closures_forgives_more():
    """The same disagreement is an outlier between neighbors and drift between far keyframes."""
    own = np.tile(np.eye(4), (101, 1, 1))
    offset = se3.exp(np.array([0.1, 0, 0, 0, 0, 0]))
    near = [LoopClosure(0, 0, np.eye(4), 1e6 * np.eye(6)), LoopClosure(0, 1, offset, 1e6 * np.eye(6))]
    far = [near[0], LoopClosure(0, 100, offset, 1e6 * np.eye(6))]
    grown = drift(RelativePoses.empty(), 1, CONFIG)
    assert grown.tolist() == [[0, 0]]
    information = np.tile(1e6 * np.eye(6), (100, 1, 1))
    chain = RelativePoses(np.arange(100), np.arange(1, 101), np.tile(np.eye(4), (100, 1, 1)), information)
    grown = drift(chain, 101, CONFIG)
    assert np.all(np.diff(grown, axis=0) > 0)
    assert not agreeing(near, own, own, grown).keep.any()
    assert agreeing(far, own, own, grown).keep.all()


def test_drift_follows_the_keyframe_that_was_tracked_against():
    """Keyframe 2 was tracked against 0, not against 1: it is as sure as its own factor."""
    information = np.tile(1e6 * np.eye(6), (2, 1, 1))
    star = RelativePoses([0, 0], [1, 2], np.tile(np.eye(4), (2, 1, 1)), information)
    grown = drift(star, 3, CONFIG)
    np.testing.assert_allclose(grown[2], grown[1])
    assert grown[2, 0] < 1e-3


def test_a_surer_way_to_a_later_keyframe_does_not_let_the_drift_fall():
    """The third keyframe was tracked against the first as surely as the second was not."""
    information = np.stack([1e2 * np.eye(6), 1e6 * np.eye(6)])
    star = RelativePoses(np.array([0, 0]), np.array([1, 2]), np.tile(np.eye(4), (2, 1, 1)), information)
    grown = drift(star, 3, CONFIG)
    np.testing.assert_allclose(grown[1], 1 / 101 + np.square([CONFIG.drift_floor_m, CONFIG.drift_floor_rad]))
    np.testing.assert_array_equal(grown[2], grown[1])


def test_the_variance_of_a_frame_has_all_drift_and_the_lever_of_the_maps():
    rng = np.random.default_rng(3)
    closures = [LoopClosure(0, 1, np.eye(4), np.diag([1e4] * 3 + [4e4] * 3)) for _ in range(2)]
    own, peer = random_poses(rng, 2), random_poses(rng, 3)
    own[:, :3, 3], peer[:, :3, 3] = [[0, 0, 0], [3, 4, 0]], [[0, 0, 0], [0, 12, 0], [5, 0, 0]]
    drifts = np.array([[0.0, 0], [0.02, 0.003]]), np.array([[0.0, 0], [0.01, 0.001], [0.05, 0.007]])
    exact = CONFIG.model_copy(update={"sigma_floor_m": 0.0, "sigma_floor_rad": 0.0})
    found = frame_variance(closures, KeyframePoses(own, drifts[0]), KeyframePoses(peer, drifts[1]), exact)
    rotation = 1 / (4e4 + 1) + 0.003 + 0.007
    lever_m2 = 5**2 + 12**2  # the diagonal of the larger map
    expected = 1 / (1e4 + 1) + 0.02 + 0.05 + rotation * lever_m2 / 3, rotation
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_a_robust_frame_is_where_proposals_with_weights_of_cauchy_cancel():
    rng = np.random.default_rng(6)
    frames = np.tile(np.eye(4), (15, 1, 1))
    frames[:, :3, 3] = 1.5 * CONFIG.frame_sigma_m * rng.normal(size=(15, 3))
    frames[-3:, :3, 3] += 20 * CONFIG.frame_sigma_m
    T = robust_frame(frames, CONFIG)
    apart = (frames[:, :3, 3] - T[:3, 3]) / CONFIG.frame_sigma_m
    weights = 1 / (1 + np.sum(apart**2, axis=1))
    np.testing.assert_allclose(weights @ apart, 0, atol=1e-2)
    assert (
        np.abs(np.exp(-np.sum(apart**2, axis=1)) @ apart).max() > 0.1
    )  # another kernel is not at rest there


@pytest.mark.parametrize("axis", range(6))
def test_a_loop_closure_may_be_implausible_by_any_axis(axis):
    _, own, peer, grown, _, T_own_peer = pair(5)
    off = np.zeros(6)
    off[axis] = 3.0 if axis < 3 else 1.5
    measured = se3.inverse(own[0]) @ T_own_peer @ peer[0]
    closures = [LoopClosure(0, 0, T, 1e5 * np.eye(6)) for T in (measured, measured @ se3.exp(off))]
    short = KeyframePoses(own[:1], grown[:1]), KeyframePoses((T_own_peer @ peer)[:1], grown[:1])
    np.testing.assert_array_equal(plausible(closures, *short, CONFIG), [True, False])


def test_unmeasured_steps_count_as_far_drift():
    grown = drift(RelativePoses.empty(), 3, CONFIG)
    assert np.all(np.diff(grown, axis=0) >= 1.0)


def test_robust_frame_ignores_a_minority():
    rng = np.random.default_rng(4)
    T = random_poses(rng, 1)[0]
    good = T @ se3.exp(0.01 * rng.normal(size=(20, 6)))
    frame = robust_frame(np.concatenate([random_poses(rng, 12, 3.0), good]), CONFIG)
    meters, radians = se3.distance(frame, T)
    assert meters < 0.02
    assert radians < 0.02


def test_a_closure_says_the_same_from_both_ends():
    rng = np.random.default_rng(5)
    poses, information = random_poses(rng, 2), random_information(rng, 1)[0]
    closure = LoopClosure(0, 1, random_poses(rng, 1)[0], information)
    back = closure.reversed()
    assert (back.own_keyframe, back.peer_keyframe, back.measured_from_peer) == (1, 0, True)
    one = least_squares.cost(closures_as_relative_poses([closure], [0], [1], CONFIG), poses)
    other = least_squares.cost(closures_as_relative_poses([back], [1], [0], CONFIG), poses)
    np.testing.assert_allclose(one, other, rtol=1e-12)
    again = back.reversed()
    np.testing.assert_allclose(again.T_own_peer, closure.T_own_peer, atol=1e-15)
    assert not again.measured_from_peer


def plain_clique(agree):
    """The same greedy search, degrees counted anew at each step."""
    agree, best = agree | np.eye(len(agree), dtype=bool), []
    for start in np.argsort(-agree.sum(axis=1), kind="stable")[:10]:
        clique, left = [start], [k for k in np.flatnonzero(agree[start]) if k != start]
        while left:
            chosen = left[int(np.argmax(agree[np.ix_(left, left)].sum(axis=1)))]
            clique.append(chosen)
            left = [k for k in left if k != chosen and agree[chosen, k]]
        best = max(best, clique, key=len)
    return np.isin(np.arange(len(agree)), best)


def test_the_clique_is_that_of_a_plain_search():
    rng = np.random.default_rng(7)
    for _ in range(60):
        m = int(rng.integers(1, 40))
        agree = rng.random((m, m)) < rng.random()
        agree |= agree.T
        np.testing.assert_array_equal(loop_closures._clique(agree), plain_clique(agree))


def test_a_clique_of_many_loop_closures_is_found_in_little_time():
    began = time.process_time()
    assert loop_closures._clique(np.ones((900, 900), dtype=bool)).all()
    assert time.process_time() - began < 2.0  # with degrees counted anew at each step it is 7 s


def plain_agreement(frames, points, drifts, variance, margin):
    """Which pairs agree, all pairs at once."""
    R, t = frames[:, :3, :3], frames[:, :3, 3]
    chord = np.sqrt(np.sum((R[:, None] - R[None]) ** 2, axis=(-1, -2)))
    rotation_rad = 2 * np.arcsin(np.minimum(chord / np.sqrt(8.0), 1.0))
    at_other = np.einsum("kab,lb->kla", R, points[1]) + t[:, None]
    off_m = np.linalg.norm(at_other - ((R @ points[1][..., None])[..., 0] + t)[None], axis=-1)
    variance = variance[:, None] + variance[None]
    for drifted in drifts:
        variance = variance + np.abs(drifted[:, None] - drifted[None])
    lever_m = np.maximum(*(np.linalg.norm(p[:, None] - p[None], axis=-1) for p in points))
    rotation, translation = margin * variance[..., 1], margin * variance[..., 0]
    agree = (rotation_rad**2 < loop_closures.CHI2_3_999 * rotation) & (
        np.minimum(off_m, off_m.T) ** 2 < loop_closures.CHI2_3_999 * (translation + rotation * lever_m**2 / 3)
    )
    return agree | agree.T


@pytest.mark.parametrize("m", [1, 2, 3, 63, 65, 130])
def test_agreement_in_blocks_of_rows_is_that_of_all_pairs_at_once(m):
    rng = np.random.default_rng(m)
    frames = random_poses(rng, 1)[0] @ se3.exp(0.1 * rng.normal(size=(m, 6)))
    points = rng.normal(size=(2, m, 3))
    drifts, variance = rng.random((2, m, 2)) * 1e-3, rng.random((m, 2)) * 1e-3
    given = frames, tuple(points), tuple(drifts), variance
    expected = plain_agreement(*given, margin=1.5)
    np.testing.assert_array_equal(loop_closures._agreement(*given, margin=1.5), expected)
    assert m < 63 or 0.1 < expected.mean() < 0.9


def test_pairwise_consistency_keeps_no_matrix_of_numbers():
    m = 800
    closures, own, peer, grown, truth, _ = pair(9, good=m - 200, bad=200)
    tracemalloc.start()
    found = agreeing(closures, own, peer, grown)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.array_equal(found.keep, truth)
    assert peak < 3 * 8 * m**2  # with such matrices it is nine of them


def test_holder_is_the_end_that_copies_fewer_keyframes():
    star = [LoopClosure(k, 7, np.eye(4), np.eye(6)) for k in range(4)]
    assert holder("bravo", "alpha", star) == "bravo"
    assert holder("alpha", "bravo", [c.reversed() for c in star]) == "bravo"
    assert holder("bravo", "alpha", star[:1]) == "alpha"


def test_frames_chain_along_the_best_supported_tree():
    rng = np.random.default_rng(6)
    world = dict(zip("abcd", random_poses(rng, 4, 3.0), strict=True))
    pairs = {(p, q): (se3.inverse(world[p]) @ world[q], 5.0) for p, q in (("a", "b"), ("c", "b"))}
    pairs["a", "c"] = (random_poses(rng, 1)[0], 1.0)  # weakly supported and wrong
    frames = chain_frames(pairs, ["d", "c", "b", "a"])
    for name in "abc":
        np.testing.assert_allclose(frames[name], se3.inverse(world["a"]) @ world[name], atol=1e-12)
    np.testing.assert_array_equal(frames["d"], np.eye(4))


def test_plausible_is_what_fits_to_where_frames_put_the_robots():
    """The wrong group is large enough to be consistent by itself; frames from elsewhere say that it is wrong."""
    closures, own, peer, grown, truth, T_own_peer = pair(3, good=4, bad=0, aliased=8)
    assert agreeing(closures, own, peer, grown).keep.tolist() == (~truth).tolist()
    T_world_own = random_poses(np.random.default_rng(4), 1)[0]
    placed = KeyframePoses(T_world_own @ own, grown)
    found = plausible(closures, placed, KeyframePoses(T_world_own @ T_own_peer @ peer, grown), CONFIG)
    np.testing.assert_array_equal(found, truth)
    drifted = T_own_peer @ se3.exp([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])  # well within eleven steps of odometry
    assert plausible(closures, placed, KeyframePoses(T_world_own @ drifted @ peer, grown), CONFIG)[
        truth
    ].all()
