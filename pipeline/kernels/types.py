"""What the rasterizers take and give; the same for the compiled one and for the float64 reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FISHER_DIAGONAL_COLUMNS = 14
GEOMETRY_COLUMNS = 45


@dataclass(frozen=True)
class Render:
    """One view. color: [H, W, 3], RGB; depth: [H, W], metres, blended sum of weight * z, not divided by alpha;
    alpha: [H, W], sum of the weights. float32 (float64 from the reference)."""

    color: NDArray[np.floating]
    depth: NDArray[np.floating]
    alpha: NDArray[np.floating]


@dataclass(frozen=True)
class Gradients:
    """Derivatives of a scalar by the Gaussians, shapes and types as in `Gaussians`; zero where nothing was drawn.

    pose: [6] float64, by the right tangent (translation m, rotation rad) of T_map_camera. fisher_diagonal: [n, 14],
    sum over pixels of the squared per-pixel derivative, order mean 3, quaternion 4, log-scale 3, colour 3, logit 1.
    """

    means: NDArray[np.floating]
    quats_wxyz: NDArray[np.floating]
    log_scales: NDArray[np.floating]
    colors: NDArray[np.floating]
    opacity_logits: NDArray[np.floating]
    pose: NDArray[np.float64] | None = None
    fisher_diagonal: NDArray[np.floating] | None = None


class FisherSums:
    """Information of n Gaussians, summed over the views added so far (method section 2, `gauss_newton`).

    geometry: float64 [n, 45], upper triangle, row by row, of the 9x9 information in (mean 3, vec log Sigma 6) in the
    frame of the Gaussians; 1/m^2 for the mean. color: float64 [n, 3]. opacity: float64 [n], of the logit.
    observations: uint32 [n], views in which a pixel of non-zero weight saw the Gaussian.
    """

    def __init__(self, n: int) -> None:
        self.geometry = np.zeros((n, GEOMETRY_COLUMNS))
        self.color = np.zeros((n, 3))
        self.opacity = np.zeros(n)
        self.observations = np.zeros(n, dtype=np.uint32)

    def __len__(self) -> int:
        return len(self.opacity)

    def geometry_matrices(self) -> NDArray[np.float64]:
        """The symmetric 9x9 matrices [n, 9, 9]."""
        rows, columns = np.triu_indices(9)
        full = np.zeros((len(self), 9, 9))
        full[:, rows, columns] = self.geometry
        full[:, columns, rows] = self.geometry
        return full
