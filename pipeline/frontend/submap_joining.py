"""Joins the submaps of one robot, by the steps that join robots.

Places are recognized by features and verified geometrically; loop closures of two submaps must agree with each other
(`posegraph.loop_closures`), the surfaces must agree too, and around cycles of three submaps the motions must compose to
the identity (`posegraph.cycle_consistency`). What is joined becomes one component: keyframes in the frame of its first
submap, numbered in the order of time, and one pose graph.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import FrontendConfig, SubmapConfig
from duagc.pipeline.frontend.bundle import Images
from duagc.pipeline.frontend.components import Component, Ends, assembled, whole
from duagc.pipeline.frontend.keyframe_graph import OptimizedKeyframes, solve_pose_graph
from duagc.pipeline.frontend.submaps import TrackedSubmap
from duagc.pipeline.frontend.tracked import TrackedKeyframe
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.inverse_depth import inverse_or_zero
from duagc.pipeline.posegraph.cycle_consistency import Placement, Proposal, place
from duagc.pipeline.posegraph.loop_closures import (
    Group,
    KeyframePoses,
    consistent,
    drift,
    frame_variance,
    plausible,
)
from duagc.pipeline.posegraph.moved_things import TwoMotions, following_moved_things
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePose, RelativePoses
from duagc.pipeline.posegraph.surface_agreement import surface_agreement
from duagc.pipeline.registration.geometric_verification import VerificationView, verify
from duagc.pipeline.registration.place_recognition import Places


@dataclass(frozen=True)
class _Link:
    """Two submaps that loop closures connect.

    Attributes:
        closures: all verified ones, from the side of the earlier submap.
        groups: of those that agree, largest first.
        proposals: the relative frame of each group.
    """

    closures: list[LoopClosure]
    groups: list[Group]
    proposals: list[Proposal]


def join_submaps(
    submaps: Sequence[TrackedSubmap], images: Images, config: FrontendConfig, *, seed: int, robot: str
) -> list[Component]:
    """Components of the submaps of a robot, in the order of their first submaps.

    Args:
        submaps: in the order in which they began, at least one.
        images: reads the images of a frame of the log, by its index.
        config: of the front end.
        seed: of the random streams.
        robot: of the random streams.
    """
    if len(submaps) == 1:
        return [whole(submaps[0])]
    solved = [_solved(submap, config) for submap in submaps]
    poses = [_keyframe_poses(s, g, config.submaps) for s, g in zip(submaps, solved, strict=True)]
    links: dict[Ends, _Link] = {}
    for b in range(1, len(submaps)):
        for a in range(b):
            pair, graphs = (submaps[a], submaps[b]), (poses[a], poses[b])
            closures = _closures(pair, graphs, images, config=config, seed=seed, robot=robot)
            link = _link(closures, pair, graphs, config.submaps)
            if link.groups:
                links[a, b] = link
    placement = _placed(links, len(submaps), config.submaps)
    members: dict[int, list[int]] = {}
    for k in range(len(submaps)):
        members.setdefault(_root(k, placement), []).append(k)
    components = []
    for _, joined in sorted(members.items()):
        T_world_map = [placement.T_world_map[_name(k)] for k in joined]
        kept = {
            (joined.index(a), joined.index(b)): _kept(
                links[a, b], (a, b), poses, placement=placement, config=config.submaps
            )
            for a, b in links
            if a in joined and b in joined
        }
        components.append(assembled([submaps[k] for k in joined], T_world_map, kept))
    return components


def _solved(submap: TrackedSubmap, config: FrontendConfig) -> OptimizedKeyframes:
    start = np.array([keyframe.T_map_keyframe for keyframe in submap.keyframes])
    return solve_pose_graph(start, submap.pairs, config.keyframes.huber_sigmas)


def _keyframe_poses(submap: TrackedSubmap, solved: OptimizedKeyframes, config: SubmapConfig) -> KeyframePoses:
    """Keyframes of a submap as seen from its first one, and their drift."""
    T, odometry = solved.T_map_keyframe, []
    for keyframe in submap.keyframes[1:]:
        i, j = keyframe.previous_index, keyframe.keyframe_index
        information = solved.relative_information(i, j)
        odometry.append(RelativePose(i, j, se3.inverse(T[i]) @ T[j], information))
    return KeyframePoses(
        se3.inverse(T[0]) @ T, drift(RelativePoses.of(odometry), len(submap.keyframes), config.closures)
    )


# --- loop closures of a pair of submaps -----------------------------------------------------------------------------


def _closures(
    submaps: tuple[TrackedSubmap, TrackedSubmap],
    poses: tuple[KeyframePoses, KeyframePoses],
    images: Images,
    *,
    config: FrontendConfig,
    seed: int,
    robot: str,
) -> list[LoopClosure]:
    """Verified loop closures from keyframes of one submap to those of another that do not follow what moved."""
    verified, tentative, shown = _verified(*submaps, images, config=config, seed=seed, robot=robot)
    own, peer = poses
    moved = following_moved_things(
        verified, tentative, shown, own=own, peer=peer, config=config.submaps.closures
    )
    return [closure for k, closure in enumerate(verified) if k not in moved]


def _verified(
    first: TrackedSubmap,
    second: TrackedSubmap,
    images: Images,
    *,
    config: FrontendConfig,
    seed: int,
    robot: str,
) -> tuple[list[LoopClosure], list[LoopClosure], list[TwoMotions]]:
    """Loop closures from keyframes of one submap to those of another.

    Verified ones, what features alone agree on, and pairs that show two motions.
    """
    limits, registration = config.submaps, config.tracking.registration
    levels = len(registration.iterations)
    closures: list[LoopClosure] = []
    tentative: list[LoopClosure] = []
    shown: list[TwoMotions] = []

    def view(keyframe: TrackedKeyframe) -> VerificationView:
        return VerificationView(
            keyframe.features, keyframe.reference, partial(images, keyframe.frame_index, levels)
        )

    for i, j in _resembling(first, second, limits):
        one, other = first.keyframes[i], second.keyframes[j]
        rng = random_streams.generator(
            seed, "frontend.submap", robot=robot, first=one.frame_index, second=other.frame_index
        )
        verified = verify(view(one), view(other), limits, registration=registration, rng=rng, both=True)
        place, moved = verified.of_place, verified.of_moved
        if place.failure is None:
            T, information = place.T_first_second, place.information
            closures.append(LoopClosure(i, j, T, information, alike=place.alike, texture=place.texture))
        if (T_features := place.features.accepted_motion) is None:
            continue
        by_features = LoopClosure(i, j, T_features, place.features.information)
        if moved is not None and moved.failure is None:
            thing = LoopClosure(i, j, moved.T_first_second, moved.information)
            shown.append(TwoMotions(by_features, thing))
        elif place.failure is not None:
            tentative.append(by_features)
    return closures, tentative, shown


def _resembling(first: TrackedSubmap, second: TrackedSubmap, config: SubmapConfig) -> list[Ends]:
    """Pairs of keyframes with many matches among their strongest features, the best of every keyframe first."""
    most = config.features_compared
    one = [keyframe.features.descriptors[:most] for keyframe in first.keyframes]
    other = [keyframe.features.descriptors[:most] for keyframe in second.keyframes]
    places = Places([*one, *other])
    ranked = []
    for j in range(len(other)):
        best = places.resembling(len(one) + j, len(one), config)
        ranked += [(rank, -score, i, j) for rank, (score, i) in enumerate(best)]
    return [(i, j) for _, _, i, j in sorted(ranked)[: config.max_verified]]


def _link(
    closures: Sequence[LoopClosure],
    submaps: tuple[TrackedSubmap, TrackedSubmap],
    poses: tuple[KeyframePoses, KeyframePoses],
    config: SubmapConfig,
) -> _Link:
    """What the loop closures of two submaps agree on, where the surfaces agree too."""
    consistency = consistent(closures, *poses, config.closures)
    groups, proposals = [], []
    if consistency.T_ownmap_peermap is not None:
        for group in (Group(consistency.keep, consistency.T_ownmap_peermap), *consistency.others):
            agreement = _agreement(group.T_ownmap_peermap, submaps, poses)
            agreeing = [c for c, keep in zip(closures, group.keep.tolist(), strict=True) if keep]
            if agreement >= config.min_surface_agreement:
                variance = frame_variance(agreeing, *poses, config.closures)
                groups.append(group)
                proposals.append(Proposal(len(agreeing), group.T_ownmap_peermap, variance, agreement))
    return _Link(list(closures), groups, proposals)


def _agreement(
    T_first_second: Array, submaps: tuple[TrackedSubmap, TrackedSubmap], poses: tuple[KeyframePoses, ...]
) -> float:
    """Share of the samples of the second submap that keyframes of the first see at the same place."""
    coarse = [keyframe.coarsest for keyframe in submaps[0].keyframes]
    depths = [inverse_or_zero(c.inverse_depth) for c in coarse]
    samples = [keyframe.reference.levels[-1].points for keyframe in submaps[1].keyframes]
    T_first_keyframe, T_second_keyframe = (p.T_frame_keyframe for p in poses)
    return surface_agreement(
        depths,
        coarse[0].camera,
        samples,
        T_ownmap_keyframe=T_first_keyframe,
        T_ownmap_peer=T_first_second @ T_second_keyframe,
        stride_px=1,
    )


# --- where the submaps lie ------------------------------------------------------------------------------------------


def _name(submap: int) -> str:
    return f"{submap:06d}"  # names are sorted as text


def _placed(links: Mapping[Ends, _Link], count: int, config: SubmapConfig) -> Placement:
    """Where all submaps lie; links that contradict each other, without a sign of which is false, do not count."""
    pairs = {(_name(a), _name(b)): link.proposals for (a, b), link in links.items()}
    names = [_name(k) for k in range(count)]
    while (placement := place(pairs, names, config.closures.margin)).undecided:
        pairs = {pair: proposals for pair, proposals in pairs.items() if pair not in placement.undecided}
    return placement


def _root(submap: int, placement: Placement) -> int:
    name = _name(submap)
    while (nearer := placement.parent[name]) is not None:
        name = nearer
    return int(name)


def _kept(
    link: _Link, ends: Ends, poses: Sequence[KeyframePoses], *, placement: Placement, config: SubmapConfig
) -> list[LoopClosure]:
    """The loop closures of two submaps that fit to where both were placed."""
    a, b = (_name(k) for k in ends)
    chosen = placement.chosen.get((a, b))
    if chosen is None:
        return []
    own, peer = (poses[k].moved(placement.T_world_map[_name(k)]) for k in ends)
    agreeing = link.groups[chosen].keep
    fitting = agreeing & plausible(link.closures, own, peer, config.closures)
    keep = fitting if fitting.any() else agreeing  # a component must stay connected
    return [closure for closure, kept in zip(link.closures, keep.tolist(), strict=True) if kept]
