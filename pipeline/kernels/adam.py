"""The steps of `splat.optimizer.Adam`, compiled."""

from __future__ import annotations

import operator
from typing import SupportsIndex

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.training import LearningRates
from duagc.pipeline.kernels import _raster
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.optimizer import BETA_1, BETA_2, EPSILON, Adam, GaussianGradients

_CONSTANTS = np.array([BETA_1, 1 - BETA_1, BETA_2, 1 - BETA_2, EPSILON], np.float32)
_ALL_ROWS, _ALL = np.zeros(0, np.int64), np.zeros(0, np.uint8)


class CompiledAdam(Adam):
    """`splat.optimizer.Adam` on all cores asked for; the same bits as that, for any number of threads."""

    def __init__(self, n: int = 0, isa: str = "auto", threads: SupportsIndex = 1) -> None:
        """Begin with Gaussians that were never optimized.

        Args:
            n: number of Gaussians.
            isa: instruction set, one of `available_isas()`; "auto" takes the fastest of this machine.
            threads: of every step, 1 or more; changes no bit of any result.
        """
        super().__init__(n)
        self.isa, self.threads = isa, threads

    def step(self, gaussians: Gaussians, gradients: GaussianGradients, rates: LearningRates) -> Gaussians:
        """The Gaussians after one step; those without any gradient of color or opacity are untouched.

        Args:
            gaussians: n, as many as the optimizer has; left as they are.
            gradients: derivatives of the loss by their parameters, float32.
            rates: step lengths.

        Raises:
            ValueError: an array of a wrong type or shape; the message names it.
        """
        out = gaussians.copy()
        nowhere = np.array([-np.inf], np.float32)
        self.step_in_place(out, gradients, rates, least=nowhere, limits=(np.inf, np.inf))
        return out

    def step_in_place(
        self,
        gaussians: Gaussians,
        gradients: GaussianGradients,
        rates: LearningRates,
        *,
        least: NDArray[np.float32],
        limits: tuple[float, float],
        rows: NDArray[np.int64] | None = None,
        chosen: NDArray[np.bool_] | None = None,
    ) -> None:
        """A step of some Gaussians in place, and what of them is beyond the limits is put there.

        Args:
            gaussians: all of them.
            gradients: by those of the rows, in their order.
            rates: step lengths.
            least: of the log-scales, [n, 3] or [1].
            limits: the greatest log-scale, and the largest opacity logit of either sign.
            rows: [m], each once; None: all.
            chosen: [n], which may change; None: all.
        """
        n = len(gaussians)
        if n != len(self):
            raise ValueError(f"gaussians are {n}, expected {len(self)}, as many as have a state")
        if rows is not None and len(rows) and (rows.min() < 0 or rows.max() >= n):
            raise ValueError(f"rows are {rows.min()} to {rows.max()}, expected 0 to {n - 1}")
        if least.shape not in ((1,), gaussians.log_scales.shape):
            raise ValueError(
                f"least has shape {least.shape}, expected (1,) or {gaussians.log_scales.shape}, that of the log-scales"
            )
        if chosen is not None and (chosen.dtype != np.bool_ or chosen.shape != (n,)):
            raise ValueError(f"chosen is {chosen.dtype} {chosen.shape}, expected bool ({n},)")
        names = list(self._first)
        values = [getattr(gaussians, name) for name in names]
        count = n if rows is None else len(rows)
        for name, value in zip(names, values, strict=True):
            _check_gradient(name, getattr(gradients, name), (count, *value.shape[1:]))
            for array in (value, self._first[name], self._second[name]):
                _check_state(array, np.float32)
        _check_state(self._steps, np.int32)
        if not count:
            return
        arrays = (
            values,
            [getattr(gradients, name) for name in names],
            [self._first[name] for name in names],
            [self._second[name] for name in names],
        )
        step_lengths = np.array([getattr(rates, name) for name in names], np.float32)
        touched_by = (gradients.colors, gradients.opacity_logits)
        within = (gaussians.log_scales, gaussians.opacity_logits, least, np.array(limits, np.float32))
        arguments = (*arrays, step_lengths, _CONSTANTS, *touched_by, self._steps, self._corrections, *within)
        some = _ALL_ROWS if rows is None else rows, _ALL if chosen is None else chosen.view(np.uint8)
        _raster.adam(self.isa, *some, *arguments, operator.index(self.threads))


def _check_state(array: NDArray[np.generic], dtype: type[np.generic]) -> None:
    """Refuse a state that the kernel would change in a copy."""
    if array.dtype != dtype or not array.flags.c_contiguous:
        raise ValueError(
            f"the state of the optimizer is {array.dtype} with strides {array.strides}, "
            f"expected contiguous {np.dtype(dtype)}"
        )


def _check_gradient(name: str, gradient: object, shape: tuple[int, ...]) -> None:
    if not isinstance(gradient, np.ndarray) or gradient.dtype != np.float32:
        found = gradient.dtype if isinstance(gradient, np.ndarray) else type(gradient).__name__
        raise ValueError(f"gradients.{name} is {found}, expected an array of float32")
    if gradient.shape != shape:
        raise ValueError(
            f"gradients.{name} has shape {gradient.shape}, expected {shape}, that of gaussians.{name}"
        )
