"""From a candidate pair of keyframes to a closure: 3-D matches, RANSAC, registration."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.exchange import VerificationConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.loop_closures import Closure
from duagc.pipeline.registration import Reference, RgbdPyramid, register
from duagc.pipeline.registration.features import Features, matches, ransac

Array = NDArray[np.float64]


class Verdict(Enum):
    """What became of a candidate."""

    KEPT = "kept"
    UNLIKE = "the neighbor's keyframe resembles no own one"
    NOT_ASKED_FOR = "enough matches, but a closer look was not worth it"
    FEW_MATCHES = "too few matches between all features of the two keyframes"
    FEW_INLIERS = "too few matches agree on one motion"
    NOT_REGISTERED = "registration of the two views failed"
    MOVED = "registration moved far from what the matches say"
    OUTWEIGHED = "lost its weight in the pose consensus"
    ALONE = "kept its weight, but too few others of this pair of robots did"
    UNDECIDED = "other links of the team contradict it, and nothing tells which are false"
    INCONSISTENT = "disagrees with the other closures of this pair of robots"


@dataclass(frozen=True)
class Verified:
    """Outcome of one candidate; closure only if it was kept."""

    verdict: Verdict
    matches: int
    inliers: int
    detail: str = ""
    closure: Closure | None = None


def verify(
    own_keyframe: int,
    peer_keyframe: int,
    own: Features,
    own_pyramid: RgbdPyramid,
    peer: Features,
    peer_reference: Reference,
    ratio: float,
    config: VerificationConfig,
    rng: np.random.Generator,
) -> Verified:
    """Verify one candidate.

    Args:
        own, own_pyramid: all features and the images of the own keyframe.
        peer, peer_reference: features and registration samples of the neighbor's keyframe, as it sent them.
        ratio: of the ratio test. rng: the stream of this pair of keyframes.
    Returns:
        The verdict, and the closure T_own_peer with its information if the verdict is KEPT.
    """
    pairs = matches(own.descriptors, peer.descriptors, ratio)
    if len(pairs) < config.min_inliers:
        return Verified(
            Verdict.FEW_MATCHES, len(pairs), 0, f"{len(pairs)} matches, {config.min_inliers} needed"
        )
    points_own = own.points[pairs[:, 0]].astype(np.float64)
    points_peer = peer.points[pairs[:, 1]].astype(np.float64)
    T_own_peer, agree = ransac(points_own, points_peer, config.inlier_m, config.hypotheses, rng)
    inliers = int(agree.sum())
    needed = max(config.min_inliers, int(np.ceil(config.min_inlier_share * len(pairs))))
    if inliers < needed:
        return Verified(
            Verdict.FEW_INLIERS, len(pairs), inliers, f"{inliers} of {len(pairs)} agree, {needed} needed"
        )
    result = register(peer_reference, own_pyramid, se3.inverse(T_own_peer), config.registration)
    if not result.ok or np.linalg.eigvalsh(result.information)[0] <= 0:
        return Verified(Verdict.NOT_REGISTERED, len(pairs), inliers, f"registration: {result.outcome.value}")
    T_refined = se3.inverse(result.T_reference_target)
    moved_m, moved_rad = (float(d) for d in se3.distance(T_own_peer, T_refined))
    if moved_m > config.max_refinement_m or moved_rad > config.max_refinement_rad:
        return Verified(Verdict.MOVED, len(pairs), inliers, f"by {moved_m:.3f} m and {moved_rad:.3f} rad")
    closure = Closure(
        own_keyframe,
        peer_keyframe,
        T_refined,
        inverse_information(result.T_reference_target, result.information),
    )
    return Verified(
        Verdict.KEPT, len(pairs), inliers, f"refined by {moved_m:.4f} m, {moved_rad:.4f} rad", closure
    )


def inverse_information(T_a_b: Array, information: Array) -> Array:
    """Information [6, 6] of T_b_a in its right tangent, from that of T_a_b: inverse(T exp(x)) = T^-1 exp(-Ad(T) x)."""
    adjoint_inverse = se3.adjoint(se3.inverse(T_a_b))
    out = adjoint_inverse.T @ information @ adjoint_inverse
    return 0.5 * (out + out.T)
