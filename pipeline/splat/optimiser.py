"""Adam on a structure of arrays: elementwise, per Gaussian, so its result depends on no thread and no order."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.config import Config
from pipeline.splat.gaussians import Gaussians

Array = NDArray[np.float32]
_WIDTHS = {"means": 3, "quats_wxyz": 4, "log_scales": 3, "colors": 3, "opacity_logits": 1}
_COLUMNS = sum(_WIDTHS.values())
_BLOCK_ROWS = 4096
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
    log_scales: float = 0.12
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
        self._first = np.zeros((n, _COLUMNS), np.float32)
        self._second = np.zeros((n, _COLUMNS), np.float32)
        self._steps = np.zeros(n, np.int32)
        # running products, not powers: the same on every machine
        unbias_1 = 1.0 / (1.0 - np.cumprod(np.full(_LONGEST, BETA_1)))
        unbias_2 = 1.0 / (1.0 - np.cumprod(np.full(_LONGEST, BETA_2)))
        self._correction = (unbias_1 / np.sqrt(unbias_2)).astype(np.float32)

    def __len__(self) -> int:
        return len(self._steps)

    def select(self, index: NDArray) -> None:
        """Keep the state of the Gaussians of a mask or an index array, in that order."""
        self._first, self._second, self._steps = (
            state[index] for state in (self._first, self._second, self._steps)
        )

    def extend(self, n: int) -> None:
        """Add n Gaussians at the end that were never optimised."""
        new = Adam(n)
        self._first = np.concatenate([self._first, new._first])
        self._second = np.concatenate([self._second, new._second])
        self._steps = np.concatenate([self._steps, new._steps])

    def step(self, gaussians: Gaussians, gradients: GaussianGradients, rates: LearningRates) -> Gaussians:
        """The Gaussians after one step; those without any gradient of colour or opacity are untouched.

        Source: Kingma and Ba, ICLR 2015, algorithm 1, with beta_2 = 0.99 (few steps per Gaussian).
        """
        touched = gradients.opacity_logits != 0
        for channel in range(3):
            touched |= gradients.colors[:, channel] != 0
        rows = np.flatnonzero(touched)
        self._steps += touched
        np.minimum(self._steps, _LONGEST, out=self._steps)
        correction = self._correction[self._steps[rows] - 1]
        rate = np.concatenate([np.full(width, getattr(rates, name)) for name, width in _WIDTHS.items()])
        values = {name: getattr(gaussians, name).copy() for name in _WIDTHS}
        # blocks of rows that stay in the cache; every element goes its own way, so their size changes no bit
        for start in range(0, len(rows), _BLOCK_ROWS):
            block = rows[start : start + _BLOCK_ROWS]
            change = self._change(block, gradients)
            change *= rate.astype(np.float32)
            change *= correction[start : start + _BLOCK_ROWS, None]
            column = 0
            for name, width in _WIDTHS.items():
                value = values[name]
                part = change[:, column : column + width].reshape(len(block), *value.shape[1:])
                value[block] = np.take(value, block, axis=0) - part
                column += width
        return gaussians.replace(**values)

    def _change(self, block: NDArray, gradients: GaussianGradients) -> Array:
        """Update the moments of some rows and return first / sqrt(second) [rows, 14], not yet bias-corrected."""
        g = np.concatenate(
            [
                np.take(getattr(gradients, name), block, axis=0).reshape(-1, width)
                for name, width in _WIDTHS.items()
            ],
            axis=1,
        )
        first, second = np.take(self._first, block, axis=0), np.take(self._second, block, axis=0)
        first *= BETA_1
        first += (1 - BETA_1) * g
        g *= g
        second *= BETA_2
        second += (1 - BETA_2) * g
        self._first[block], self._second[block] = first, second
        np.sqrt(second, out=second)
        second += EPSILON
        first /= second
        return first
