"""What matched features of two views say of a motion between them that was found in another way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.registration import GeometricVerificationConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration.feature_motion import agreeing, inliers_needed, matched_features
from duagc.pipeline.registration.features import Features
from duagc.pipeline.registration.matched_points import information_of_fit, ransac


@dataclass(frozen=True)
class FeatureJudgment:
    """What matched features of two views say of a motion between them.

    Only matches that agree on one motion count, whatever that motion is.

    Attributes:
        inliers: number of these.
        with_given: number of all matches that agree with the given motion.
        given_rad: median angle between a feature and its partner moved by the given motion.
        own_rad: the same by the motion that they agree on.
        T_first_second: [4, 4], that motion.
        information: [6, 6] of its right tangent.
    """

    inliers: int
    with_given: int
    given_rad: float
    own_rad: float
    T_first_second: Array
    information: Array


def judge_motion(
    first: Features,
    second: Features,
    T_first_second: Array,
    *,
    config: GeometricVerificationConfig,
    rng: np.random.Generator,
) -> FeatureJudgment | None:
    """How far apart matched features of two views are at a given motion; None if too few agree on any motion.

    Args:
        first: features of the first view.
        second: features of the second view.
        T_first_second: the given motion, [4, 4].
        config: ratio test, RANSAC, inliers needed.
        rng: draws the samples of RANSAC.
    """
    points = matched_features(first, second, config)
    if len(points[0]) < config.min_inliers:
        return None
    T_own, agree = ransac(*points, inlier_m=config.inlier_m, hypotheses=config.hypotheses, rng=rng)
    if agree.sum() < inliers_needed(len(agree), config):
        return None
    ours, theirs = points[0][agree], points[1][agree]
    given, own = (_median_angle(ours, theirs, T) for T in (T_first_second, T_own))
    return FeatureJudgment(
        int(agree.sum()),
        int(agreeing(*points, T_first_second, config).sum()),
        given,
        own,
        T_own,
        information_of_fit(ours, theirs, T_own),
    )


def angles_between(points: Array, others: Array) -> Array:
    """Angles [...] under which a camera sees points and others apart.

    Args:
        points: [..., 3], in the frame of the camera.
        others: [..., 3], in the same frame.
    """
    across = np.linalg.norm(np.cross(points, others), axis=-1)
    return np.asarray(np.arctan2(across, np.sum(points * others, axis=-1)))


def _median_angle(points_first: Array, points_second: Array, T_first_second: Array) -> float:
    """Median angle between points and their partners as either view sees them, both views together."""
    angles = [
        angles_between(points_first, se3.transform(T_first_second, points_second)),
        angles_between(points_second, se3.transform(se3.inverse(T_first_second), points_first)),
    ]
    return float(np.median(np.concatenate(angles)))
