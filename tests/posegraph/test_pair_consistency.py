"""The largest set of loop closures that two trajectories can follow at once."""

import numpy as np
import pytest

from duagc.pipeline.config.posegraph import settings
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.loop_closures import KeyframePoses, drift
from duagc.pipeline.posegraph.pair_consistency import agreeing
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePoses, isotropic_information

N = 60
CONFIG = settings("admm", "gnc").consensus
MOTION = se3.exp([1.0, 0, 0, 0, 0, 0.05])
NOISE = np.repeat([0.03, 0.003], 3)  # of odometry, m and rad


def walk(rng):
    """Odometry of N keyframes as its robot integrates it, and as they truly lie."""
    information = isotropic_information(np.full(N - 1, 0.5 / NOISE[3] ** 2), np.full(N - 1, NOISE[0] ** -2))
    measured = [MOTION @ se3.exp(NOISE * rng.normal(size=6)) for _ in range(N - 1)]
    T, true = [np.eye(4)], [np.eye(4)]
    for M in measured:
        T.append(T[-1] @ M)
        true.append(true[-1] @ MOTION)
    odometry = RelativePoses(np.arange(N - 1), np.arange(1, N), np.array(measured), information)
    return KeyframePoses(np.array(T), drift(odometry, N, CONFIG.closures)), np.array(true)


def pair(seed, places, cluster):
    """True loop closures at some places all along both walks, then false ones that agree on another motion."""
    rng = np.random.default_rng(seed)
    (own, T_own), (peer, T_peer) = walk(rng), walk(rng)
    T_between = se3.exp([2.0, 1.0, 0, 0, 0, 0.3])
    T_wrong = T_between @ se3.exp([15.0, -9.0, 0, 0, 0, 0.2])
    information = np.diag(np.repeat([1 / 0.1**2, 1 / 0.01**2], 3))
    closures = []
    for T, keyframes in ((T_between, places), (T_wrong, cluster)):
        for k in keyframes:
            noise = se3.exp(np.repeat([0.1, 0.01], 3) * rng.normal(size=6))
            measured = se3.inverse(T_own[k]) @ T @ T_peer[(k + 3) % N] @ noise
            closures.append(LoopClosure(k, (k + 3) % N, measured, information))
    return closures, own, peer


@pytest.mark.parametrize("seed", range(3))
def test_true_loop_closures_far_apart_outvote_a_cluster(seed):
    places, cluster = [2, 3, 4, 28, 29, 30, 52, 53, 54], [10, 12, 14, 16, 18, 20]
    closures, own, peer = pair(seed, places, cluster)
    found = agreeing(closures, own, peer, CONFIG)
    np.testing.assert_array_equal(found.keep, [True] * len(places) + [False] * len(cluster))


def test_alone_a_cluster_is_all_that_agrees():
    closures, own, peer = pair(3, [], [10, 12, 14, 16])
    assert agreeing(closures, own, peer, CONFIG).keep.all()


def test_one_loop_closure_is_its_own_group():
    closures, own, peer = pair(4, [30], [])
    found = agreeing(closures, own, peer, CONFIG)
    T = own.T_frame_keyframe[30] @ closures[0].T_own_peer @ se3.inverse(peer.T_frame_keyframe[33])
    np.testing.assert_allclose(found.T_ownmap_peermap, T, atol=1e-9)
