"""The search for the minimum of a registration: Gauss-Newton from the coarsest pyramid level to the finest.

What `compiled.minimize` computes, to be read and to test against; a single step is used as it stands.
"""

from __future__ import annotations

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.registration import RegistrationConfig
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.registration.normal_equations import System, regular
from duagc.pipeline.registration.pyramid import RgbdPyramid
from duagc.pipeline.registration.reference import Reference
from duagc.pipeline.registration.residuals import linearize_at

STEP_TOLERANCE = (
    4e-6  # m, rad: steps shrink by a third or more each, so less than half of the last one is left
)
STEP_TOLERANCE_COARSE = 4e-5  # the next level begins with an error of its own size anyway
ALL_DIRECTIONS = np.eye(6)


def minimize(
    reference: Reference,
    pyramid: RgbdPyramid,
    guess: Array,
    config: RegistrationConfig,
    *,
    prior_information: Array | None,
    projection: Array,
) -> tuple[Array, Array, System]:
    """Pose, (gain, offset) and normal equations at the minimum.

    Args:
        reference: the samples.
        pyramid: the target view.
        guess: T_reference_target [4, 4], with an exact rotation.
        config: limits and noise.
        prior_information: [6, 6] in the right tangent of the guess; None: no prior.
        projection: [6, 6] P; the images count only along P x of a step x.
    """
    T, exposure = guess, np.array([1.0, 0.0])
    for index in reversed(range(levels_used(reference, pyramid, config))):
        for _ in range(config.iterations[index]):
            system = linearize_at(reference, pyramid, index, T, exposure=exposure, config=config).system()
            if system.seen.agreeing < config.min_samples:
                break
            if index == 0 and config.weights_by_correlation:
                system = system.by_correlation()
            change = step(system, T, guess, prior_information, projection=projection)
            T = orthonormal(T @ se3.exp(change[:6]))
            exposure = exposure + change[6:]
            if np.max(np.abs(change[:6])) < (STEP_TOLERANCE if index == 0 else STEP_TOLERANCE_COARSE):
                break
    system = linearize_at(reference, pyramid, 0, T, exposure=exposure, config=config).system()
    return T, exposure, system.by_correlation() if config.weights_by_correlation else system


def levels_used(reference: Reference, pyramid: RgbdPyramid, config: RegistrationConfig) -> int:
    """Number of levels that all three have.

    Args:
        reference: the samples.
        pyramid: the target view.
        config: numbers of steps.
    """
    return min(len(pyramid.levels), len(config.iterations), len(reference.levels))


def orthonormal(T: Array) -> Array:
    """The same motion with an exact rotation: predictions from predictions would double the rounding every time.

    Args:
        T: [4, 4].
    """
    return se3.from_rotation_translation(so3.project(T[:3, :3]), T[:3, 3])


def step(
    system: System, T: Array, guess: Array, prior_information: Array | None, *, projection: Array
) -> Array:
    """Gauss-Newton step [8], slightly damped, limited to 0.3 m and 0.3 rad.

    Args:
        system: normal equations at T.
        T: [4, 4].
        guess: [4, 4].
        prior_information: [6, 6] in the right tangent of the guess; None: no prior.
        projection: as in `minimize`.
    """
    H, gradient = system.normal_equations()
    if projection is not ALL_DIRECTIONS:
        P = np.eye(8)
        P[:6, :6] = projection
        H, gradient = P.T @ H @ P, P.T @ gradient
    if prior_information is not None:
        H[:6, :6] += prior_information
        gradient[:6] += prior_information @ se3.log(se3.inverse(guess) @ T)
    # brightness is not observable on an untextured view: a weak pull keeps the system regular
    H[6:, 6:] += np.eye(2)
    change = -np.linalg.solve(regular(H + 1e-6 * np.diag(np.diag(H))), gradient)
    if prior_information is None:
        change[:6] = projection @ change[:6]
    largest = np.max(np.abs(change[:6]))
    return np.asarray(change * min(1.0, 0.3 / largest) if largest > 0 else change)
