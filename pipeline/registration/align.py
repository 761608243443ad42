"""Motion between two RGB-D views by joint point-to-plane and photometric Gauss-Newton.

The residuals (`residuals.py`) are minimized together over the right tangent (translation, rotation) of
T_reference_target and an affine brightness (gain, offset), from the coarsest pyramid level to the finest.
Point-to-plane alone slides along walls, gray values alone know no scale; together they hold all six directions
(Steinbruecker et al. 2011; Kerl et al. 2013; Park et al. 2017). At the finest level either kind counts by its own
information, its correlated errors included (`System.by_correlation`).

Directions that the images do not determine (a bare wall) stay where the guess or its prior has them and carry zero
information (solution remapping: Zhang, Kaess and Singh 2016).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.registration import RegistrationConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import compiled, search
from duagc.pipeline.registration.image_agreement import same_under_other_light
from duagc.pipeline.registration.normal_equations import System, excess, regular
from duagc.pipeline.registration.pyramid import RgbdPyramid
from duagc.pipeline.registration.reference import Reference
from duagc.pipeline.registration.search import ALL_DIRECTIONS, orthonormal

FAR_M = 6.0
"""Median depth from which limits of distances grow in proportion: outdoors cameras move faster."""


def reach_factor(median_depth_m: float) -> float:
    """Factor of limits in meters that hold indoors.

    Args:
        median_depth_m: of what is seen; not finite: nothing.
    """
    return max(1.0, median_depth_m / FAR_M) if math.isfinite(median_depth_m) else 1.0


class Outcome(Enum):
    """How a registration ended. Only OK may be used as a measurement."""

    OK = "ok"
    LOW_OVERLAP = "low_overlap"
    ILL_CONDITIONED = "ill_conditioned"
    RESIDUAL = "residual"
    JUMP = "jump"


@dataclass(frozen=True)
class Registration:
    """The motion between a reference and a target view.

    Attributes:
        T_reference_target: [4, 4].
        information: [6, 6], inverse covariance of its right tangent (translation m, rotation rad); zero if nothing
            was measured.
        outcome: how it ended.
        overlap: fraction of the samples that the target sees on the same surface, of those whose place it measured well
            enough to tell.
        view: fraction of the samples inside the target image.
        conflict: fraction of the samples, of those too, in space that it saw to be free.
        rms_depth_m: weighted depth residual, meters.
        rms_gray: weighted gray residual.
        exposure: (gain, offset) with target gray = gain * reference gray + offset.
        samples: how many agree.
        overconfidence: factor >= 1 by which the normal matrix, of weights by correlation, was divided to give the
            information.
        condition: ratio of the largest to the smallest eigenvalue of the information before weak directions were
            removed, rotations scaled by the median depth.
        weak: [m, 6], directions in the right tangent that the images do not determine; the information is zero along
            them.
    """

    T_reference_target: Array
    information: Array
    outcome: Outcome
    overlap: float
    view: float
    conflict: float
    rms_depth_m: float
    rms_gray: float
    exposure: tuple[float, float]
    samples: int
    overconfidence: float
    condition: float
    weak: Array = field(default_factory=lambda: np.zeros((0, 6)))

    @property
    def ok(self) -> bool:
        """Whether the result may be used as a measurement."""
        return self.outcome is Outcome.OK


def register(
    reference: Reference,
    pyramid: RgbdPyramid,
    T_reference_target_guess: Array,
    config: RegistrationConfig | None = None,
    *,
    prior_information: Array | None = None,
) -> Registration:
    """Register a target view to a reference.

    Args:
        reference: samples per level; at least as many levels as `pyramid`.
        pyramid: the target view. `without_depth`, gray values alone are used, and every sample inside the
            image counts as seen: overlap is then the view.
        T_reference_target_guess: where to start, [4, 4].
        config: limits and noise; None: the defaults.
        prior_information: [6, 6] in the right tangent of the guess; pulls toward it, is not part of the
            information returned.

    Returns:
        The motion with an outcome; if that is not OK, the motion is the best found and must not be trusted.
    """
    config = config or RegistrationConfig()
    guess = orthonormal(np.asarray(T_reference_target_guess, dtype=np.float64))

    def minimum(projection: Array) -> tuple[Array, Array, System]:
        return compiled.minimize(
            reference, pyramid, guess, config, prior_information=prior_information, projection=projection
        )

    T, exposure, system = minimum(ALL_DIRECTIONS)
    found = _Determined.by(system, config)
    if len(found.weak) and system.seen.agreeing >= config.min_samples:
        # once more without the weak directions: what was found along them is noise
        T, exposure, system = minimum(found.projection)
        found = _Determined.by(system, config).without(found)
    return _judge(
        system,
        found,
        T,
        guess,
        views=(reference, pyramid),
        exposure=exposure,
        config=config,
        prior_information=prior_information,
    )


def linearize(
    reference: Reference,
    pyramid: RgbdPyramid,
    T_reference_target: Array,
    exposure: tuple[float, float] = (1.0, 0.0),
    *,
    config: RegistrationConfig | None = None,
    level: int = 0,
) -> Registration:
    """The cost of a pair near one pose, as a quadratic: to minimize the costs of many pairs together.

    Args:
        reference: as for `register`.
        pyramid: as for `register`.
        T_reference_target: [4, 4], where the cost is expanded.
        exposure: (gain, offset) there.
        config: limits and noise; None: the defaults.
        level: of the pyramid that is used, 0 = finest.

    Returns:
        Information at that pose, and the pose and exposure one Gauss-Newton step from it: the minimum of the
        quadratic. Along weak directions there is no step and no information. The outcome is that of `register`.
    """
    config = config or RegistrationConfig()
    T = orthonormal(np.asarray(T_reference_target, dtype=np.float64))
    start = np.array(exposure)
    system = compiled.linearize_at(reference, pyramid, level, T, exposure=start, config=config)
    if config.weights_by_correlation and level == 0:
        system = system.by_correlation()
    step = search.step(system, T, T, None, projection=ALL_DIRECTIONS)
    found = _Determined.by(system.moved(step), config)  # away from it gradients tell of the distance as well
    if found.projection is not ALL_DIRECTIONS:
        step = search.step(system, T, T, None, projection=found.projection)
    T_minimum, exposure_minimum = T @ se3.exp(step[:6]), start + step[6:]
    return _judge(
        system,
        found,
        T_minimum,
        T,
        views=(reference, pyramid),
        exposure=exposure_minimum,
        config=config,
        prior_information=None,
    )


@dataclass(frozen=True)
class _Determined:
    """What the residuals at one pose determine.

    Attributes:
        information: [6, 6].
        weak: [m, 6], directions that are not determined.
        projection: [6, 6], takes a tangent to its part along the other directions.
        overconfidence: as in `Registration`.
        condition: as in `Registration`.
    """

    information: Array
    weak: Array
    projection: Array
    overconfidence: float
    condition: float

    @staticmethod
    def by(system: System, config: RegistrationConfig) -> _Determined:
        """From the residuals, by the limits of a configuration."""
        H, _ = system.normal_equations()
        overconfidence = _overconfidence(system, H)
        # the brightness was estimated with the pose: its uncertainty is the pose's too (Schur complement)
        information = H[:6, :6] - H[:6, 6:] @ np.linalg.solve(H[6:, 6:] + np.eye(2), H[6:, :6])
        information = information / overconfidence
        information = 0.5 * (information + information.T)
        lever = _lever(system)
        values, vectors = np.linalg.eigh(information * np.outer(lever, lever))
        known = values * _max_sigma_m(system, config) ** 2 >= 1
        strong, projection = vectors[:, known], ALL_DIRECTIONS
        if not known.all():
            projection = (lever[:, None] * strong) @ (strong.T / lever)
            information = (strong * values[known]) @ strong.T / np.outer(lever, lever)
        weak = (vectors[:, ~known] * lever[:, None]).T
        weak = weak / np.linalg.norm(weak, axis=1, keepdims=True)
        condition = float(values[-1] / values[0]) if values[0] > 0 else float("inf")
        return _Determined(information, weak, projection, overconfidence, condition)

    def without(self, before: _Determined) -> _Determined:
        """The same with nothing known along the directions that were weak before."""
        P = before.projection
        information = P.T @ self.information @ P
        return replace(
            self,
            information=0.5 * (information + information.T),
            weak=before.weak,
            projection=P,
            condition=before.condition,
        )


def _max_sigma_m(system: System, config: RegistrationConfig) -> float:
    """Standard deviation at the median depth above which a direction is weak."""
    return config.max_sigma_m * reach_factor(system.seen.median_depth_m)


def _lever(system: System) -> Array:
    """Scales of the tangent [6] by which a rotation counts as the displacement at the median depth."""
    return np.array([1.0, 1.0, 1.0, *[1.0 / max(system.seen.median_depth_m, 0.1)] * 3])


def _judge(
    system: System,
    found: _Determined,
    T: Array,
    guess: Array,
    *,
    views: tuple[Reference, RgbdPyramid],
    exposure: Array,
    config: RegistrationConfig,
    prior_information: Array | None,
) -> Registration:
    """Outcome and figures of the final pose."""
    lever = _lever(system)
    known = found.information if prior_information is None else found.information + prior_information
    weakest = float(np.linalg.eigvalsh(known * np.outer(lever, lever))[0])
    moved_m, turned_rad = se3.distance(guess, T)
    gain = exposure[0]
    if system.seen.agreeing < config.min_samples or system.seen.overlap < config.min_overlap:
        outcome = Outcome.LOW_OVERLAP
    elif (
        system.seen.conflict > config.max_conflict
        or system.depth.scale > config.max_depth_scale
        or system.gray.rms > config.max_gray_rms
        or gain >= config.max_gain
        # noise of the reference, or a lamp on the camera, makes it too small, but never too large
        or not (
            gain > 1 / config.max_gain or same_under_other_light(*views, T, min_samples=config.min_samples)
        )
    ):
        outcome = Outcome.RESIDUAL
    elif weakest * _max_sigma_m(system, config) ** 2 < 1 - 1e-9:
        outcome = Outcome.ILL_CONDITIONED
    elif (
        moved_m > config.max_translation_m * reach_factor(system.seen.median_depth_m)
        or turned_rad > config.max_rotation_rad
    ):
        outcome = Outcome.JUMP
    else:
        outcome = Outcome.OK
    return Registration(
        T,
        found.information if system.seen.agreeing >= config.min_samples else np.zeros((6, 6)),
        outcome,
        overlap=system.seen.overlap,
        view=system.seen.view,
        conflict=system.seen.conflict,
        rms_depth_m=system.depth.rms * system.seen.sigma_mean_m,
        rms_gray=system.gray.rms,
        exposure=(float(exposure[0]), float(exposure[1])),
        samples=system.seen.agreeing,
        overconfidence=found.overconfidence,
        condition=found.condition,
        weak=found.weak,
    )


def _overconfidence(system: System, H: Array) -> float:
    """The factor by which the normal matrix exceeds the information, at least 1: the larger of two estimates.

    Correlation. Neighboring residuals share noise, calibration and model errors. If they did not, the outer
    products of the gradients summed over image tiles would have the expectation H; their ratio to H, averaged over
    the eight directions, is the factor (cluster-robust covariance, reduced to one number so that weak directions
    stay weak).

    Depth-color chi-squared. Depth and gray values, each alone, would put the target elsewhere; at the joint minimum
    their gradients g cancel, and chi^2 = g^T (H_depth^-1 + H_gray^-1) g, the squared distance between the two
    solutions in units of their covariance, should be 6. What exceeds it is calibration error that no image noise
    explains (Birge ratio).
    """
    parts = [part for part in (system.depth, system.gray) if part.count]
    if not parts:
        return 1.0
    outer, depth_color_chi2 = np.zeros((8, 8)), 0.0
    for part in parts:
        outer = outer + part.tile_gradients @ part.tile_gradients.T
    for part in parts if len(parts) == 2 else []:
        gradient = part.gradient[:6]
        answer = np.linalg.solve(regular(part.H[:6, :6] + 1e-3 * H[:6, :6]), gradient)
        depth_color_chi2 += float(gradient @ answer)
    return max(1.0, excess(H, outer), depth_color_chi2 / 6)
