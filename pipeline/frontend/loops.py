"""Loop closures within one robot's path: places recognized by features and verified geometrically."""

from __future__ import annotations

from collections.abc import Sequence

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS, Checkpoints
from duagc.pipeline.config.frontend import LoopConfig
from duagc.pipeline.frontend.bundle import Images, KeyframeView
from duagc.pipeline.frontend.keyframe_graph import overlap
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.registration import RegistrationConfig
from duagc.pipeline.registration.geometric_verification import VerificationView, verify
from duagc.pipeline.registration.place_recognition import Places


def find_loops(
    T_map_keyframes: Array,
    views: Sequence[KeyframeView],
    images: Images,
    *,
    config: LoopConfig,
    registration: RegistrationConfig,
    seed: int,
    robot: str,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
    part: str = "loops",
) -> list[RelativePose]:
    """Pairs of keyframes that show the same place although by their poses they overlap little or not at all.

    Candidates have many matching features; they are verified by registrations in both directions. A loop closure still
    has only a robust weight in the graph.

    Args:
        T_map_keyframes: [k, 4, 4], by the registrations of tracking.
        views: of the k keyframes.
        images: reads the images of a keyframe.
        config: limits.
        registration: settings of the registrations.
        seed: of the random stream.
        robot: of the random stream.
        checkpoints: of the stage.
        part: its name there.
    """
    first_left, found = checkpoints.resume(part) or (config.min_gap, [])
    places = Places([view.features.descriptors[: config.features_compared] for view in views])
    for second in range(first_left, len(views)):
        for first in sorted(k for _, k in places.resembling(second, second - config.min_gap + 1, config)):
            T_first_second = se3.inverse(T_map_keyframes[first]) @ T_map_keyframes[second]
            seen = overlap(views[first].reference.levels[-1], views[second].coarsest, T_first_second)
            if seen >= config.known_overlap:
                continue  # the joint optimization compares them anyway
            rng = random_streams.generator(seed, "frontend.loop", robot=robot, first=first, second=second)
            verified = verify(
                _verification_view(views[first], first, images, registration),
                _verification_view(views[second], second, images, registration),
                config,
                registration=registration,
                rng=rng,
            )
            if verified.failure is None:
                found.append(RelativePose(first, second, verified.T_first_second, verified.information))
        checkpoints.at(part, second + 1, len(views), lambda: found)
    return found


def _verification_view(
    view: KeyframeView, index: int, images: Images, registration: RegistrationConfig
) -> VerificationView:
    levels = len(registration.iterations)
    return VerificationView(view.features, view.reference, lambda: images(index, levels))
