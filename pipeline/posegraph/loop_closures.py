"""Loop closures between two robots: which of them agree, and the relative frame they agree on.

Pairwise consistency only chooses the *start* (`docs/explanation/pose-consensus.md`): used as a filter it loses good
closures. The graduated weights of `duagc.pipeline.consensus.pose_admm` may accept or reject every loop closure later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.statistics import evenly_spaced_to_ends
from duagc.pipeline.posegraph.places_alike import share_unlike
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePoses, closures_as_relative_poses

CHI2_3_999 = 16.27  # 99.9 % quantile of chi^2 with 3 degrees of freedom
MOST_UNLIKE = 0.06
"""Share of the places that may look different to most views that show them, besides those of one spot."""
_OTHER_GROUPS = 2  # further than the largest, that a cycle of three robots may find to be the right ones
_SCALES = 8.0  # of a relative frame, that a placement may be off
_ROWS = 64  # of pairs of loop closures at a time: bounds the memory
_CANDIDATES = 150  # relative frames tried as the start of the mean


@dataclass(frozen=True)
class KeyframePoses:
    """Where one robot has its keyframes, as far as loop closures need it.

    Attributes:
        T_frame_keyframe: [n, 4, 4], by index; only those that loop closures name are read.
        drift: [n, 2] from `drift`, likewise.
    """

    T_frame_keyframe: Array
    drift: Array

    def moved(self, T: Array) -> KeyframePoses:
        """The same in another frame.

        Args:
            T: [4, 4], from the present frame to the other one.
        """
        return KeyframePoses(T @ self.T_frame_keyframe, self.drift)


@dataclass(frozen=True)
class Consistency:
    """Which of the m loop closures of one pair of robots agree.

    Attributes:
        keep: bool [m], the largest mutually consistent group.
        T_ownmap_peermap: [4, 4], its relative frame; None if too few agree.
        reasons: one per loop closure, in words.
        support: size of the group.
        others: smaller groups, disjoint, largest first.
        unlike: bool [m], those of groups that never look alike.
    """

    keep: NDArray[np.bool_]
    T_ownmap_peermap: Array | None
    reasons: tuple[str, ...]
    support: int
    others: tuple[Group, ...] = ()
    unlike: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))


@dataclass(frozen=True)
class Group:
    """Loop closures that agree with each other.

    Attributes:
        keep: bool [m], which of the pair's.
        T_ownmap_peermap: [4, 4], the relative frame that they agree on.
    """

    keep: NDArray[np.bool_]
    T_ownmap_peermap: Array


def drift(odometry: RelativePoses, keyframes: int, config: LoopClosureConfig) -> Array:
    """Accumulated variance of the odometry along the keyframes, the input of `consistent`.

    Args:
        odometry: relative poses between own keyframes, each usually to the keyframe that it was tracked
            against.
        keyframes: how many there are.
        config: for the least drift from one keyframe to the next.
    Returns:
        [keyframes, 2], not falling: translation m^2 and rotation rad^2 per axis, from keyframe 0 to keyframe k along
        the surest earlier keyframe. One without a relative pose to an earlier one counts with one square meter and
        one square radian.
    """
    covariance = np.linalg.inv(odometry.information + np.eye(6))  # the identity is that weak prior
    variances = np.diagonal(covariance, axis1=-2, axis2=-1).reshape(-1, 2, 3).mean(axis=-1)
    ties: dict[int, list[tuple[int, Array]]] = {}
    for i, j, variance in zip(odometry.i.tolist(), odometry.j.tolist(), variances, strict=True):
        ties.setdefault(max(i, j), []).append((min(i, j), variance))
    floor = np.array([config.drift_floor_m**2, config.drift_floor_rad**2])
    grown = np.zeros((keyframes, 2))
    for k in range(1, keyframes):
        sums = [grown[i] + variance for i, variance in ties.get(k, [])]
        grown[k] = np.min([grown[k - 1] + 1.0, *sums], axis=0) + floor
        grown[k] = np.maximum(grown[k], grown[k - 1])
    return grown


def consistent(
    closures: Sequence[LoopClosure], own: KeyframePoses, peer: KeyframePoses, config: LoopClosureConfig
) -> Consistency:
    """Largest group of mutually consistent loop closures of one pair of robots, and its relative frame.

    Two loop closures k and l are consistent if the relative frames of the two maps that each implies agree within the
    variance of both and of both robots' odometry between them, where they overlap: that is the error of the
    cycle own k -> peer k -> peer l -> own l. A group counts only if what both views see looks alike in one of them at
    least: it does not where one thing stands in two places. And few places may look different to most views that show
    them: more do where two rooms have the same furniture.

    Args:
        closures: all of one pair, from the side of one end.
        own: keyframes of this end in its own map.
        peer: keyframes of the peer in its own map.
        config: settings of the test.
    """
    m = len(closures)
    if m == 0:
        return Consistency(np.zeros(0, dtype=bool), None, (), 0)
    i = np.array([c.own_keyframe for c in closures], dtype=np.int64)
    j = np.array([c.peer_keyframe for c in closures], dtype=np.int64)
    T_own, T_peer = own.T_frame_keyframe[i], peer.T_frame_keyframe[j]
    # T_ownmap_peermap implied by each loop closure
    frames = T_own @ np.array([c.T_own_peer for c in closures], dtype=np.float64) @ se3.inverse(T_peer)
    information = closures_as_relative_poses(closures, i, j, config).information
    closure_variance = np.linalg.inv(information + np.eye(6))
    closure_variance = np.diagonal(closure_variance, axis1=-2, axis2=-1).reshape(-1, 2, 3).mean(axis=-1)
    agree = _agreement(
        frames,
        (T_own[:, :3, 3], T_peer[:, :3, 3]),
        (own.drift[i], peer.drift[j]),
        closure_variance,
        margin=config.margin,
    )
    alike, unlike, left = np.array([c.alike for c in closures]), np.zeros(m, bool), np.ones(m, bool)
    groups: list[NDArray[np.bool_]] = []
    largest, differs = 0, ""
    while len(groups) <= _OTHER_GROUPS and left.any():
        group = np.zeros(m, dtype=bool)
        group[np.flatnonzero(left)[_clique(agree[np.ix_(left, left)])]] = True
        largest = max(largest, int(group.sum()))
        if group.sum() < config.min_support:
            break
        left &= ~group
        agreeing = [c for c, keep in zip(closures, group.tolist(), strict=True) if keep]
        if (best := alike[group].max()) < config.min_alike:
            unlike |= group
            differs = f"at most {best:.0%} of the common texture look alike, {config.min_alike:.0%} needed"
        elif (share := share_unlike(agreeing, T_own[group])) > MOST_UNLIKE:
            unlike |= group
            differs = (
                f"{share:.1%} of the places look different to most views, at most {MOST_UNLIKE:.0%} allowed"
            )
        else:
            groups.append(group)
    if not groups:
        few = f"largest consistent group has {largest} of {m} loop closures, needs {config.min_support}"
        reasons = tuple(differs if u else few for u in unlike.tolist())
        return Consistency(np.zeros(m, dtype=bool), None, reasons, largest, unlike=unlike)
    keep, *smaller = groups
    rejected = f"disagrees with the consistent group of {int(keep.sum())} among {m} loop closures"
    reasons = tuple(
        "consistent" if k else differs if u else rejected
        for k, u in zip(keep.tolist(), unlike.tolist(), strict=True)
    )
    others = tuple(Group(group, robust_frame(frames[group], config)) for group in smaller)
    return Consistency(keep, robust_frame(frames[keep], config), reasons, int(keep.sum()), others, unlike)


def plausible(
    closures: Sequence[LoopClosure], own: KeyframePoses, peer: KeyframePoses, config: LoopClosureConfig
) -> NDArray[np.bool_]:
    """Which loop closures fit to where the alignment of the component places the two robots.

    These loop closures need not have placed them there: the alignment follows the best supported links. A loop closure
    is implausible if it is farther from that than its own variance and the whole odometry of both robots explain (times
    `margin`). Like the pairwise test this only chooses the start of the robust weights.

    Args:
        closures: m of one pair.
        own: keyframes of this end in the common frame.
        peer: keyframes of the peer in the common frame.
        config: settings of the test.
    Returns:
        bool [m].
    """
    translation_m, rotation_rad = _off(closures, own, peer)
    variance = _whole_variance(closures, own, peer, config)
    limit = CHI2_3_999 * config.margin * variance
    return (rotation_rad**2 < limit[:, 1]) & (translation_m**2 < limit[:, 0])


def within(
    closures: Sequence[LoopClosure], own: KeyframePoses, peer: KeyframePoses, config: LoopClosureConfig
) -> NDArray[np.bool_]:
    """Which loop closures fit to where the alignment of the component places the two robots, within its own error.

    That error is a few times the scale of relative frames, however far the odometry of both robots may drift: it does
    for a start that graduated weights correct.

    Args:
        closures: m of one pair.
        own: keyframes of this end in the common frame.
        peer: keyframes of the peer in the common frame.
        config: scale of relative frames.
    Returns:
        bool [m].
    """
    translation_m, rotation_rad = _off(closures, own, peer)
    return (translation_m < _SCALES * config.frame_sigma_m) & (
        rotation_rad < _SCALES * config.frame_sigma_rad
    )


def _off(closures: Sequence[LoopClosure], own: KeyframePoses, peer: KeyframePoses) -> tuple[Array, Array]:
    """Distances (m, rad) [m] of the peer's keyframes from where loop closures see them."""
    i = np.array([c.own_keyframe for c in closures], dtype=np.int64)
    j = np.array([c.peer_keyframe for c in closures], dtype=np.int64)
    T_peer = peer.T_frame_keyframe[j]
    measured = own.T_frame_keyframe[i] @ np.array([c.T_own_peer for c in closures], dtype=np.float64).reshape(
        -1, 4, 4
    )
    translation_m = np.linalg.norm(measured[:, :3, 3] - T_peer[:, :3, 3], axis=1)
    rotation_rad = np.linalg.norm(so3.log(np.swapaxes(measured[:, :3, :3], 1, 2) @ T_peer[:, :3, :3]), axis=1)
    return translation_m, rotation_rad


def frame_variance(
    closures: Sequence[LoopClosure], own: KeyframePoses, peer: KeyframePoses, config: LoopClosureConfig
) -> tuple[float, float]:
    """Variance (m^2, rad^2) of the relative frame that loop closures agree on, anywhere in the two maps.

    No loop closure is surer than the drift of both robots lets it be, so many are no better here than their mean.

    Args:
        closures: one at least of one pair, from the side of one end.
        own: keyframes of this end, in any one frame.
        peer: keyframes of the peer, in any one frame.
        config: for the sigma floor.
    """
    mean = _whole_variance(closures, own, peer, config).mean(axis=0)
    return float(mean[0]), float(mean[1])


def _whole_variance(
    closures: Sequence[LoopClosure], own: KeyframePoses, peer: KeyframePoses, config: LoopClosureConfig
) -> Array:
    """Variance [m, 2] (m^2, rad^2) of loop closures with all odometry of both robots, over the reach of their maps."""
    index = np.zeros(len(closures), dtype=np.int64)
    covariance = np.linalg.inv(
        closures_as_relative_poses(closures, index, index, config).information + np.eye(6)
    )
    variance = np.diagonal(covariance, axis1=-2, axis2=-1).reshape(-1, 2, 3).mean(axis=-1)
    variance = variance + own.drift[-1] + peer.drift[-1]
    reach_m = max(float(np.linalg.norm(np.ptp(k.T_frame_keyframe[:, :3, 3], axis=0))) for k in (own, peer))
    return variance + np.array([reach_m**2 / 3, 0.0]) * variance[:, 1:]


def robust_frame(frames: Array, config: LoopClosureConfig) -> Array:
    """One motion [4, 4] from many proposals [m, 4, 4]: the best supported one, then a Cauchy-weighted mean.

    Args:
        frames: [m, 4, 4], m > 0, meters.
        config: scales of the Cauchy weights.
    """
    tried = evenly_spaced_to_ends(len(frames), _CANDIDATES)
    support = [float(_cauchy(frames, frames[k], config).sum()) for k in tried]
    T = frames[tried[int(np.argmax(support))]]
    for _ in range(20):
        w = _cauchy(frames, T, config)
        R = so3.project(np.sum(w[:, None, None] * frames[:, :3, :3], axis=0))
        T = se3.from_rotation_translation(R, np.sum(w[:, None] * frames[:, :3, 3], axis=0) / w.sum())
    return T


def _cauchy(frames: Array, T: Array, config: LoopClosureConfig) -> Array:
    """Weight [m] of every proposal, as seen from T."""
    rotation_rad = np.linalg.norm(so3.log(T[:3, :3].T @ frames[:, :3, :3]), axis=1)
    translation_m = np.linalg.norm(frames[:, :3, 3] - T[:3, 3], axis=1)
    distance = (rotation_rad / config.frame_sigma_rad) ** 2 + (translation_m / config.frame_sigma_m) ** 2
    return 1.0 / (1.0 + distance)


def _agreement(
    frames: Array, points: tuple[Array, Array], drifts: tuple[Array, Array], variance: Array, *, margin: float
) -> NDArray[np.bool_]:
    """Which pairs of loop closures agree, bool [m, m]: all else is computed in blocks of rows.

    Args:
        frames: [m, 4, 4], the implied relative frames.
        points: [m, 3] each, the named keyframes of both ends in their own maps, m.
        drifts: [m, 2] each, of these keyframes, m^2 and rad^2.
        variance: [m, 2], of the loop closures, m^2 and rad^2.
        margin: factor on variances.
    """
    m = len(frames)
    # as one row per rotation and without gaps in memory both sums take half the time
    R, t = np.ascontiguousarray(frames[:, :3, :3]), frames[:, :3, 3]
    rows, points_peer = R.reshape(m, 9), points[1]
    at_own = (frames[:, :3, :3] @ points_peer[..., None])[..., 0] + t
    agree, near = np.empty((m, m), dtype=bool), np.empty((m, m), dtype=bool)
    for k in (slice(first, first + _ROWS) for first in range(0, m, _ROWS)):
        limit = variance[k, None] + variance[None]
        for drift_m2_rad2 in drifts:
            limit = limit + np.abs(drift_m2_rad2[k, None] - drift_m2_rad2[None])
        lever_m = np.maximum(*(cdist(p[k], p) for p in points))
        limit_rotation = margin * limit[..., 1]
        limit_translation = margin * limit[..., 0] + limit_rotation * lever_m**2 / 3
        # angle of Rk' Rl from its trace's complement: |Rk - Rl|_F = 2 sqrt2 sin(angle / 2)
        chord = np.sqrt(np.sum((rows[k, None] - rows[None]) ** 2, axis=-1))
        rotation_rad = 2 * np.arcsin(np.minimum(chord / np.sqrt(8.0), 1.0))
        agree[k] = rotation_rad**2 < CHI2_3_999 * limit_rotation
        # distance between the frames at the place of loop closure l, which has to be near from either side
        at_other = np.einsum("kab,lb->kla", R[k], points_peer) + t[k, None]
        near[k] = np.linalg.norm(at_other - at_own[None], axis=-1) ** 2 < CHI2_3_999 * limit_translation
    return agree & (near | near.T)


def _clique(agree: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Greedy largest clique of a symmetric relation, from the ten best connected starts; ties by index."""
    agree = agree.copy()
    np.fill_diagonal(agree, True)
    best: list[int] = []
    for start in np.argsort(-agree.sum(axis=1), kind="stable")[:10].tolist():
        clique, candidates = [start], agree[start].copy()
        candidates[start] = False
        degrees = agree[candidates].sum(axis=0)  # to candidates
        while candidates.any():
            left = np.flatnonzero(candidates)
            chosen = int(left[np.argmax(degrees[left])])
            clique.append(chosen)
            kept = candidates & agree[chosen]
            kept[chosen] = False
            degrees -= agree[candidates & ~kept].sum(axis=0)
            candidates = kept
        if len(clique) > len(best):
            best = clique
    keep = np.zeros(len(agree), dtype=bool)
    keep[best] = True
    return keep


def holder(own: str, peer: str, closures: Sequence[LoopClosure]) -> str:
    """Which end of a pair holds its loop closures: the one that then copies fewer keyframes; the lower name on a tie.

    Args:
        own: name of one end.
        peer: name of the other end.
        closures: from the side of `own`.
    """
    copied_by_own = len({c.peer_keyframe for c in closures})
    copied_by_peer = len({c.own_keyframe for c in closures})
    if copied_by_own == copied_by_peer:
        return min(own, peer)
    return own if copied_by_own < copied_by_peer else peer
