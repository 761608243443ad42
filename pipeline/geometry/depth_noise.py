"""The noise of a depth camera as a function of distance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

NEAREST_M = 0.4
"""Depth at which the noise is least, meters."""


class SensorSettings(Protocol):
    """Settings that state the noise of a depth sensor."""

    @property
    def depth_sigma_base_m(self) -> float:
        """Standard deviation at 0.4 m."""

    @property
    def depth_sigma_quadratic_per_m(self) -> float:
        """Growth with the squared distance from there."""


@dataclass(frozen=True)
class DepthNoise:
    """sigma(z) = factor (base + quadratic (z - 0.4 m)^2), the model of structured-light cameras.

    Attributes:
        base_m: standard deviation at 0.4 m, meters.
        quadratic_per_m: growth with the squared distance from there, 1/m.
        factor: on both.
    Source: Nguyen, Izadi, Lovell, 3DIMPVT 2012, axial noise.
    """

    base_m: float
    quadratic_per_m: float
    factor: float = 1.0

    @staticmethod
    def stated(settings: SensorSettings) -> DepthNoise:
        """The noise by the settings alone: no residual is in it.

        Args:
            settings: of a registration, or of the information.
        """
        return DepthNoise(settings.depth_sigma_base_m, settings.depth_sigma_quadratic_per_m)

    def sigma_m(self, depth_m: NDArray[np.floating]) -> NDArray[Any]:
        """Standard deviation of depths [...], meters, computed in their precision.

        Args:
            depth_m: [...], meters along z.
        """
        number = depth_m.dtype.type
        sigma = number(self.base_m) + number(self.quadratic_per_m) * (depth_m - number(NEAREST_M)) ** 2
        return sigma if self.factor == 1.0 else number(self.factor) * sigma
