"""A time by which two motions of a camera differ, found from pairs of frames among which its velocity changes.

Both frames of a pair are registered to each other twice, by parts that were taken at different times: by color and by
depth, or by the upper and the lower half of the images. The two motions differ by

    log(T_first^-1 T_second) = time * rate + (1 - Ad) c,    Ad = adjoint of T_second_first,

where `rate` is known from the velocities, and c is the pose of one camera, or half, in the other, the same in all
pairs: cameras that are turned against each other, or a wrong lens, are no time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.motion_times import MotionTimeConfig
from duagc.pipeline.config.registration import RegistrationConfig
from duagc.pipeline.geometry.statistics import CHI2_6_MEDIAN
from duagc.pipeline.registration import Outcome

LEVELS = 4  # of pyramids; the finest is left out
STRIDES = (4, 2, 1)
MEASURED = (Outcome.OK, Outcome.ILL_CONDITIONED)  # directions that are not determined have no information
BY_COLOR = RegistrationConfig(residuals="gray")
BY_DEPTH = RegistrationConfig(residuals="depth")
FIRST_SIGMA_S = 1.0  # of a time of which nothing is known
ROUNDS = 20  # of reweighting
PARTS = 5  # of the log, each of which is left out once
CHANCE_SIGMAS = 2.0  # up to which a time may be chance


@dataclass(frozen=True)
class FoundTime:
    """A time by which motions differ.

    Attributes:
        time_s: the time.
        sigma_s: standard deviation: by what is left, or by how much it depends on parts of the log, if that is more.
    """

    time_s: float
    sigma_s: float

    @property
    def may_be_chance(self) -> bool:
        """Whether nothing at all may be there."""
        return abs(self.time_s) <= CHANCE_SIGMAS * self.sigma_s

    def is_certain(self, config: MotionTimeConfig) -> bool:
        """Whether it is well known, no chance, and long enough to matter.

        Args:
            config: of the estimate.
        """
        is_known = self.sigma_s <= config.most_sigma_s
        return is_known and abs(self.time_s) >= max(config.least_s, config.sigmas * self.sigma_s)


@dataclass(frozen=True)
class MotionDifference:
    """What two motions of a pair of frames differ by.

    Attributes:
        off: [6], right tangent of the second frame, less what the stamps say.
        by_time: [6], its derivative by the time that is sought, 1/s.
        by_cameras: [6, 6], its derivative by the pose of one camera in the other.
        information: [6, 6] of `off`.
    """

    off: Array
    by_time: Array
    by_cameras: Array
    information: Array


def joint_information(first: Array, second: Array) -> Array:
    """Information [6, 6] of the difference of two motions, by that of each.

    Args:
        first: [6, 6].
        second: [6, 6].
    """
    both = np.linalg.pinv(first + second, rcond=1e-9, hermitian=True)
    information = first @ both @ second
    return np.asarray(0.5 * (information + information.T))


def estimated_time(found: Sequence[MotionDifference], config: MotionTimeConfig) -> FoundTime | None:
    """The time that differences tell; None if they are too few.

    Args:
        found: in order of time.
        config: of the estimate.
    """
    if len(found) < config.min_pairs:
        return None
    time_s, sigma_s = _solve(found, config)
    ends = [len(found) * k // PARTS for k in range(PARTS + 1)]
    without = [_solve([*found[:a], *found[b:]], config)[0] for a, b in pairwise(ends)]
    jackknife_s = float(np.sqrt((PARTS - 1) * np.var(without)))
    return FoundTime(time_s, max(sigma_s, jackknife_s))


def _solve(found: Sequence[MotionDifference], config: MotionTimeConfig) -> tuple[float, float]:
    """The time and its standard deviation by what is left, seconds; differences far off count little (Cauchy)."""
    prior = np.diag([FIRST_SIGMA_S**-2, *[config.cameras_m**-2] * 3, *[config.cameras_rad**-2] * 3])
    J = np.array([np.concatenate([d.by_time[:, None], d.by_cameras], axis=1) for d in found])
    off, W = np.array([d.off for d in found]), np.array([d.information for d in found])
    H, x = prior, np.zeros(7)
    for _ in range(ROUNDS):
        left = off - J @ x
        chi2 = np.einsum("ki,kij,kj->k", left, W, left)
        scale = max(float(np.median(chi2)) / CHI2_6_MEDIAN, 1e-9)
        weighted = np.swapaxes(J, 1, 2) @ W / (scale + chi2 / 6)[:, None, None]
        H = (weighted @ J).sum(axis=0) + prior
        x = np.linalg.solve(H, (weighted @ off[..., None]).sum(axis=0)[:, 0])
    return float(x[0]), float(np.sqrt(np.linalg.inv(H)[0, 0]))
