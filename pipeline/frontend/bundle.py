"""Joint optimisation of keyframe poses by the images themselves, and loops inside one robot's path.

`optimise` minimises the sum of the photometric and point-to-plane costs of all pairs of keyframes that see the same
surfaces. Every round linearises every pair at the present poses (`registration.linearise`) and solves all quadratics
together; a registration of each pair by itself would settle into its own minimum first, and pairs with little overlap
find wrong ones. The quadratics of the last round are the factors of the robot's pose graph.

`find_loops` recognises places by features, and believes a pair only if registrations both ways agree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline import streams
from pipeline.frontend.config import KeyframeConfig, LoopConfig
from pipeline.frontend.keyframes import KeyframePair, Refined, overlap, refine
from pipeline.geometry import se3
from pipeline.registration import (
    Level,
    Outcome,
    Reference,
    ReferenceLevel,
    Registration,
    RegistrationConfig,
    RgbdPyramid,
    linearise,
    register,
)
from pipeline.registration.features import Features, matches, ransac

Array = NDArray[np.float64]
SETTLED = 1e-4  # m, rad: Gauss-Newton steps shrink fast, what is left after such a one is far smaller
COARSE_ROUNDS = (
    2  # first rounds, on levels 2 and 1, after a loop: far from the minimum small images lead there faster
)
FAR = 0.02  # m, rad: a registration that contradicts the start by more says that it is far
UNUSABLE = (Outcome.LOW_OVERLAP, Outcome.RESIDUAL)  # weak directions carry no information and do no harm


class View(Protocol):
    """What is kept of a keyframe in memory: samples at all levels, the coarsest image, features."""

    @property
    def reference(self) -> Reference: ...
    @property
    def coarsest(self) -> Level: ...
    @property
    def features(self) -> Features: ...


Images = Callable[[int, int], RgbdPyramid]
"""The images of a keyframe, by its index and the number of levels; read again from the log in every round, so that
memory stays bounded."""


def optimise(
    T_map_keyframes: Array,
    views: Sequence[View],
    images: Images,
    tracked: Sequence[KeyframePair],
    config: KeyframeConfig,
    registration: RegistrationConfig,
) -> tuple[Refined, list[KeyframePair]]:
    """Keyframe poses that explain the images of all overlapping keyframes best; the first keyframe stays.

    Args:
        T_map_keyframes: [k, 4, 4], start. views: of the k keyframes. images: of a keyframe.
        tracked: registrations that connect the keyframes, and loops; they stay where the images say nothing better.
    Returns:
        The poses, and one factor per pair of keyframes: sum of factors = the joint cost at the answer, to second order.
    """
    refined = refine(T_map_keyframes, tracked, config.huber_sigmas)
    factors = list(tracked)
    exposures: dict[tuple[int, int], tuple[float, float]] = {}
    connected = {(pair.first, pair.second): pair for pair in tracked}
    ends: list[tuple[int, int]] = []
    coarse_rounds = COARSE_ROUNDS if _far(T_map_keyframes, tracked) else 0
    for index in range(config.optimisation_rounds):
        T = refined.T_map_keyframe
        if index in (0, coarse_rounds, config.optimisation_rounds // 2):
            ends = sorted(
                {(pair.first, pair.second) for pair in tracked} | set(overlapping(T, views, config)),
                key=lambda pair: (pair[1], pair[0]),
            )
        level = max(0, coarse_rounds - index)
        factors = _linearised(T, views, images, ends, connected, exposures, config, registration, level)
        before, refined = T, refine(T, factors, config.huber_sigmas)
        moved_m, turned_rad = se3.distance(before, refined.T_map_keyframe)
        if index > coarse_rounds and max(moved_m.max(), turned_rad.max()) < SETTLED:
            break
    return refined, factors


def _far(T: Array, pairs: Sequence[KeyframePair]) -> bool:
    """Whether some registration contradicts the poses by more than `FAR`."""
    found = (se3.distance(pair.T_first_second, se3.inverse(T[pair.first]) @ T[pair.second]) for pair in pairs)
    return any(max(moved_m, turned_rad) > FAR for moved_m, turned_rad in found)


def _linearised(
    T: Array,
    views: Sequence[View],
    images: Images,
    ends: Sequence[tuple[int, int]],
    connected: dict[tuple[int, int], KeyframePair],
    exposures: dict[tuple[int, int], tuple[float, float]],
    config: KeyframeConfig,
    registration: RegistrationConfig,
    level: int,
) -> list[KeyframePair]:
    """The quadratics of all pairs at the poses T; of a pair that cannot be compared there, what tracking said."""
    results: dict[tuple[int, int], Registration] = {}
    both_ways = sorted({*ends, *((b, a) for a, b in ends)}, key=lambda pair: (pair[1], pair[0]))
    loaded, pyramid = -1, None
    for reference_index, target in both_ways:
        if target != loaded:
            loaded, pyramid = target, images(target, level + 1)
        assert pyramid is not None
        reference = views[reference_index].reference
        T_reference_target = se3.inverse(T[reference_index]) @ T[target]
        known = exposures.get((reference_index, target))
        if known is None:
            # gain and offset first: with wrong ones the weights of the grey values are wrong
            known = linearise(
                reference, pyramid, T_reference_target, config=registration, level=level
            ).exposure
        result = linearise(reference, pyramid, T_reference_target, known, registration, level)
        if _comparable(result, config.optimisation_overlap):
            exposures[reference_index, target] = result.exposure
            results[reference_index, target] = result
    factors = []
    for first, second in ends:
        T_first_second = se3.inverse(T[first]) @ T[second]
        factor = _factor(
            first, second, T_first_second, results.get((first, second)), results.get((second, first))
        )
        factor = factor or connected.get((first, second))
        if factor is not None:
            factors.append(factor)
    return factors


def _factor(
    first: int, second: int, T_first_second: Array, forth: Registration | None, back: Registration | None
) -> KeyframePair | None:
    """Mean of the quadratics of a pair, one way and the other: both are made of the same two images."""
    information, force = np.zeros((6, 6)), np.zeros(6)
    ways = [way for way in (forth, back) if way is not None]
    if forth is not None:
        information = information + forth.information
        force = force + forth.information @ se3.log(se3.inverse(T_first_second) @ forth.T_reference_target)
    if back is not None:
        # T_second_first moves by -Ad(T_first_second) x if T_first_second moves by x
        turned = -se3.adjoint(T_first_second)
        information = information + turned.T @ back.information @ turned
        force = force + turned.T @ back.information @ se3.log(T_first_second @ back.T_reference_target)
    if not ways:
        return None
    information, force = 0.5 * (information + information.T) / len(ways), force / len(ways)
    step = np.linalg.pinv(information, rcond=1e-10, hermitian=True) @ force
    return KeyframePair(first, second, T_first_second @ se3.exp(step), information)


def _comparable(result: Registration, min_overlap: float) -> bool:
    """Whether two views show enough of the same surfaces at a pose, and agree there."""
    return result.outcome not in UNUSABLE and min(result.overlap, result.view) >= 0.8 * min_overlap


# --- which keyframes see each other -------------------------------------------------------------------------------


def overlapping(T: Array, views: Sequence[View], config: KeyframeConfig) -> list[tuple[int, int]]:
    """Pairs (earlier, later) of keyframes whose overlap, either way, reaches the limit; the best few of each later one.

    The overlap is computed only where the balls around the two views' surfaces meet.
    """
    centres, radii = _balls(T, views)
    pairs = []
    for second in range(1, len(views)):
        distance = np.linalg.norm(centres[:second] - centres[second], axis=1)
        found = []
        for first in np.flatnonzero(distance < radii[:second] + radii[second]).tolist():
            T_first_second = se3.inverse(T[first]) @ T[second]
            share = min(
                overlap(views[first].reference.levels[-1], views[second].coarsest, T_first_second),
                overlap(
                    views[second].reference.levels[-1], views[first].coarsest, se3.inverse(T_first_second)
                ),
            )
            if share >= config.optimisation_overlap:
                found.append((-share, -first))
        pairs += [(-first, second) for _, first in sorted(found)[: config.optimisation_neighbours]]
    return pairs


def _balls(T: Array, views: Sequence[View]) -> tuple[Array, Array]:
    """Centres [k, 3] and radii [k] of balls that hold nine tenths of what each view sees, map frame."""
    centres, radii = np.zeros((len(views), 3)), np.zeros(len(views))
    for k, view in enumerate(views):
        coarsest: ReferenceLevel = view.reference.levels[-1]
        if len(coarsest):
            points = coarsest.points.astype(np.float64)
            centre = np.median(points, axis=0)
            centres[k] = se3.transform(T[k], centre[None])[0]
            radii[k] = np.quantile(np.linalg.norm(points - centre, axis=1), 0.9)
    return centres, radii


# --- loops --------------------------------------------------------------------------------------------------------


def find_loops(
    T_map_keyframes: Array,
    views: Sequence[View],
    images: Images,
    config: LoopConfig,
    registration: RegistrationConfig,
    seed: int,
    robot: str,
) -> list[KeyframePair]:
    """Pairs of keyframes that show the same place although their poses say that they do not, or not by enough.

    Candidates have many matching features; three-point samples give a motion; registrations from there, one way and
    the other, must be good and agree. What passes still has only a robust weight in the graph.

    Args:
        T_map_keyframes: [k, 4, 4], as tracked. seed, robot: of the random stream.
    """
    found = []
    for second in range(config.min_gap, len(views)):
        candidates = _resembling(views, second, config)
        for first in candidates:
            T_first_second = se3.inverse(T_map_keyframes[first]) @ T_map_keyframes[second]
            seen = overlap(views[first].reference.levels[-1], views[second].coarsest, T_first_second)
            if seen >= config.known_overlap:
                continue  # the joint optimisation compares them anyway
            pair = _verified(views, images, first, second, config, registration, seed, robot)
            if pair is not None:
                found.append(pair)
    return found


def _resembling(views: Sequence[View], second: int, config: LoopConfig) -> list[int]:
    """Earlier keyframes with most matches among the strongest features, ascending."""
    most = config.features_compared
    theirs = views[second].features.descriptors[:most]
    scored = []
    for first in range(second - config.min_gap + 1):
        score = len(matches(views[first].features.descriptors[:most], theirs, config.ratio))
        if score >= config.min_matches:
            scored.append((-score, first))
    return sorted(first for _, first in sorted(scored)[: config.candidates])


def _verified(
    views: Sequence[View],
    images: Images,
    first: int,
    second: int,
    config: LoopConfig,
    registration: RegistrationConfig,
    seed: int,
    robot: str,
) -> KeyframePair | None:
    """The registration of a candidate, if it withstands all tests."""
    ours, theirs = views[first].features, views[second].features
    pairs = matches(ours.descriptors, theirs.descriptors, config.ratio)
    if len(pairs) < config.min_inliers:
        return None
    rng = streams.generator(seed, "frontend.loop", robot=robot, first=first, second=second)
    points = ours.points[pairs[:, 0]].astype(np.float64), theirs.points[pairs[:, 1]].astype(np.float64)
    guess, agree = ransac(*points, config.inlier_m, config.hypotheses, rng)
    if agree.sum() < max(config.min_inliers, config.min_inlier_share * len(pairs)):
        return None
    levels = len(registration.iterations)
    forth = register(views[first].reference, images(second, levels), guess, registration)
    back = register(views[second].reference, images(first, levels), se3.inverse(guess), registration)
    if not (forth.ok and back.ok) or min(forth.overlap, back.overlap) < config.min_overlap:
        return None
    apart_m, apart_rad = se3.distance(forth.T_reference_target, se3.inverse(back.T_reference_target))
    if apart_m > config.max_disagreement_m or apart_rad > config.max_disagreement_rad:
        return None
    return KeyframePair(first, second, forth.T_reference_target, forth.information)
