"""The steps of `splat.optimizer.Adam`, compiled."""

from __future__ import annotations

import operator
from typing import SupportsIndex

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.training import LearningRates
from duagc.pipeline.kernels import _raster
from duagc.pipeline.kernels.outputs import empty
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.optimizer import BETA_1, BETA_2, EPSILON, Adam, GaussianGradients

_CONSTANTS = np.array([BETA_1, 1 - BETA_1, BETA_2, 1 - BETA_2, EPSILON], np.float32)


class CompiledAdam(Adam):
    """`splat.optimizer.Adam` on all cores asked for; the same bits as that, for any number of threads."""

    def __init__(self, n: int = 0, isa: str = "auto", threads: SupportsIndex = 1) -> None:
        super().__init__(n)
        self.isa, self.threads = isa, threads

    def step(self, gaussians: Gaussians, gradients: GaussianGradients, rates: LearningRates) -> Gaussians:
        """The Gaussians after one step; those without any gradient of color or opacity are untouched."""
        if len(gaussians) != len(self):
            raise ValueError(f"gaussians are {len(gaussians)}, expected {len(self)}, as many as have a state")
        names = list(self._first)
        values = [getattr(gaussians, name) for name in names]
        for name, value in zip(names, values, strict=True):
            _check_gradient(name, getattr(gradients, name), value.shape)
            for moments in (self._first[name], self._second[name]):
                _check_state(moments, np.float32)
        _check_state(self._steps, np.int32)
        out = [empty(*value.shape) for value in values]
        arrays = (
            values,
            [getattr(gradients, name) for name in names],
            [self._first[name] for name in names],
            [self._second[name] for name in names],
            out,
        )
        step_lengths = np.array([getattr(rates, name) for name in names], np.float32)
        touched_by = (gradients.colors, gradients.opacity_logits)
        state = (self._steps, self._corrections)
        arguments = (*arrays, step_lengths, _CONSTANTS, *touched_by, *state, operator.index(self.threads))
        _raster.adam(self.isa, *arguments)
        return gaussians.replace(**dict(zip(names, out, strict=True)))

    def step_rows(
        self,
        gaussians: Gaussians,
        rows: NDArray[np.int64],
        gradients: GaussianGradients,
        rates: LearningRates,
        *,
        least: NDArray[np.float32],
        limits: tuple[float, float],
    ) -> None:
        """A step of some Gaussians in place, and what is beyond the limits is put there.

        Args:
            gaussians: all of them; those of the rows are changed.
            rows: [m], each once.
            gradients: [m] by these.
            rates: step lengths.
            least: of the log-scales, [n, 3] or [1].
            limits: the greatest log-scale, and the largest opacity logit of either sign.
        """
        if len(gaussians) != len(self):
            raise ValueError(f"gaussians are {len(gaussians)}, expected {len(self)}, as many as have a state")
        if len(rows) and (rows.min() < 0 or rows.max() >= len(self)):
            raise ValueError(f"rows are {rows.min()} to {rows.max()}, expected 0 to {len(self) - 1}")
        if least.shape not in ((1,), gaussians.log_scales.shape):
            raise ValueError(
                f"least has shape {least.shape}, expected (1,) or {gaussians.log_scales.shape}, that of the log-scales"
            )
        names = list(self._first)
        values = [getattr(gaussians, name) for name in names]
        for name, value in zip(names, values, strict=True):
            _check_gradient(name, getattr(gradients, name), (len(rows), *value.shape[1:]))
            for array in (value, self._first[name], self._second[name]):
                _check_state(array, np.float32)
        _check_state(self._steps, np.int32)
        arrays = (
            values,
            [getattr(gradients, name) for name in names],
            [self._first[name] for name in names],
            [self._second[name] for name in names],
        )
        step_lengths = np.array([getattr(rates, name) for name in names], np.float32)
        touched_by = (gradients.colors, gradients.opacity_logits)
        clipped = (gaussians.log_scales, gaussians.opacity_logits, least, np.array(limits, np.float32))
        arguments = (*arrays, step_lengths, _CONSTANTS, *touched_by, self._steps, self._corrections, *clipped)
        _raster.adam_rows(self.isa, rows, *arguments, operator.index(self.threads))


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
