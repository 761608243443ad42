"""Closures between two robots: which of them agree, and the relative frame they agree on.

Pairwise consistency only chooses the *start* (`docs/explanation/pose-consensus.md`): used as a filter it loses good
closures. The graduated weights of `duagc.pipeline.consensus.pose_admm` may let every closure back in, or throw it out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.config.consensus import ClosureConfig
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.posegraph.factors import Factors, inflated

Array = NDArray[np.float64]
CHI2_3_999 = 16.27  # 99.9 % quantile of chi^2 with 3 degrees of freedom
_OTHER_GROUPS = 2  # beside the largest, that a cycle of three robots may find to be the right ones
_CANDIDATES = 150  # relative frames tried as the start of the mean


@dataclass(frozen=True)
class Closure:
    """One verified relative pose between a keyframe of the holder and a keyframe of a peer.

    T_own_peer [4, 4]: peer keyframe's coordinates to own keyframe's. information [6, 6]: right tangent (translation,
    rotation) of the measured motion, which is T_own_peer, or T_peer_own if `measured_from_peer`. Turning a closure
    round for the other end keeps the measured motion, so that the objective does not depend on who holds it.
    """

    own_keyframe: int
    peer_keyframe: int
    T_own_peer: Array
    information: Array
    measured_from_peer: bool = False

    def reversed(self) -> Closure:
        """The same measurement as its peer writes it down."""
        T_peer_own = se3.inverse(self.T_own_peer)
        return Closure(
            self.peer_keyframe, self.own_keyframe, T_peer_own, self.information, not self.measured_from_peer
        )


@dataclass(frozen=True)
class Consistency:
    """What the closures of one pair of robots say together.

    keep: bool [m], the largest mutually consistent group. T_ownmap_peermap: [4, 4], or None if too few agree.
    reasons: one per closure, in words. support: size of the group. others: smaller groups, disjoint, largest first.
    """

    keep: NDArray[np.bool_]
    T_ownmap_peermap: Array | None
    reasons: tuple[str, ...]
    support: int
    others: tuple[Group, ...] = ()


@dataclass(frozen=True)
class Group:
    """Closures that agree with each other, bool [m], and the relative frame [4, 4] that they agree on."""

    keep: NDArray[np.bool_]
    T_ownmap_peermap: Array


def closure_factors(
    closures: Sequence[Closure], own_variable: ArrayLike, peer_variable: ArrayLike, config: ClosureConfig
) -> Factors:
    """Closures as factors of a solver, with the sigma floor of `config` added.

    Args:
        closures: of one pair of robots, m in number.
        own_variable, peer_variable: int [m], the solver's variables of each closure's two keyframes.
    """
    own, peer = np.asarray(own_variable, dtype=np.int64), np.asarray(peer_variable, dtype=np.int64)
    turned = np.array([c.measured_from_peer for c in closures], dtype=bool)
    T_own_peer = np.array([c.T_own_peer for c in closures], dtype=np.float64).reshape(-1, 4, 4)
    information = np.array([c.information for c in closures], dtype=np.float64).reshape(-1, 6, 6)
    floor = np.repeat([config.sigma_floor_m**2, config.sigma_floor_rad**2], 3)
    return Factors(
        np.where(turned, peer, own),
        np.where(turned, own, peer),
        np.where(turned[:, None, None], se3.inverse(T_own_peer), T_own_peer),
        inflated(information, floor * np.eye(6)),
    )


def drift(odometry: Factors, keyframes: int, config: ClosureConfig) -> Array:
    """Accumulated variance of the odometry along the keyframes, the input of `consistent`.

    Args:
        odometry: factors between own keyframes, each usually to the keyframe that it was tracked against.
        keyframes: how many there are.
    Returns:
        [keyframes, 2], not falling: translation m^2 and rotation rad^2 per axis, from keyframe 0 to keyframe k along
        the surest earlier keyframe. One that nothing ties to an earlier one counts with one square meter and one
        square radian.
    """
    covariance = np.linalg.inv(odometry.information + np.eye(6))  # the identity is that weak prior
    variances = np.diagonal(covariance, axis1=-2, axis2=-1).reshape(-1, 2, 3).mean(axis=-1)
    ties: dict[int, list[tuple[int, Array]]] = {}
    for i, j, variance in zip(odometry.i.tolist(), odometry.j.tolist(), variances, strict=True):
        ties.setdefault(max(i, j), []).append((min(i, j), variance))
    floor = np.array([config.drift_floor_m**2, config.drift_floor_rad**2])
    grown = np.zeros((keyframes, 2))
    for k in range(1, keyframes):
        ways = [grown[i] + variance for i, variance in ties.get(k, [])]
        grown[k] = np.min([grown[k - 1] + 1.0, *ways], axis=0) + floor
        grown[k] = np.maximum(grown[k], grown[k - 1])
    return grown


def consistent(
    closures: Sequence[Closure],
    T_map_keyframe_own: Array,
    T_map_keyframe_peer: Array,
    drift_own: Array,
    drift_peer: Array,
    config: ClosureConfig,
) -> Consistency:
    """Largest group of mutually consistent closures of one pair of robots, and its relative frame.

    Two closures k and l are consistent if the relative frames of the two maps that each implies agree within the
    variance of both closures and of both robots' odometry between them, where they overlap: that is the error of the
    cycle own k -> peer k -> peer l -> own l.

    Args:
        closures: all of one pair, measured by or turned to one end.
        T_map_keyframe_own, T_map_keyframe_peer: [n, 4, 4], each robot's keyframes in its own map, by keyframe index;
            only those named by closures are read.
        drift_own, drift_peer: [n, 2] from `drift`, likewise.
    """
    m = len(closures)
    if m == 0:
        return Consistency(np.zeros(0, dtype=bool), None, (), 0)
    i = np.array([c.own_keyframe for c in closures], dtype=np.int64)
    j = np.array([c.peer_keyframe for c in closures], dtype=np.int64)
    own, peer = np.asarray(T_map_keyframe_own)[i], np.asarray(T_map_keyframe_peer)[j]
    # T_ownmap_peermap implied by each closure
    frames = own @ np.array([c.T_own_peer for c in closures], dtype=np.float64) @ se3.inverse(peer)
    rotation_rad, translation_m = _disagreement(frames, peer[:, :3, 3])
    information = closure_factors(closures, i, j, config).information
    closure_variance = np.linalg.inv(information + np.eye(6))
    closure_variance = np.diagonal(closure_variance, axis1=-2, axis2=-1).reshape(-1, 2, 3).mean(axis=-1)
    variance = closure_variance[:, None] + closure_variance[None]
    variance = variance + np.abs(drift_own[i][:, None] - drift_own[i][None])
    variance = variance + np.abs(drift_peer[j][:, None] - drift_peer[j][None])
    lever_m = np.maximum(_distances(own[:, :3, 3]), _distances(peer[:, :3, 3]))
    variance_rotation = config.margin * variance[..., 1]
    variance_translation = config.margin * variance[..., 0] + variance_rotation * lever_m**2 / 3
    agree = (rotation_rad**2 < CHI2_3_999 * variance_rotation) & (
        translation_m**2 < CHI2_3_999 * variance_translation
    )
    keep = _clique(agree | agree.T)
    support = int(keep.sum())
    if support < config.min_support:
        reason = f"largest consistent group has {support} of {m} closures, needs {config.min_support}"
        return Consistency(np.zeros(m, dtype=bool), None, (reason,) * m, support)
    rejected = f"disagrees with the consistent group of {support} among {m} closures"
    reasons = tuple("consistent" if k else rejected for k in keep.tolist())
    others: list[Group] = []
    left = ~keep
    while len(others) < _OTHER_GROUPS and np.count_nonzero(left) >= config.min_support:
        group = np.zeros(m, dtype=bool)
        group[np.flatnonzero(left)[_clique((agree | agree.T)[np.ix_(left, left)])]] = True
        if group.sum() < config.min_support:
            break
        others.append(Group(group, robust_frame(frames[group], config)))
        left &= ~group
    return Consistency(keep, robust_frame(frames[keep], config), reasons, support, tuple(others))


def plausible(
    closures: Sequence[Closure],
    T_world_keyframe_own: Array,
    T_world_keyframe_peer: Array,
    drift_own: Array,
    drift_peer: Array,
    config: ClosureConfig,
) -> NDArray[np.bool_]:
    """Which closures fit to where the frames of the component put the two robots.

    They need not have been put there by these closures: frames follow the best supported links. A closure is
    implausible if it is farther from that than its own variance and the whole odometry of both robots explain (times
    `margin`). Like the pairwise test this only chooses the start of the robust weights.

    Args:
        closures: of one pair. T_world_keyframe_own, T_world_keyframe_peer: [n, 4, 4], by keyframe index.
        drift_own, drift_peer: [n, 2] from `drift`.
    Returns:
        bool [m].
    """
    i = np.array([c.own_keyframe for c in closures], dtype=np.int64)
    j = np.array([c.peer_keyframe for c in closures], dtype=np.int64)
    own, peer = np.asarray(T_world_keyframe_own), np.asarray(T_world_keyframe_peer)
    measured = own[i] @ np.array([c.T_own_peer for c in closures], dtype=np.float64).reshape(-1, 4, 4)
    translation_m = np.linalg.norm(measured[:, :3, 3] - peer[j, :3, 3], axis=1)
    rotation_rad = np.linalg.norm(so3.log(np.swapaxes(measured[:, :3, :3], 1, 2) @ peer[j, :3, :3]), axis=1)
    variance = _whole_variance(closures, own, peer, drift_own, drift_peer, config)
    limit = CHI2_3_999 * config.margin * variance
    return (rotation_rad**2 < limit[:, 1]) & (translation_m**2 < limit[:, 0])


def frame_variance(
    closures: Sequence[Closure],
    T_map_keyframe_own: Array,
    T_map_keyframe_peer: Array,
    drift_own: Array,
    drift_peer: Array,
    config: ClosureConfig,
) -> tuple[float, float]:
    """Variance (m^2, rad^2) of the relative frame that closures agree on, anywhere in the two maps.

    No closure is surer than the drift of both robots lets it be, so many are no better here than their mean.
    """
    poses = np.asarray(T_map_keyframe_own), np.asarray(T_map_keyframe_peer)
    mean = _whole_variance(closures, *poses, drift_own, drift_peer, config).mean(axis=0)
    return float(mean[0]), float(mean[1])


def _whole_variance(
    closures: Sequence[Closure],
    own: Array,
    peer: Array,
    drift_own: Array,
    drift_peer: Array,
    config: ClosureConfig,
) -> Array:
    """Variance [m, 2] (m^2, rad^2) of closures with the whole odometry of both robots, over the reach of their maps."""
    index = np.zeros(len(closures), dtype=np.int64)
    covariance = np.linalg.inv(closure_factors(closures, index, index, config).information + np.eye(6))
    variance = np.diagonal(covariance, axis1=-2, axis2=-1).reshape(-1, 2, 3).mean(axis=-1)
    variance = variance + drift_own[-1] + drift_peer[-1]
    reach_m = max(float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0))) for poses in (own, peer))
    return variance + np.array([reach_m**2 / 3, 0.0]) * variance[:, 1:]


def robust_frame(frames: Array, config: ClosureConfig) -> Array:
    """One motion [4, 4] from many proposals [m, 4, 4]: the best supported one, then a Cauchy-weighted mean."""
    tried = np.unique(np.linspace(0, len(frames) - 1, _CANDIDATES).round().astype(np.int64))
    support = [float(_cauchy(frames, frames[k], config).sum()) for k in tried]
    T = frames[tried[int(np.argmax(support))]]
    for _ in range(20):
        w = _cauchy(frames, T, config)
        R = so3.project(np.sum(w[:, None, None] * frames[:, :3, :3], axis=0))
        T = se3.from_rotation_translation(R, np.sum(w[:, None] * frames[:, :3, 3], axis=0) / w.sum())
    return T


def _cauchy(frames: Array, T: Array, config: ClosureConfig) -> Array:
    """Weight [m] of every proposal, as seen from T."""
    rotation_rad = np.linalg.norm(so3.log(T[:3, :3].T @ frames[:, :3, :3]), axis=1)
    translation_m = np.linalg.norm(frames[:, :3, 3] - T[:3, 3], axis=1)
    distance = (rotation_rad / config.frame_sigma_rad) ** 2 + (translation_m / config.frame_sigma_m) ** 2
    return 1.0 / (1.0 + distance)


def _disagreement(frames: Array, points_peermap: Array) -> tuple[Array, Array]:
    """Angle and distance [m, m] between implied frames k and l, the distance at closure l's own place."""
    R, t = frames[:, :3, :3], frames[:, :3, 3]
    # angle of Rk' Rl from its trace's complement: |Rk - Rl|_F = 2 sqrt2 sin(angle / 2)
    chord = np.sqrt(np.sum((R[:, None] - R[None]) ** 2, axis=(-1, -2)))
    rotation_rad = 2 * np.arcsin(np.minimum(chord / np.sqrt(8.0), 1.0))
    at_own = (R @ points_peermap[..., None])[..., 0] + t
    at_other = np.einsum("kab,lb->kla", R, points_peermap) + t[:, None]
    translation_m = np.linalg.norm(at_other - at_own[None], axis=-1)
    return rotation_rad, np.minimum(translation_m, translation_m.T)


def _distances(points: Array) -> Array:
    return np.linalg.norm(points[:, None] - points[None], axis=-1)


def _clique(agree: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Greedy largest clique of a symmetric relation, from the ten best connected starts; ties by index."""
    agree = agree.copy()
    np.fill_diagonal(agree, True)
    best: list[int] = []
    for start in np.argsort(-agree.sum(axis=1), kind="stable")[:10].tolist():
        clique, candidates = [start], agree[start].copy()
        candidates[start] = False
        while candidates.any():
            left = np.flatnonzero(candidates)
            chosen = int(left[np.argmax(agree[np.ix_(left, left)].sum(axis=1))])
            clique.append(chosen)
            candidates &= agree[chosen]
            candidates[chosen] = False
        if len(clique) > len(best):
            best = clique
    keep = np.zeros(len(agree), dtype=bool)
    keep[best] = True
    return keep


def holder(own: str, peer: str, closures: Sequence[Closure]) -> str:
    """Which end of a pair holds its closures: the one that then copies fewer keyframes; the lower name on a tie.

    Args:
        closures: as `own` writes them down.
    """
    copied_by_own = len({c.peer_keyframe for c in closures})
    copied_by_peer = len({c.own_keyframe for c in closures})
    if copied_by_own == copied_by_peer:
        return min(own, peer)
    return own if copied_by_own < copied_by_peer else peer


def chain_frames(
    pairs: Mapping[tuple[str, str], tuple[Array, float]], robots: Sequence[str]
) -> dict[str, Array]:
    """Frames of all robots in their component's root, the lowest name, along the best supported spanning tree.

    Args:
        pairs: (a, b) -> (T_amap_bmap, support); one direction of each pair is enough.
        robots: all names.
    Returns:
        T_world_map [4, 4] of every robot; the identity for every root, a robot without a partner included.
    """
    motion = {}
    for (a, b), (T_a_b, _) in pairs.items():
        motion[a, b] = np.asarray(T_a_b)
        motion.setdefault((b, a), se3.inverse(T_a_b))
    parent = spanning_tree({pair: support for pair, (_, support) in pairs.items()}, robots)
    T_world_map: dict[str, Array] = {}
    for robot, nearer in parent.items():
        T_world_map[robot] = np.eye(4) if nearer is None else T_world_map[nearer] @ motion[nearer, robot]
    return T_world_map


def spanning_tree(pairs: Mapping[tuple[str, str], float], robots: Sequence[str]) -> dict[str, str | None]:
    """Parent of every robot in its component's best supported tree, parents first; None for every root.

    Args:
        pairs: (a, b) -> support; one direction of each pair is enough.
        robots: all names; the lowest of a component is its root.
    """
    support = {**{(b, a): value for (a, b), value in pairs.items()}, **pairs}
    parent: dict[str, str | None] = {}
    for root in sorted(robots):
        if root in parent:
            continue
        parent[root] = None
        component = {root}
        while border := [(-support[e], e) for e in support if e[0] in component and e[1] not in component]:
            a, b = min(border)[1]
            parent[b] = a
            component.add(b)
    return parent
