"""Arrays that the compiled kernels write into."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.kernels import _raster
from duagc.pipeline.kernels.arguments import arrays_of
from duagc.pipeline.kernels.types import Gradients, LossWeights, ViewLoss
from duagc.pipeline.splat.gaussians import Gaussians

NOTHING = np.zeros(0, dtype=np.float32)  # an optional array that is not given


def empty(*shape: int) -> NDArray[np.float32]:
    """An array in memory that earlier outputs gave back, holding anything.

    Args:
        *shape: of the array.
    """
    return _raster.empty(int(np.prod(shape))).reshape(shape)


def zeros(*shape: int) -> NDArray[np.float32]:
    """The same, holding zeros.

    Args:
        *shape: of the array.
    """
    array = empty(*shape)
    array.fill(0.0)
    return array


def outputs_for(gaussians: Gaussians, parameters: bool) -> list[NDArray[np.float32]]:
    """Where the derivatives by the parameters go; arrays without elements if they are not wanted.

    Args:
        gaussians: by whose parameters is differentiated.
        parameters: whether these derivatives are wanted.
    """
    return [zeros(*array.shape) if parameters else NOTHING for array in arrays_of(gaussians)]


def gradients_of(
    of_parameters: list[NDArray[np.float32]] | None,
    pose: NDArray[np.float64] | None,
    fisher_diagonal: NDArray[np.float32] | None = None,
) -> Gradients:
    """Derivatives as they are handed out.

    Args:
        of_parameters: arrays of `outputs_for`; None: not wanted.
        pose: [6], by the right tangent of the camera's pose; None: not wanted.
        fisher_diagonal: diagonal of the Fisher information; None: not wanted.
    """
    nothing: list[None] = [None] * 5
    names = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")
    arrays: dict[str, Any] = dict(zip(names, of_parameters or nothing, strict=True))
    return Gradients(**arrays, pose=pose, fisher_diagonal=fisher_diagonal)


def view_loss(values: NDArray[np.float64], weights: LossWeights) -> ViewLoss:
    """The loss of a view from its terms.

    Args:
        values: [6] of color, depth, missing alpha, by ln gain, by offset, of surface.
        weights: of the terms.
    """
    of_color, of_depth, missing, by_gain, by_offset, surface = (float(value) for value in values)
    value = (
        of_color
        + weights.depth_weight * of_depth
        + weights.alpha_weight * missing
        + weights.surface_weight * surface
    )
    return ViewLoss(value, of_color, of_depth, (by_gain, by_offset), surface)
