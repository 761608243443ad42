"""Graduated non-convexity with truncated least squares: robust weights that need no message of their own.

The robot that holds a loop closure weighs it from its own estimate. The control parameter mu grows with what arrives,
not with time, so that loss slows the schedule and does not starve it. Source: Yang, Antonante, Tzoumas, Carlone 2020.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import PoseConsensusConfig

INLIER_WEIGHT = 0.5
"""Robust weight from which a relative pose counts as an inlier."""
_LEAST_PACKETS = 2  # per step: the other end has answered to the last weights


def graduated_weights(squared: Array, c2: float, mu: float) -> Array:
    """Weights of truncated least squares at control parameter mu: mu -> infinity truncates at c2.

    Args:
        squared: [m], squared whitened residuals.
        c2: square of the truncation.
        mu: above zero.

    Returns:
        [m], 0 to 1.
    """
    low, high = mu / (mu + 1) * c2, (mu + 1) / mu * c2
    between = np.sqrt(c2 * mu * (mu + 1) / np.maximum(squared, low)) - mu
    return np.where(squared <= low, 1.0, np.where(squared >= high, 0.0, between))


def first_control(squared: Array, config: PoseConsensusConfig, first_mu: float = 0.0) -> float:
    """Where the schedule begins: a share of the control parameter at which the worst factor is just convex.

    Args:
        squared: [m], squared residuals.
        config: the least and the greatest control parameter, and the share.
        first_mu: at least this.
    """
    least, last = config.robust_mu
    least = max(least, first_mu)
    return min(max(least, config.robust_convexity * convex_control(squared, config)), last)


def convex_control(squared: Array, config: PoseConsensusConfig) -> float:
    """The control parameter at which the worst factor is just convex; the greatest if it always is.

    Args:
        squared: [m], squared residuals.
        config: threshold and the greatest control parameter.
    """
    c2 = config.truncation**2
    beyond = 2 * float(squared.max()) - c2
    return c2 / beyond if beyond > 0 else config.robust_mu[1]


def controls(config: PoseConsensusConfig) -> list[float]:
    """The whole schedule of the control parameter.

    Args:
        config: the least and the greatest control parameter, and the factor of a step.

    Returns:
        Ascending.
    """
    first, last = config.robust_mu
    steps = 1 + math.floor(math.log(last / first) / math.log(config.robust_growth))
    return [first * config.robust_growth**k for k in range(steps)]


class RobustWeights:
    """The weights of one group of relative poses and how far their schedule is.

    Attributes:
        weights: [m], the start until the warm-up is over.
        scheduled: the schedule is over; the weights are zero or one, and change only if residuals say so.
        done: they are final.
    """

    def __init__(self, start: Array, config: PoseConsensusConfig, *, first_mu: float = 0.0) -> None:
        """Before the schedule.

        Args:
            start: [m], the weights until the warm-up is over.
            config: threshold and schedule.
            first_mu: the schedule begins here at the least.
        """
        self.first_mu = first_mu
        self.weights, self.config = start, config
        self.scheduled = self.done = not (config.robust and len(start))
        self._mu: float | None = None  # None while warming up
        self._checks = 0
        self._changed_at = 0.0  # packets received when the weights last changed

    def advance(self, received: float, steady: bool, squared_residuals: Callable[[], Array]) -> bool:
        """Take the next step if it is due; True if the weights changed.

        Args:
            received: packets so far, parts counted by their share.
            steady: what the factors join moves little any more; a step need not wait for its full number of
                packets.
            squared_residuals: [m], computed only when needed.
        """
        c, c2 = self.config, self.config.truncation**2
        if self.scheduled and not self.done:
            return self._check(received, steady, squared_residuals)
        wait = c.robust_warm_up if self._mu is None else c.robust_packets
        least = 0.0 if self._mu is None else _LEAST_PACKETS
        waited = received - self._changed_at
        if self.done or waited < (least if steady else wait):
            return False
        squared = squared_residuals()
        if self._mu is None:
            if c.robust_skip and np.all(squared <= c2):  # no outlier: every truncated weight is one
                return self._finish(np.ones(len(squared)))
            self._mu = first_control(squared, c, self.first_mu)
        else:
            self._mu *= c.robust_growth
        self._changed_at = received
        if self._mu > c.robust_mu[1]:
            return self._finish((squared <= c2).astype(np.float64))
        weights = graduated_weights(squared, c2, self._mu)
        if np.all((weights == 0.0) | (weights == 1.0)):  # no later step would change them by itself
            return self._finish(weights)
        self.weights = weights
        return True

    @property
    def graduated(self) -> bool:
        """Whether the schedule ran, and was not skipped because there were no outliers."""
        return self._mu is not None

    def _finish(self, weights: Array) -> bool:
        self.weights, self.scheduled, self.done = weights, True, not self.config.team_schedule().checks
        return True

    def _check(self, received: float, steady: bool, squared_residuals: Callable[[], Array]) -> bool:
        """Truncate anew: what was far off when the schedule ended may fit since others' weights have changed."""
        schedule = self.config.team_schedule()
        if received - self._changed_at < schedule.check_packets:
            return False
        weights = (squared_residuals() <= self.config.truncation**2).astype(np.float64)
        changed = not np.array_equal(weights, self.weights)
        self._changed_at = received
        self._checks += 1
        self.done = (steady and not changed) or self._checks >= schedule.checks
        self.weights = weights
        return changed
