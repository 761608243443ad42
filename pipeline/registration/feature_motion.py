"""Motions between two views that matched features agree on: one, or two where something moved between the views."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.registration import GeometricVerificationConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration.descriptors import matches
from duagc.pipeline.registration.features import Features
from duagc.pipeline.registration.matched_points import information_of_fit, ransac
from duagc.pipeline.registration.rectified_features import matched_points

APART = 3.0  # of the limits: a match so far from a motion follows another one


@dataclass(frozen=True)
class FeatureMotion:
    """The motion that matched features of two views agree on.

    Attributes:
        T_first_second: [4, 4], fitted to the inliers; None with too few matches to try.
        matches: number of matches.
        inliers: number of matches that agree.
        needed: inliers from which the motion is accepted; with too few matches, the matches needed.
        points: [inliers, 3], meters, where the second view has the matches that agree.
        partners: [inliers, 3], meters, where the first view has them.
    """

    T_first_second: Array | None
    matches: int
    inliers: int
    needed: int
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    partners: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def accepted(self) -> bool:
        """Whether enough matches agree."""
        return self.T_first_second is not None and self.inliers >= self.needed

    @property
    def accepted_motion(self) -> Array | None:
        """`T_first_second`, if enough matches agree on it."""
        return self.T_first_second if self.accepted else None

    @property
    def spread_m(self) -> float:
        """Root of the mean squared distance of the points that agree from their mean."""
        return spread_m(self.points)

    @property
    def information(self) -> Array:
        """[6, 6] of the right tangent of an accepted motion, by the distances of the matches that agree."""
        assert self.T_first_second is not None
        return information_of_fit(self.partners, self.points, self.T_first_second)

    def chi2(self, T_first_second: Array) -> float:
        """Squared distance of another motion from an accepted one, in units of its covariance.

        Args:
            T_first_second: [4, 4], the other motion.
        """
        assert self.T_first_second is not None
        apart = se3.log(se3.inverse(self.T_first_second) @ T_first_second)
        return float(apart @ self.information @ apart)


def motion_from_features(
    first: Features, second: Features, config: GeometricVerificationConfig, rng: np.random.Generator
) -> FeatureMotion:
    """Match two views' features and find the motion that most matches agree on.

    Args:
        first: features of the first view.
        second: features of the second view.
        config: ratio test, RANSAC, inliers needed.
        rng: draws the samples of RANSAC.
    """
    return motion_of_points(*matched_features(first, second, config), config, rng)


def motion_from_rectified(
    first: tuple[Features, Features],
    second: tuple[Features, Features],
    config: GeometricVerificationConfig,
    rng: np.random.Generator,
) -> FeatureMotion:
    """`motion_from_features` by features of both kinds.

    Args:
        first: features of the first view, as it is and rectified.
        second: the same of the second view.
        config: ratio test, RANSAC, inliers needed.
        rng: draws the samples of RANSAC.
    """
    return motion_of_points(*matched_points(first, second, config.ratio), config, rng)


def matched_features(
    first: Features, second: Features, config: GeometricVerificationConfig
) -> tuple[Array, Array]:
    """Points [n, 3], meters, of matched features of two views, each in its own frame.

    Args:
        first: features of the first view.
        second: features of the second view.
        config: ratio test.
    """
    pairs = matches(first.descriptors, second.descriptors, config.ratio)
    return first.points[pairs[:, 0]].astype(np.float64), second.points[pairs[:, 1]].astype(np.float64)


def motion_of_points(
    points_first: Array, points_second: Array, config: GeometricVerificationConfig, rng: np.random.Generator
) -> FeatureMotion:
    """The motion that most matched points agree on.

    Args:
        points_first: [n, 3], meters, camera frame of the first view.
        points_second: [n, 3], the same points in the camera frame of the second.
        config: distance of an inlier, number of hypotheses, inliers needed.
        rng: draws the hypotheses.
    """
    n = len(points_first)
    if n < config.min_inliers:
        return FeatureMotion(None, n, 0, config.min_inliers)
    T, agree = ransac(
        points_first, points_second, inlier_m=config.inlier_m, hypotheses=config.hypotheses, rng=rng
    )
    needed = inliers_needed(n, config)
    return FeatureMotion(T, n, int(agree.sum()), needed, points_second[agree], points_first[agree])


def motion_of_others(
    T_first_second: Array,
    points_first: Array,
    points_second: Array,
    *,
    config: GeometricVerificationConfig,
    rng: np.random.Generator,
) -> FeatureMotion | None:
    """The motion of matched points that are far from a given one; None if too few agree.

    Args:
        T_first_second: [4, 4], the given motion.
        points_first: [n, 3], meters, camera frame of the first view.
        points_second: [n, 3], the same points in the camera frame of the second.
        config: as in `motion_of_points`.
        rng: draws the hypotheses.
    """
    others = _apart(points_first, points_second, T_first_second, config) > APART
    motion = motion_of_points(points_first[others], points_second[others], config, rng)
    return replace(motion, matches=len(others)) if motion.accepted else None


def features_agree(
    first: Features, second: Features, T_first_second: Array, config: GeometricVerificationConfig
) -> bool:
    """Whether enough matched features of two views meet at a given motion.

    Args:
        first: features of the first view.
        second: features of the second view.
        T_first_second: the motion, [4, 4].
        config: ratio test, inliers needed.
    """
    agree = _apart(*matched_features(first, second, config), T_first_second, config) < 1
    return int(agree.sum()) >= inliers_needed(len(agree), config)


def follows_something_moved(
    first: Features,
    second: Features,
    T_first_second: Array,
    *,
    config: GeometricVerificationConfig,
    rng: np.random.Generator,
) -> bool:
    """Whether a motion is that of something that moved between two views: others that agree spread wider.

    Args:
        first: features of the first view.
        second: features of the second view.
        T_first_second: the motion, [4, 4].
        config: ratio test, RANSAC, inliers needed.
        rng: draws the samples of RANSAC.
    """
    return motion_spread_wider(first, second, T_first_second, config=config, rng=rng) is not None


def motion_spread_wider(
    first: Features,
    second: Features,
    T_first_second: Array,
    *,
    config: GeometricVerificationConfig,
    rng: np.random.Generator,
) -> FeatureMotion | None:
    """The motion of features that are far from a given one, if they spread wider than those that agree with it.

    Args:
        first: features of the first view.
        second: features of the second view.
        T_first_second: the given motion, [4, 4].
        config: ratio test, RANSAC, inliers needed.
        rng: draws the samples of RANSAC.
    """
    points = matched_features(first, second, config)
    another = motion_of_others(T_first_second, *points, config=config, rng=rng)
    if another is None:
        return None
    agree = _apart(*points, T_first_second, config) < 1
    return another if another.spread_m > spread_m(points[1][agree]) else None


def agreeing(
    points_first: Array, points_second: Array, T_first_second: Array, config: GeometricVerificationConfig
) -> NDArray[np.bool_]:
    """Which matched points [n] agree with a motion.

    Args:
        points_first: [n, 3], meters, camera frame of the first view.
        points_second: [n, 3], the same points in the camera frame of the second.
        T_first_second: the motion, [4, 4].
        config: distance of an inlier.
    """
    return np.asarray(_apart(points_first, points_second, T_first_second, config) < 1)


def _apart(
    points_first: Array, points_second: Array, T_first_second: Array, config: GeometricVerificationConfig
) -> Array:
    """How far [n] matched points [n, 3] are apart under a motion, in the distances below which a match agrees."""
    apart_m = np.linalg.norm(points_first - se3.transform(T_first_second, points_second), axis=-1)
    return np.asarray(apart_m / (config.inlier_m * np.maximum(1.0, points_first[:, 2])))


def spread_m(points: Array) -> float:
    """Root of the mean squared distance of points from their mean, meters.

    Args:
        points: [n, 3], meters, in any frame.
    """
    return float(np.sqrt(np.sum(np.var(points, axis=0)))) if len(points) else 0.0


def inliers_needed(count: int, config: GeometricVerificationConfig) -> int:
    """Matches that must agree on one motion.

    Args:
        count: of all matches.
        config: at least how many, and which share.
    """
    return max(config.min_inliers, int(np.ceil(config.min_inlier_share * count)))
