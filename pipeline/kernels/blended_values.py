"""A number of every Gaussian as an image shows it: its mean by blending weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.masks import Mask
from duagc.pipeline.kernels.rasterizer import Rasterizer
from duagc.pipeline.kernels.types import Render
from duagc.pipeline.splat.gaussians import Gaussians


@dataclass(frozen=True)
class BlendedValues:
    """Images [h, w].

    Attributes:
        render: of the map; its colors mean nothing.
        mean: of the numbers, float32; infinite where no Gaussian has one.
        weight: blending weight of the Gaussians that have one, float32.
        layer_m: depth of the layer that stops the light, meters (`Rasterizer.forward_with_layer`).
    """

    render: Render
    mean: NDArray[np.float32]
    weight: NDArray[np.float32]
    layer_m: NDArray[np.float32]


def blended_values(
    gaussians: Gaussians,
    values: Array,
    camera: PinholeCamera,
    T_camera_map: ArrayLike,
    *,
    rasterizer: Rasterizer,
    depth_kind: DepthKind = "blended",
    mask: Mask | None = None,
) -> BlendedValues:
    """Draw numbers in the place of colors.

    Args:
        gaussians: n of the map.
        values: [n]; infinite: the Gaussian has none, and is left out of the mean.
        camera: of the view.
        T_camera_map: [4, 4].
        rasterizer: draws.
        depth_kind: depth of a Gaussian at a pixel.
        mask: bool [h, w], pixels that are drawn; None: all.
    """
    known = np.isfinite(values)
    colors = np.stack([np.where(known, values, 0.0), known, known], axis=1)
    render, layer_m = rasterizer.forward_with_layer(
        gaussians.replace(colors=colors), camera, T_camera_map, depth_kind=depth_kind, mask=mask
    )
    weight = render.color[..., 1]
    mean = np.full(weight.shape, np.inf, np.float32)
    np.divide(render.color[..., 0], weight, out=mean, where=weight > 0)
    return BlendedValues(render, mean, weight, layer_m)
