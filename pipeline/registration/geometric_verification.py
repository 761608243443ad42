"""Geometric verification: whether two views show one place, and the motion between them.

Features are matched, RANSAC finds the motion that most matches agree on, and dense registration confirms and refines
it. Loop closures of one robot's path, loop closures between robots and relocalization all pass through here; they
differ in their settings and in what they have of the two views.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.registration import GeometricVerificationConfig, RegistrationConfig
from duagc.pipeline.geometry import projection, se3
from duagc.pipeline.registration.align import Registration, reach_factor, register
from duagc.pipeline.registration.feature_motion import (
    FeatureMotion,
    matched_features,
    motion_of_others,
    motion_of_points,
)
from duagc.pipeline.registration.features import Features
from duagc.pipeline.registration.image_agreement import TexturedParts, textured_parts
from duagc.pipeline.registration.pyramid import RgbdPyramid
from duagc.pipeline.registration.rectified_features import matched_points
from duagc.pipeline.registration.reference import Reference


class Failure(Enum):
    """The test that a pair of views did not pass, in the order of the tests."""

    FEW_MATCHES = "few_matches"
    FEW_INLIERS = "few_inliers"
    NOT_REGISTERED = "not_registered"
    LOW_OVERLAP = "low_overlap"
    DIRECTIONS_DISAGREE = "directions_disagree"
    FAR_FROM_FEATURES = "far_from_features"


@dataclass(frozen=True)
class VerificationView:
    """What is known of one of the two views.

    Attributes:
        features: with depth.
        reference: samples that the other view is registered to; None: the other is not registered to this view.
        images: reads the pyramid that is registered to the other view's samples, called only after the features
            have agreed; None: this view is not registered to the other.
        rectified: features of surfaces as if the camera faced them; they count if both views have them.
    """

    features: Features
    reference: Reference | None = None
    images: Callable[[], RgbdPyramid] | None = None
    rectified: Features | None = None

    @property
    def median_depth_m(self) -> float:
        """Of the samples, of the features without samples; infinite if there are none."""
        points = self.features.points if self.reference is None else self.reference.levels[-1].points
        return float(np.median(points[:, 2])) if len(points) else np.inf


@dataclass(frozen=True)
class MeasuredMotion:
    """A registration of two views in one direction.

    Attributes:
        reference: samples of one view.
        target: the other view.
        result: as it ended.
        T_first_second: [4, 4], by it.
        information: [6, 6] of the right tangent of T_first_second.
        shares_enough: whether the views share enough there.
        of_first: whether the samples are of the first view.
    """

    reference: Reference
    target: RgbdPyramid
    result: Registration
    T_first_second: Array
    information: Array
    shares_enough: bool
    of_first: bool

    @cached_property
    def textured(self) -> TexturedParts:
        """Parts of the target that show texture, and whether it looks alike; centers in the first view's frame."""
        parts = textured_parts(self.reference, self.target, self.result.T_reference_target)
        if self.of_first:
            return parts
        return replace(parts, centers=se3.transform(self.T_first_second, parts.centers))

    @property
    def alike(self) -> float:
        """Share of the texture that both see that looks alike there; 0 where registration failed."""
        return self.textured.share_alike if self.result.ok else 0.0


@dataclass(frozen=True)
class GeometricVerification:
    """Result of `verify`.

    Attributes:
        failure: the first test that failed; None: the pair is verified.
        features: what the features alone gave.
        registration: the decisive registration; None before any.
        T_first_second: [4, 4], by the registration; identity before it.
        information: [6, 6] of its right tangent; zero before it.
        correction_m: how far registration moved the motion that the features gave, at the camera or at the features,
            whichever is less; 0 before it.
        correction_rad: the same for the rotation.
        another: of the other motion, if features agree on two.
        measured: the registrations, in one direction or both.
    """

    failure: Failure | None
    features: FeatureMotion
    registration: Registration | None
    T_first_second: Array
    information: Array
    correction_m: float = 0.0
    correction_rad: float = 0.0
    another: GeometricVerification | None = None
    measured: Sequence[MeasuredMotion] = field(default=(), repr=False)

    @property
    def alike(self) -> float:
        """Share of the texture that both views see that looks alike; 1 before the registration."""
        return min((one.alike for one in self.measured), default=1.0)

    @property
    def texture(self) -> Array:
        """Of textured parts of what a registration lays onto each other, the center and whether both look alike.

        [p, 4]: x, y, z in meters in the frame of the first view, and 1 where they look alike, else 0.
        """
        parts = [one.textured for one in self.measured if one.result.ok]
        rows = [np.column_stack([of.centers, of.alike]) for of in parts]
        return np.concatenate([np.zeros((0, 4)), *rows])

    @property
    def of_place(self) -> GeometricVerification:
        """Of two motions that of the place, which spreads wider: what moves is smaller than what does not."""
        return self if self.another is None else max(self, self.another, key=lambda m: m.features.spread_m)

    @property
    def of_moved(self) -> GeometricVerification | None:
        """Of two motions that of what moved between the views; None if there is one."""
        return self.another if self.of_place is self else self


def verify(
    first: VerificationView,
    second: VerificationView,
    config: GeometricVerificationConfig,
    *,
    registration: RegistrationConfig,
    rng: np.random.Generator,
    both: bool = False,
) -> GeometricVerification:
    """Verify that two views show one place.

    With samples and images of both views they are registered in both directions, which must agree; with samples of
    one and images of the other, in that direction alone.

    Args:
        first: the view whose frame the motion is expressed in.
        second: the other view.
        config: limits of all tests.
        registration: settings of the registrations.
        rng: draws the samples of RANSAC.
        both: verify a second motion as well, on which many of the other features agree: something moved between the
            views.

    Returns:
        The motion with its information, or the first test that failed.
    """
    if first.rectified is None or second.rectified is None:
        points = matched_features(first.features, second.features, config)
    else:
        points = matched_points(
            (first.features, first.rectified), (second.features, second.rectified), config.ratio
        )
    found = motion_of_points(*points, config, rng)
    verified = _verified(found, (first, second), config, registration)
    if not both or found.accepted_motion is None:
        return verified
    other = motion_of_others(found.accepted_motion, *points, config=config, rng=rng)
    if other is None:
        return verified
    return replace(verified, another=_verified(other, (first, second), config, registration))


def _verified(
    found: FeatureMotion,
    views: tuple[VerificationView, VerificationView],
    config: GeometricVerificationConfig,
    registration: RegistrationConfig,
) -> GeometricVerification:
    """What becomes of a motion that features agree on."""

    def failed(failure: Failure, result: Registration | None = None) -> GeometricVerification:
        return GeometricVerification(failure, found, result, np.eye(4), np.zeros((6, 6)))

    if found.T_first_second is None:
        return failed(Failure.FEW_MATCHES)
    if not found.accepted:
        return failed(Failure.FEW_INLIERS)
    guess = found.T_first_second
    measured = _registered(*views, guess, config=config, registration=registration)
    if not measured:
        raise ValueError("geometric verification needs samples of one view and images of the other")
    result, T, information = measured[0].result, measured[0].T_first_second, measured[0].information
    for one in measured:
        if not one.result.ok or np.linalg.eigvalsh(one.result.information)[0] <= 0:
            return failed(Failure.NOT_REGISTERED, one.result)
    if not all(one.shares_enough for one in measured):
        return failed(Failure.LOW_OVERLAP, result)
    apart_m, apart_rad = se3.distance(T, measured[-1].T_first_second)
    reach = reach_factor(max(view.median_depth_m for view in views))
    if apart_m > config.max_disagreement_m * reach or apart_rad > config.max_disagreement_rad:
        return failed(Failure.DIRECTIONS_DISAGREE, result)
    moved_m, moved_rad = (float(d) for d in se3.distance(guess, T))
    at_features = se3.transform(T, found.points) - se3.transform(guess, found.points)
    moved_m = min(moved_m, float(np.mean(np.linalg.norm(at_features, axis=-1))))
    far = moved_m > config.max_refinement_m * reach or moved_rad > config.max_refinement_rad
    return GeometricVerification(
        Failure.FAR_FROM_FEATURES if far else None,
        found,
        result,
        T,
        information,
        correction_m=moved_m,
        correction_rad=moved_rad,
        measured=measured,
    )


def _registered(
    first: VerificationView,
    second: VerificationView,
    T_first_second: Array,
    *,
    config: GeometricVerificationConfig,
    registration: RegistrationConfig,
) -> list[MeasuredMotion]:
    """Registrations from a motion [4, 4], in the directions that are possible."""
    measured = []
    if first.reference is not None and second.images is not None:
        target = second.images()
        forward = register(first.reference, target, T_first_second, registration)
        enough = _shares_enough(forward, first.reference, target, config)
        T, information = forward.T_reference_target, forward.information
        measured.append(
            MeasuredMotion(first.reference, target, forward, T, information, enough, of_first=True)
        )
    if second.reference is not None and first.images is not None:
        target = first.images()
        backward = register(second.reference, target, se3.inverse(T_first_second), registration)
        enough = _shares_enough(backward, second.reference, target, config)
        T = se3.inverse(backward.T_reference_target)
        information = se3.inverse_information(backward.T_reference_target, backward.information)
        measured.append(
            MeasuredMotion(second.reference, target, backward, T, information, enough, of_first=False)
        )
    return measured


def _shares_enough(
    result: Registration, reference: Reference, target: RgbdPyramid, config: GeometricVerificationConfig
) -> bool:
    """Whether the target sees enough of the samples, or samples in enough of its image."""
    if result.overlap >= config.min_overlap:
        return True
    if config.min_covered is None:
        return False
    T, finest, level = se3.inverse(result.T_reference_target), reference.levels[0], target.levels[0]
    points = se3.transform(T, finest.points.astype(np.float64))
    normals = finest.normals.astype(np.float64) @ T[:3, :3].T
    return projection.covered(points, level.camera, level.inverse_depth, normals) >= config.min_covered
