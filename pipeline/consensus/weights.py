"""Information of matched Gaussians as blocks: the weights of values of theta."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.splat.information import COLOR, LOG_COVARIANCE, MEAN, OPACITY

Index = NDArray[np.int64]


@dataclass(frozen=True)
class Weights:
    """Information of n values of theta.

    Attributes:
        position: [n, 3, 3], 1/m^2.
        shape: [n, 6, 6], over vec log Sigma.
        color: [n, 3], the diagonal.
        opacity: [n].
    """

    position: Array
    shape: Array
    color: Array
    opacity: Array

    @staticmethod
    def of(evidence: Evidence) -> Weights:
        """Weights of evidence in the common frame.

        Args:
            evidence: on n Gaussians.
        """
        return Weights(
            evidence.position_information(),
            evidence.shape_information(),
            evidence.color_information(),
            evidence.opacity_information(),
        )

    @staticmethod
    def of_diagonal(diagonal: Array) -> Weights:
        """Weights per coordinate [n, 13].

        Args:
            diagonal: [n, 13], information laid out as theta.
        """
        return Weights(
            diagonal[:, MEAN, None] * np.eye(3),
            diagonal[:, LOG_COVARIANCE, None] * np.eye(6),
            diagonal[:, COLOR].copy(),
            diagonal[:, OPACITY].copy(),
        )

    def diagonal(self) -> Array:
        """[n, 13]."""
        position, shape = (np.diagonal(m, axis1=-2, axis2=-1) for m in (self.position, self.shape))
        return np.concatenate([position, shape, self.color, self.opacity[:, None]], axis=1)

    def take(self, rows: Index) -> Weights:
        """Those of some rows.

        Args:
            rows: int64 [k].
        """
        return Weights(self.position[rows], self.shape[rows], self.color[rows], self.opacity[rows])

    def plus(self, diagonal: Array) -> Weights:
        """With more information per coordinate [n, 13].

        Args:
            diagonal: [n, 13], information laid out as theta.
        """
        more = Weights.of_diagonal(diagonal)
        return Weights(
            self.position + more.position,
            self.shape + more.shape,
            self.color + more.color,
            self.opacity + more.opacity,
        )

    def times(self, values: Array) -> Array:
        """W x [n, 13] of values [n, 13].

        Args:
            values: [n, 13], laid out as theta.
        """
        return np.concatenate(
            [
                (self.position @ values[:, MEAN, None])[..., 0],
                (self.shape @ values[:, LOG_COVARIANCE, None])[..., 0],
                self.color * values[:, COLOR],
                (self.opacity * values[:, OPACITY])[:, None],
            ],
            axis=1,
        )

    def inverse(self) -> Weights:
        """W^+, zero in directions without information."""
        return Weights(
            _pseudo_inverse(self.position),
            _pseudo_inverse(self.shape),
            *(np.where(w > 0, 1 / np.where(w > 0, w, 1.0), 0.0) for w in (self.color, self.opacity)),
        )


def _pseudo_inverse(matrices: Array) -> Array:
    values, vectors = np.linalg.eigh(matrices)
    known = values > 1e-12 * np.maximum(values[:, -1:], 1e-300)
    inverse = np.where(known, 1 / np.where(known, values, 1.0), 0.0)
    return np.asarray((vectors * inverse[:, None, :]) @ vectors.swapaxes(-1, -2))
