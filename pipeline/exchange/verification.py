"""From a candidate pair of keyframes to a loop closure: `registration.geometric_verification`, and its verdict.

To compare with, generalized ICP of the two views' points in its place, from the motion of the features or without any.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.exchange import VerificationConfig
from duagc.pipeline.exchange.place_recognition import Candidate
from duagc.pipeline.exchange.wire.loop_closing_wire import KeyframeSample
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.posegraph.moved_things import TwoMotions
from duagc.pipeline.posegraph.relative_poses import LoopClosure
from duagc.pipeline.registration import RgbdPyramid, geometric_verification
from duagc.pipeline.registration.feature_motion import FeatureMotion, motion_from_features
from duagc.pipeline.registration.features import Features
from duagc.pipeline.registration.geometric_verification import (
    Failure,
    GeometricVerification,
    VerificationView,
)
from duagc.pipeline.registration.gicp import register_points


class Verdict(Enum):
    """What became of a candidate."""

    KEPT = "kept"
    UNLIKE = "the neighbor's keyframe resembles no own one"
    NOT_REQUESTED = "enough matches, but verifying was not worth it"
    FEW_MATCHES = "too few matches between all features of the two keyframes"
    FEW_INLIERS = "too few matches agree on one motion"
    NOT_REGISTERED = "registration of the two views failed"
    MOVED = "registration moved far from the motion of the matches"
    SOMETHING_MOVED = "shows something that moved between the recordings"
    OUTWEIGHED = "lost its weight in the pose consensus"
    ALONE = "kept its weight, but too few others of this pair of robots did"
    UNDECIDED = "other links of the team contradict it, and it is open which are false"
    LOOKS_DIFFERENT = "what both views see looks different, as in all that agree with it"
    INCONSISTENT = "disagrees with the other loop closures of this pair of robots"


@dataclass(frozen=True)
class Verified:
    """Outcome of one candidate.

    Attributes:
        verdict: what became of it.
        matches: of all features.
        inliers: matches that agree on one motion.
        detail: with numbers.
        closure: the loop closure, if the candidate was kept.
        tentative: what matched features agree on where registration failed.
        shown: the motions of the place and of something that moved between the two views, if they show both.
    """

    verdict: Verdict
    matches: int
    inliers: int
    detail: str = ""
    closure: LoopClosure | None = None
    tentative: LoopClosure | None = None
    shown: TwoMotions | None = None


def within_view(
    config: VerificationConfig, camera: PinholeCamera, peer_camera: PinholeCamera
) -> VerificationConfig:
    """The limits with overlaps of what the own camera can see at all of the neighbor's view.

    Overlap is a share of the neighbor's samples, which fill its view. A camera whose view is narrower sees no more of
    them than the ratio of the two, however well it looks at the same place.

    Args:
        config: limits for cameras that are alike.
        camera: the robot's own.
        peer_camera: the neighbor's.
    """
    share = min(1.0, _view(camera) / _view(peer_camera))
    if share == 1.0:
        return config
    within = config.registration.model_copy(update={"min_overlap": share * config.registration.min_overlap})
    return config.model_copy(update={"min_overlap": share * config.min_overlap, "registration": within})


def _view(camera: PinholeCamera) -> float:
    """Area of the image one unit in front of the camera."""
    return camera.width * camera.height / (camera.fx * camera.fy)


def verify(
    candidate: Candidate,
    own: Features,
    own_pyramid: RgbdPyramid,
    sample: KeyframeSample,
    *,
    config: VerificationConfig,
    rng: np.random.Generator,
    rectified: tuple[Features, Features] | None = None,
) -> Verified:
    """Verify one candidate.

    A neighbor sends samples and no images, so that registration is possible in one direction only.

    Args:
        candidate: the two keyframes.
        own: all features of the own keyframe.
        own_pyramid: its images.
        sample: of the neighbor's keyframe, as it sent it.
        config: limits of all tests (`within_view`).
        rng: the stream of this pair of keyframes.
        rectified: features of the surfaces of both views, the own ones first, as if the cameras faced them.

    Returns:
        The verdict, and the loop closure T_own_peer with its information if the verdict is KEPT.
    """
    if config.method != "features":
        return _verified_by_gicp(candidate, own, own_pyramid, sample, config=config, rng=rng)
    faced, faced_by_peer = rectified or (None, None)
    found = geometric_verification.verify(
        VerificationView(own, images=lambda: own_pyramid, rectified=faced),
        VerificationView(sample.features, sample.reference, rectified=faced_by_peer),
        config,
        registration=config.registration,
        rng=rng,
        both=True,
    )
    judged, features = _judged(candidate, found.of_place, config), found.of_place.features
    moved = None if found.of_moved is None else _judged(candidate, found.of_moved, config).closure
    if moved is None or features.T_first_second is None:
        return judged
    place = LoopClosure(*candidate.ends, features.T_first_second, _certainty(features.information, config))
    return replace(judged, shown=TwoMotions(place, moved))


def _judged(candidate: Candidate, found: GeometricVerification, config: VerificationConfig) -> Verified:
    """The verdict on one motion between two views."""
    verdict, detail = _VERDICTS[found.failure], _detail(found)
    closure = tentative = None
    if found.failure is None:
        information = _certainty(found.information, config)
        closure = LoopClosure(
            *candidate.ends, found.T_first_second, information, alike=found.alike, texture=found.texture
        )
    elif (T_features := found.features.accepted_motion) is not None:
        certainty = _certainty(found.features.information, config)
        tentative = LoopClosure(*candidate.ends, T_features, certainty)
    return Verified(verdict, found.features.matches, found.features.inliers, detail, closure, tentative)


def _verified_by_gicp(
    candidate: Candidate,
    own: Features,
    own_pyramid: RgbdPyramid,
    sample: KeyframeSample,
    *,
    config: VerificationConfig,
    rng: np.random.Generator,
) -> Verified:
    """As `verify`, by the points alone once there is a motion to begin with."""
    seen = own_pyramid.levels[0].points
    theirs = sample.reference.levels[0].points.astype(np.float64)
    if config.method == "gicp":
        found = FeatureMotion(np.eye(4), len(theirs), 0, 0)
    else:
        found = motion_from_features(own, sample.features, config, rng)
    if found.T_first_second is None:
        return Verified(Verdict.FEW_MATCHES, found.matches, 0, f"{found.needed} needed")
    if not found.accepted:
        return Verified(Verdict.FEW_INLIERS, found.matches, found.inliers, f"{found.needed} needed")
    result = register_points(seen, theirs, found.T_first_second, config.gicp)
    if result is None or result.overlap < config.min_overlap:
        share = 0.0 if result is None else result.overlap
        return Verified(Verdict.NOT_REGISTERED, found.matches, found.inliers, f"GICP: overlap {share:.2f}")
    moved_m, moved_rad = (float(d) for d in se3.distance(found.T_first_second, result.T_target_source))
    detail = f"refined by {moved_m:.4f} m, {moved_rad:.4f} rad"
    if config.method != "gicp" and (
        moved_m > config.max_refinement_m or moved_rad > config.max_refinement_rad
    ):
        return Verified(Verdict.MOVED, found.matches, found.inliers, detail)
    closure = LoopClosure(*candidate.ends, result.T_target_source, _certainty(result.information, config))
    inliers = result.inliers if config.method == "gicp" else found.inliers
    return Verified(Verdict.KEPT, found.matches, inliers, detail, closure)


def _certainty(information: Array, config: VerificationConfig) -> Array:
    """Information [6, 6] that a loop closure counts with, of that which its registration found."""
    if config.certainty == "measured":
        return information
    return np.diag(np.repeat([config.alike_sigma_m**-2, config.alike_sigma_rad**-2], 3))


_VERDICTS = {
    None: Verdict.KEPT,
    Failure.FEW_MATCHES: Verdict.FEW_MATCHES,
    Failure.FEW_INLIERS: Verdict.FEW_INLIERS,
    Failure.NOT_REGISTERED: Verdict.NOT_REGISTERED,
    Failure.LOW_OVERLAP: Verdict.NOT_REGISTERED,
    Failure.DIRECTIONS_DISAGREE: Verdict.NOT_REGISTERED,
    Failure.FAR_FROM_FEATURES: Verdict.MOVED,
}


def _detail(found: GeometricVerification) -> str:
    """What decided, in words and numbers."""
    features, result = found.features, found.registration
    if found.failure is Failure.FEW_MATCHES:
        return f"{features.matches} matches, {features.needed} needed"
    if found.failure is Failure.FEW_INLIERS:
        return f"{features.inliers} of {features.matches} agree, {features.needed} needed"
    assert result is not None
    if found.failure is Failure.NOT_REGISTERED:
        return f"registration: {result.outcome.value}"
    if found.failure is Failure.FAR_FROM_FEATURES:
        return f"by {found.correction_m:.3f} m and {found.correction_rad:.3f} rad"
    if found.failure is not None:
        return f"registration: {found.failure.value}"
    return f"refined by {found.correction_m:.4f} m, {found.correction_rad:.4f} rad"
