"""Adam on a structure of arrays: elementwise, per Gaussian, so its result depends on no thread and no order."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.config import Config
from pipeline.splat.gaussians import Gaussians

Array = NDArray[np.float32]
_PARAMETERS = {"means": (3,), "quats_wxyz": (4,), "log_scales": (3,), "colors": (3,), "opacity_logits": ()}
BETA_1, BETA_2, EPSILON = 0.9, 0.99, 1e-12
_LONGEST = 1024  # steps after which both bias corrections are 1 within float32


class GaussianGradients(Protocol):
    """Derivatives of a loss by every parameter of n Gaussians, shapes as in `Gaussians`."""

    @property
    def means(self) -> Array: ...
    @property
    def quats_wxyz(self) -> Array: ...
    @property
    def log_scales(self) -> Array: ...
    @property
    def colors(self) -> Array: ...
    @property
    def opacity_logits(self) -> Array: ...


class LearningRates(Config):
    """Step lengths of Adam: about the change of a parameter per step while its gradient keeps its sign."""

    means: float = 3e-3
    """Metres."""
    quats_wxyz: float = 2e-2
    """Of a unit quaternion."""
    log_scales: float = 6e-2
    colors: float = 2e-2
    """RGB in 0..1."""
    opacity_logits: float = 3e-2

    def times(self, factor: float) -> LearningRates:
        """All rates scaled."""
        return LearningRates(**{name: rate * factor for name, rate in self.model_dump().items()})


class Adam:
    """Adam whose moments and step counts belong to single Gaussians.

    A Gaussian that a view does not touch keeps its parameters, moments and step count: a new one starts with its
    own bias correction, and one outside the view does not drift on old momentum.
    """

    def __init__(self, n: int = 0) -> None:
        self.first = {name: np.zeros((n, *tail), np.float32) for name, tail in _PARAMETERS.items()}
        self.second = {name: np.zeros((n, *tail), np.float32) for name, tail in _PARAMETERS.items()}
        self.steps = np.zeros(n, np.int64)
        # running products, not powers: the same on every machine
        self._unbias_1 = 1.0 / (1.0 - np.cumprod(np.full(_LONGEST, BETA_1)))
        self._unbias_2 = 1.0 / (1.0 - np.cumprod(np.full(_LONGEST, BETA_2)))

    def __len__(self) -> int:
        return len(self.steps)

    def select(self, index: NDArray) -> None:
        """Keep the state of the Gaussians of a mask or an index array, in that order."""
        for state in (self.first, self.second):
            for name in state:
                state[name] = state[name][index]
        self.steps = self.steps[index]

    def extend(self, n: int) -> None:
        """Add n Gaussians at the end that were never optimised."""
        for state in (self.first, self.second):
            for name, tail in _PARAMETERS.items():
                state[name] = np.concatenate([state[name], np.zeros((n, *tail), np.float32)])
        self.steps = np.concatenate([self.steps, np.zeros(n, np.int64)])

    def step(self, gaussians: Gaussians, gradients: GaussianGradients, rates: LearningRates) -> Gaussians:
        """The Gaussians after one step; those with no gradient at all are untouched.

        Source: Kingma and Ba, ICLR 2015, algorithm 1, with beta_2 = 0.99 (few steps per Gaussian).
        """
        touched = (gradients.opacity_logits != 0) | (gradients.colors != 0).any(axis=1)
        rows = np.flatnonzero(touched)
        if len(rows) == 0:
            return gaussians
        self.steps[rows] += 1
        age = np.minimum(self.steps[rows], _LONGEST) - 1
        unbias_1 = self._unbias_1[age].astype(np.float32)
        unbias_2 = self._unbias_2[age].astype(np.float32)
        updated: dict[str, Array] = {}
        for name, tail in _PARAMETERS.items():
            g = getattr(gradients, name)[rows]
            first = np.float32(BETA_1) * self.first[name][rows] + np.float32(1 - BETA_1) * g
            second = np.float32(BETA_2) * self.second[name][rows] + np.float32(1 - BETA_2) * (g * g)
            self.first[name][rows], self.second[name][rows] = first, second
            c1, c2 = (unbias_1[:, None], unbias_2[:, None]) if tail else (unbias_1, unbias_2)
            values = getattr(gaussians, name).copy()
            values[rows] -= (np.float32(getattr(rates, name)) * c1) * first / (np.sqrt(c2 * second) + EPSILON)
            updated[name] = values
        return gaussians.replace(**updated)
