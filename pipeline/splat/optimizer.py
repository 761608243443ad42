"""Adam on a structure of arrays: elementwise, per Gaussian, so its result depends on no thread and no order."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import rows_of
from duagc.pipeline.config.training import LearningRates
from duagc.pipeline.splat.gaussians import Gaussians

Floats = NDArray[np.float32]
_SHAPES: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "quats_wxyz": (4,),
    "log_scales": (3,),
    "colors": (3,),
    "opacity_logits": (),
}
TRAINED = tuple(_SHAPES)
"""What is optimized of a Gaussian."""
BETA_1, BETA_2, EPSILON = 0.9, 0.99, 1e-12
_LONGEST = 1024  # steps after which the bias corrections stay, at 1 - 2e-5


class GaussianGradients(Protocol):
    """Derivatives of a loss by every parameter of n Gaussians, shapes as in `Gaussians`."""

    @property
    def means(self) -> Floats: ...
    @property
    def quats_wxyz(self) -> Floats: ...
    @property
    def log_scales(self) -> Floats: ...
    @property
    def colors(self) -> Floats: ...
    @property
    def opacity_logits(self) -> Floats: ...


def sizes(log_scales: Floats) -> Floats:
    """About the geometric mean [n] of the two larger standard deviations of Gaussians, meters.

    Up to 6 % more: between powers of two the exponential is a straight line, which is the same bits everywhere.

    Args:
        log_scales: [n, 3], logarithms of the scales in meters.
    """
    a, b, c = log_scales.T
    octaves = (np.maximum(a, b) + np.maximum(np.minimum(a, b), c)) * np.float32(0.5 / np.log(2.0))
    whole = np.clip(np.floor(octaves), -60, 60)
    return np.asarray(np.ldexp(1 + (octaves - whole), whole.astype(np.int32)), np.float32)


def smoothstep_decay(step: int, steps: int, last: float) -> float:
    """Share of the learning rates at a step: a smoothstep from 1 to `last`.

    Args:
        step: from 0.
        steps: in all.
        last: share at the last step.
    """
    done = step / max(steps - 1, 1)
    return last + (1.0 - last) * (1.0 - done * done * (3.0 - 2.0 * done))


class Adam:
    """Adam whose moments and step counts belong to single Gaussians.

    A Gaussian that a view does not touch keeps its parameters, moments and step count: a new one starts with its
    own bias correction, and one outside the view does not drift on old momentum. `kernels.CompiledAdam` takes the
    same steps, faster.
    """

    def __init__(self, n: int = 0) -> None:
        """Begin with Gaussians that were never optimized.

        Args:
            n: number of Gaussians.
        """
        self._first, self._second = _zeros(n), _zeros(n)
        self._steps = np.zeros(n, np.int32)
        # running products, not powers: the same on every machine
        unbias_1 = 1.0 / (1.0 - np.cumprod(np.full(_LONGEST, BETA_1)))
        unbias_2 = 1.0 / (1.0 - np.cumprod(np.full(_LONGEST, BETA_2)))
        self._unbiased = (unbias_1 / np.sqrt(unbias_2)).astype(np.float32)
        self._corrections = self._unbiased

    def __len__(self) -> int:
        return len(self._steps)

    def state(self) -> tuple[Any, ...]:
        """All that it knows of the Gaussians; `go_on` takes it."""
        return self._first, self._second, self._steps, self._corrections

    def go_on(self, state: tuple[Any, ...]) -> None:
        """Go on from where another one was.

        Args:
            state: of that one.
        """
        self._first, self._second, self._steps, self._corrections = state

    def freeze_after(self, steps: int | None) -> None:
        """From now on Gaussians freeze after so many steps, and their moments too.

        Their step lengths fall to a tenth over their first `steps` steps. Steps continue to be counted.

        Args:
            steps: of a Gaussian; None: Gaussians never freeze.
        """
        self._corrections = self._unbiased.copy()
        if steps is not None:
            decay = np.cumprod(np.full(_LONGEST, 0.1 ** (1.0 / steps)))
            self._corrections *= decay.astype(np.float32)
            self._corrections[steps:] = 0.0

    def select(self, index: NDArray) -> None:
        """Keep the state of the Gaussians of a mask or an index array, in that order.

        Args:
            index: bool mask [n], or indices [k].
        """
        rows = rows_of(index)
        self._first = {name: moments.take(rows, axis=0) for name, moments in self._first.items()}
        self._second = {name: moments.take(rows, axis=0) for name, moments in self._second.items()}
        self._steps = self._steps.take(rows)

    def extend(self, n: int) -> None:
        """Add n Gaussians at the end that were never optimized.

        Args:
            n: number of new Gaussians.
        """
        new = _zeros(n)
        self._first = {name: np.concatenate([moments, new[name]]) for name, moments in self._first.items()}
        self._second = {name: np.concatenate([moments, new[name]]) for name, moments in self._second.items()}
        self._steps = np.concatenate([self._steps, np.zeros(n, np.int32)])

    def append(self, other: Adam) -> None:
        """Add the Gaussians of another one at the end, with their state.

        Args:
            other: its state stays as it is.
        """
        first, second, steps, _ = other.state()
        self._first = {name: np.concatenate([moments, first[name]]) for name, moments in self._first.items()}
        self._second = {
            name: np.concatenate([moments, second[name]]) for name, moments in self._second.items()
        }
        self._steps = np.concatenate([self._steps, steps])

    def step(self, gaussians: Gaussians, gradients: GaussianGradients, rates: LearningRates) -> Gaussians:
        """The Gaussians after one step; those without any gradient of color or opacity are untouched.

        Centers move by shares of the Gaussians' sizes, so that a scene ten times as large is trained alike.

        Source: Kingma and Ba, ICLR 2015, algorithm 1, with beta_2 = 0.99 (few steps per Gaussian).

        Args:
            gaussians: n, as many as the optimizer has.
            gradients: derivatives of the loss by their parameters.
            rates: step lengths.
        """
        touched = (gradients.opacity_logits != 0) | (gradients.colors != 0).any(axis=1)
        rows = np.flatnonzero(touched)
        self._steps[rows] = np.minimum(self._steps[rows] + 1, _LONGEST)
        rows = rows[self._corrections[self._steps[rows] - 1] > 0]
        correction = self._corrections[self._steps[rows] - 1]
        of_size = correction * sizes(gaussians.log_scales[rows])
        values = {name: getattr(gaussians, name).copy() for name in _SHAPES}
        for name, value in values.items():
            g = getattr(gradients, name)[rows]
            first = BETA_1 * self._first[name][rows] + (1 - BETA_1) * g
            second = BETA_2 * self._second[name][rows] + (1 - BETA_2) * (g * g)
            self._first[name][rows], self._second[name][rows] = first, second
            change = first / (np.sqrt(second) + EPSILON) * np.float32(getattr(rates, name))
            factors = of_size if name == "means" else correction
            value[rows] -= change * factors.reshape(-1, *[1] * (g.ndim - 1))
        return gaussians.replace(**values)


def _zeros(n: int) -> dict[str, Floats]:
    return {name: np.zeros((n, *tail), np.float32) for name, tail in _SHAPES.items()}
