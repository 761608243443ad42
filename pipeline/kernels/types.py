"""What the rasterizers take and give; the same for the compiled one and for the float64 reference."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.splat.information import GEOMETRY_SIZE

FISHER_DIAGONAL_COLUMNS = 14
SMALLEST_HUBER = 1e-9  # its inverse, in float32, must leave room for residuals
LARGEST_LOSS_WEIGHT = 1e9

MaybeNone: TypeAlias = Any
"""Marks what is None on request only, so that callers that never request it need not check."""


@dataclass(frozen=True)
class Render:
    """One view as it is drawn; float32, float64 from the reference. All zero where a mask is False.

    Attributes:
        color: [H, W, 3], RGB.
        depth: [H, W], meters, the blended sum of weight * z, not divided by alpha.
        alpha: [H, W], sum of the weights.
    """

    color: NDArray[np.floating]
    depth: NDArray[np.floating]
    alpha: NDArray[np.floating]


@dataclass(frozen=True)
class Gradients:
    """Derivatives of a scalar by the Gaussians, shapes and types as in `Gaussians`; zero where nothing was drawn.

    The first five are None if only the pose was asked for (parameters=False).

    Attributes:
        means: [n, 3].
        quats_wxyz: [n, 4].
        log_scales: [n, 3].
        colors: [n, 3].
        opacity_logits: [n].
        pose: [6] float64, by the right tangent (translation m, rotation rad) of T_map_camera.
        fisher_diagonal: [n, 14], sum over pixels of the squared per-pixel derivative, order mean 3, quaternion 4,
            log-scale 3, color 3, logit 1.
    """

    means: NDArray[np.floating] | MaybeNone
    quats_wxyz: NDArray[np.floating] | MaybeNone
    log_scales: NDArray[np.floating] | MaybeNone
    colors: NDArray[np.floating] | MaybeNone
    opacity_logits: NDArray[np.floating] | MaybeNone
    pose: NDArray[np.float64] | None = None
    fisher_diagonal: NDArray[np.floating] | None = None

    def of_rows(self, rows: slice | NDArray[np.int64]) -> Gradients:
        """Derivatives by some of the Gaussians alone.

        Args:
            rows: of these.
        """
        return Gradients(
            self.means[rows],
            self.quats_wxyz[rows],
            self.log_scales[rows],
            self.colors[rows],
            self.opacity_logits[rows],
        )


class FisherSums:
    """Information of n Gaussians, summed over the views added so far (method section 2, `gauss_newton`).

    Attributes:
        geometry: float64 [n, 45] as in `splat.information`, in the frame of the Gaussians.
        color: float64 [n, 3].
        opacity: float64 [n], of the logit.
        observations: uint32 [n], views in which a pixel of non-zero precision saw the Gaussian.
        weight: float64 [n], sum of the blending weights over the pixels of non-zero precision.
        residual: float64 [n], sum over these pixels of weight times the residual image, in its unit: residual / weight
            is the mean residual that is due to the Gaussian.
        diagonal: float64 [n, 14] or None, of the information in (mean 3, quaternion 4 as given, log-scale 3, color 3,
            logit 1), the vector of paper eq. (3); summed on request only.
    """

    def __init__(self, n: int, diagonal: bool = False) -> None:
        """Begin with zeros.

        Args:
            n: number of Gaussians.
            diagonal: also sum `diagonal`.
        """
        self.geometry = np.zeros((n, GEOMETRY_SIZE))
        self.color = np.zeros((n, 3))
        self.opacity = np.zeros(n)
        self.observations = np.zeros(n, dtype=np.uint32)
        self.weight = np.zeros(n)
        self.residual = np.zeros(n)
        self.diagonal = np.zeros((n, FISHER_DIAGONAL_COLUMNS)) if diagonal else None

    def __len__(self) -> int:
        return len(self.opacity)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The sums by name, [n, ...] each; `diagonal` only if it was asked for."""
        return {name: array for name, array in vars(self).items() if array is not None}


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss of one view; the loss itself is `splat.losses.rgbd_loss`.

    Attributes:
        color_huber: color residual (0..1) where the loss turns from quadratic to linear of slope 1.
        depth_weight: of one meter of depth against one unit of color.
        depth_huber_m: depth residual (m) where the loss turns from quadratic to linear of slope 1.
        alpha_weight: of missing opacity where a depth was measured.
        surface_weight: of one meter between the depth of single Gaussians, by their blending weight, and the measured
            one.
        depth_sigma_quadratic_per_m: of depth of which nothing is stated (`splat.losses.depth_certainty`); 0: all of it
            counts alike.
    """

    color_huber: float
    depth_weight: float
    depth_huber_m: float
    alpha_weight: float
    surface_weight: float = 0.0
    depth_sigma_quadratic_per_m: float = 0.0

    def __post_init__(self) -> None:
        for name, least in (
            ("color_huber", SMALLEST_HUBER),
            ("depth_weight", 0.0),
            ("depth_huber_m", SMALLEST_HUBER),
            ("alpha_weight", 0.0),
            ("surface_weight", 0.0),
            ("depth_sigma_quadratic_per_m", 0.0),
        ):
            value = getattr(self, name)
            if not (isinstance(value, Real) and least <= float(value) <= LARGEST_LOSS_WEIGHT):
                raise ValueError(
                    f"loss.{name} is {value!r}, expected a number from {least:g} to {LARGEST_LOSS_WEIGHT:g}"
                )


@dataclass(frozen=True)
class ViewLoss:
    """Loss of one view.

    Attributes:
        value: weighted sum of the terms.
        color: mean of the color term before its weight, 0..1.
        depth: mean of the depth term before its weight, meters.
        d_exposure: derivatives of value by the exposure (a, b).
        surface: mean of the surface term before its weight, meters; not measured, and 0, where its weight is 0.
    """

    value: float
    color: float
    depth: float
    d_exposure: tuple[float, float]
    surface: float = 0.0


@dataclass(frozen=True)
class Statistics:
    """Work of the last view.

    Attributes:
        visible: Gaussians on the screen.
        intersections: entries of all tile lists.
        evaluated_pairs: pairs of pixel and Gaussian whose alpha was computed.
        blended_pairs: of them, those that were drawn.
        scratch_bytes: memory held between calls.
    """

    visible: int
    intersections: int
    evaluated_pairs: int
    blended_pairs: int
    scratch_bytes: int
