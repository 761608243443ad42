"""Loops inside one robot's path: places recognized by features, believed only if registrations both ways agree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.config.frontend import LoopConfig
from duagc.pipeline.frontend.bundle import Images, View
from duagc.pipeline.frontend.keyframe_graph import overlap
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.registration import RegistrationConfig
from duagc.pipeline.registration.features import matches
from duagc.pipeline.registration.geometric_verification import VerificationView, verify
from duagc.pipeline.registration.place_recognition import Places

Array = NDArray[np.float64]


def find_loops(
    T_map_keyframes: Array,
    views: Sequence[View],
    images: Images,
    config: LoopConfig,
    registration: RegistrationConfig,
    seed: int,
    robot: str,
) -> list[RelativePose]:
    """Pairs of keyframes that show the same place although their poses say that they do not, or not by enough.

    Candidates have many matching features; three-point samples give a motion; registrations from there, one way and
    the other, must be good and agree. What passes still has only a robust weight in the graph.

    Args:
        T_map_keyframes: [k, 4, 4], as tracked. seed, robot: of the random stream.
    """
    found = []
    places = Places([view.features.descriptors[: config.features_compared] for view in views])
    for second in range(config.min_gap, len(views)):
        candidates = _resembling(views, second, places, config)
        for first in candidates:
            T_first_second = se3.inverse(T_map_keyframes[first]) @ T_map_keyframes[second]
            seen = overlap(views[first].reference.levels[-1], views[second].coarsest, T_first_second)
            if seen >= config.known_overlap:
                continue  # the joint optimization compares them anyway
            pair = _verified(views, images, first, second, config, registration, seed, robot)
            if pair is not None:
                found.append(pair)
    return found


def _resembling(views: Sequence[View], second: int, places: Places, config: LoopConfig) -> list[int]:
    """Earlier keyframes with most matches among the strongest features, ascending.

    Features are compared with those of a bounded number of keyframes only, however many there are.
    """
    most = config.features_compared
    theirs = views[second].features.descriptors[:most]
    scored = []
    for first in places.alike(second, second - config.min_gap + 1, config.compared):
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
) -> RelativePose | None:
    """The registration of a candidate, if it withstands all tests."""
    rng = random_streams.generator(seed, "frontend.loop", robot=robot, first=first, second=second)
    levels = len(registration.iterations)
    found = verify(
        VerificationView(views[first].features, views[first].reference, lambda: images(first, levels)),
        VerificationView(views[second].features, views[second].reference, lambda: images(second, levels)),
        config,
        registration,
        rng,
    )
    if found.failure is not None:
        return None
    return RelativePose(first, second, found.T_first_second, found.information)
