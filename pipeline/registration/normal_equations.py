"""What a registration needs of its residuals at one pose: normal equations, and how the samples were seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from duagc.pipeline.base.arrays import Array

POSE_PARAMETERS = 6  # of eight, the others are gain and offset


@dataclass(frozen=True)
class NormalEquations:
    """The residuals of one kind, summed.

    Attributes:
        H: [8, 8], by (translation, rotation, gain, offset).
        gradient: [8].
        scale: robust standard deviation of the residuals.
        count: of the residuals.
        rms: root of the weighted mean square of the residuals, Huber's weight only, in units of the noise given.
        tile_gradients: [8, t], parts of the gradient, by tiles of the image.
    """

    H: Array
    gradient: Array
    scale: float
    count: int
    rms: float
    tile_gradients: Array

    def correlation(self) -> float:
        """The factor, at least 1, by which H exceeds the information because neighboring residuals share errors.

        If they did not, the outer products of the gradients summed over tiles would have the expectation H; their
        ratio to H is averaged over the directions that the residuals know of (cluster-robust covariance).
        """
        known = len(self.H) if self.H[-1, -1] > 0 else POSE_PARAMETERS
        H, gradients = self.H[:known, :known], self.tile_gradients[:known]
        return max(1.0, excess(H, gradients @ gradients.T))

    def moved(self, by: Array) -> NormalEquations:
        """The same with the gradient at another pose, as the quadratic has it.

        Args:
            by: [8], from this one.
        """
        return replace(self, gradient=self.gradient + self.H @ by)

    def divided(self, factor: float) -> NormalEquations:
        """The same with all weights divided by a factor.

        Args:
            factor: positive.
        """
        return replace(
            self,
            H=self.H / factor,
            gradient=self.gradient / factor,
            tile_gradients=self.tile_gradients / factor,
        )


@dataclass(frozen=True, kw_only=True)
class SamplesSeen:
    """How the samples of a reference are seen from one pose.

    Attributes:
        overlap: as in `Registration`.
        view: as in `Registration`.
        conflict: as in `Registration`.
        agreeing: number of samples on the same surface.
        median_depth_m: of these.
        sigma_mean_m: mean noise of their depth.
    """

    overlap: float
    view: float
    conflict: float
    agreeing: int
    median_depth_m: float
    sigma_mean_m: float


@dataclass(frozen=True, kw_only=True)
class System:
    """The normal equations at one pose and level, and how the samples were seen.

    Attributes:
        depth: of point-to-plane distances.
        gray: of gray differences.
        seen: how the samples were seen.
    """

    depth: NormalEquations
    gray: NormalEquations
    seen: SamplesSeen

    def normal_equations(self) -> tuple[Array, Array]:
        """H [8, 8] and gradient [8] of both kinds together."""
        return self.depth.H + self.gray.H, self.depth.gradient + self.gray.gradient

    def moved(self, by: Array) -> System:
        """The same with gradients at another pose, as the quadratic has it.

        Args:
            by: [8], from this one.
        """
        return replace(self, depth=self.depth.moved(by), gray=self.gray.moved(by))

    def by_correlation(self) -> System:
        """The same with the weights of either kind divided by its correlation."""
        depth, gray = (part.divided(part.correlation()) for part in (self.depth, self.gray))
        return replace(self, depth=depth, gray=gray)


def excess(H: Array, outer: Array) -> float:
    """How far gradients of tiles spread beyond what independent residuals would, averaged over the directions.

    Args:
        H: [n, n], normal matrix.
        outer: [n, n], sum of the outer products of the gradients of the tiles.
    """
    return float(np.trace(np.linalg.solve(regular(H), outer))) / len(H)


def regular(H: Array) -> Array:
    """A normal matrix that can be solved even where nothing was seen: then the answer stays near zero.

    Args:
        H: [n, n].
    """
    return np.asarray(H + (1e-10 * np.trace(H) / len(H) + 1e-300) * np.eye(len(H)))
