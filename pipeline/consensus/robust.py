"""Graduated non-convexity with truncated least squares: robust weights that need no message of their own.

Whoever holds a factor weighs it from its own estimate. The control parameter mu grows with what arrives, not with
time, so that loss slows the schedule and does not starve it. Source: Yang, Antonante, Tzoumas, Carlone 2020.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pipeline.consensus.config import PoseConsensusConfig

Array = NDArray[np.float64]
COUNTS = 0.5
"""Robust weight from which a closure counts as kept."""


def graduated_weights(squared: Array, c2: float, mu: float) -> Array:
    """Weights of truncated least squares at control parameter mu: mu -> infinity truncates at c2."""
    low, high = mu / (mu + 1) * c2, (mu + 1) / mu * c2
    between = np.sqrt(c2 * mu * (mu + 1) / np.maximum(squared, low)) - mu
    return np.where(squared <= low, 1.0, np.where(squared >= high, 0.0, between))


class RobustWeights:
    """The weights of one group of factors and how far their schedule is.

    weights: [m], the start until the warm-up is over. done: they are final.
    """

    def __init__(self, start: Array, config: PoseConsensusConfig) -> None:
        self.weights, self.config = start, config
        self.done = not (config.robust and len(start))
        self._step = -1  # -1 while warming up
        self._next = 0.0  # packets received at which the next step is due
        self._schedule = [mu * config.robust_growth**k for mu, n in config.robust_passes for k in range(n)]

    def advance(self, received: float, steady: bool, squared_residuals: Callable[[], Array]) -> bool:
        """Take the next step if it is due; True if the weights changed.

        Args:
            received: packets so far, parts counted by their share.
            steady: what the factors join has left its start behind; the warm-up may end early.
            squared_residuals: [m], computed only when needed.
        """
        c, c2 = self.config, self.config.truncation**2
        if self.done or (self._step < 0 and received < c.robust_warm_up and not steady):
            return False
        if self._step >= 0 and received < self._next:
            return False
        squared = squared_residuals()
        if self._step < 0:
            self._step = 0
            if c.robust_skip and np.all(squared <= c2):  # nothing is in doubt: every truncated weight is one
                return self._finish(np.ones(len(squared)))
        self._next = received + c.robust_packets
        if self._step == len(self._schedule):
            return self._finish((squared <= c2).astype(np.float64))
        self.weights = graduated_weights(squared, c2, self._schedule[self._step])
        self._step += 1
        return True

    @property
    def graduated(self) -> bool:
        """Whether the schedule ran, and was not skipped because nothing was in doubt."""
        return self._step > 0

    def _finish(self, weights: Array) -> bool:
        self.weights, self.done = weights, True
        return True
