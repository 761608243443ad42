"""Loop closures of one pair of robots that may be many and mostly false: which of them agree, by graduated weights.

Groups of false loop closures agree among themselves, and on long trajectories the pairwise test cannot tell them from
true ones: its limits grow with the drift. Here the keyframes that the loop closures name become two chains, whose links
are as stiff as the odometry between them, and graduated non-convexity finds the largest set of loop closures that both
chains can follow at once. It begins at the best group of the pairwise test. The problem has as many poses as there are
named keyframes; no other robot is asked.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.initialization import graduated
from duagc.pipeline.posegraph.loop_closures import Group, KeyframePoses, consistent, robust_frame
from duagc.pipeline.posegraph.relative_poses import (
    Index,
    LoopClosure,
    RelativePoses,
    closures_as_relative_poses,
    isotropic_information,
)

_LEAST_VARIANCE = 1e-12  # m^2, rad^2: of a link between two named keyframes


def agreeing(
    closures: Sequence[LoopClosure], own: KeyframePoses, peer: KeyframePoses, config: PoseConsensusConfig
) -> Group:
    """The loop closures of a pair that its two trajectories can follow at once, and their relative frame.

    Args:
        closures: all of one pair, at least one, from the side of one end.
        own: keyframes of this end in its own map.
        peer: keyframes of the peer in its own map.
        config: threshold and schedule of the graduated weights; one loop closure is enough to join two robots.
    """
    start = consistent(closures, own, peer, config.closures)
    assert start.T_ownmap_peermap is not None, "one loop closure joins two robots here"
    i = np.array([c.own_keyframe for c in closures], dtype=np.int64)
    j = np.array([c.peer_keyframe for c in closures], dtype=np.int64)
    named_i, named_j = np.unique(i), np.unique(j)
    chains = [_chain(own, named_i, 0), _chain(peer, named_j, len(named_i))]
    slots_j = len(named_i) + np.searchsorted(named_j, j)
    between = closures_as_relative_poses(closures, np.searchsorted(named_i, i), slots_j, config.closures)
    T = np.concatenate(
        [own.T_frame_keyframe[named_i], start.T_ownmap_peermap @ peer.T_frame_keyframe[named_j]]
    )
    T = graduated(RelativePoses.concatenate(chains), between, T, config)
    keep = least_squares.squared_residuals(between, T) <= config.truncation**2
    # a start is no worse than its own loop closures
    if np.count_nonzero(keep) < np.count_nonzero(start.keep):
        keep = start.keep
    T_own_peer = np.array([c.T_own_peer for c in closures], dtype=np.float64)
    frames = own.T_frame_keyframe[i] @ T_own_peer @ se3.inverse(peer.T_frame_keyframe[j])
    return Group(keep, robust_frame(frames[keep], config.closures))


def _chain(keyframes: KeyframePoses, named: Index, first: int) -> RelativePoses:
    """Links between consecutive named keyframes, with the variance that the odometry has there.

    Args:
        keyframes: of one robot.
        named: [s], indices of the named ones, ascending.
        first: variable of the first of them.
    """
    i, j = named[:-1], named[1:]
    T_i_j = se3.inverse(keyframes.T_frame_keyframe[i]) @ keyframes.T_frame_keyframe[j]
    variance = np.maximum(keyframes.drift[j] - keyframes.drift[i], _LEAST_VARIANCE)
    turned = variance[:, 1] * np.sum(T_i_j[:, :3, 3] ** 2, axis=1) / 3  # drift of rotations, along the way
    information = isotropic_information(0.5 / variance[:, 1], 1.0 / (variance[:, 0] + turned))
    variables = first + np.arange(len(named))
    return RelativePoses(variables[:-1], variables[1:], T_i_j, information)
