"""A rasterizer in plain torch, tile by tile: the baseline of the compiled one."""

from __future__ import annotations

from typing import Any

import numpy as np

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import definition
from duagc.pipeline.splat.gaussians import Gaussians

TILE_PX = 16


def tensors_of(room: Gaussians) -> dict[str, Any]:
    """Parameters of Gaussians as tensors that take gradients, by name.

    Args:
        room: the Gaussians.
    """
    import torch

    names = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")
    return {name: torch.tensor(getattr(room, name), requires_grad=True) for name in names}


def draw(parameters: dict[str, Any], camera: PinholeCamera, T_camera_map: np.ndarray) -> Any:
    """Color and depth [H, W, 4] by the reference's formulas, tile by tile, in float32; differentiable.

    Args:
        parameters: of `tensors_of`.
        camera: that draws.
        T_camera_map: [4, 4].
    """
    import torch

    T = torch.tensor(T_camera_map, dtype=torch.float32)
    sigma = definition.sigma_of(parameters["quats_wxyz"], parameters["log_scales"])
    order, z, centers, conics = definition.project(
        parameters["means"], sigma, T[:3, :3], T[:3, 3], camera=camera
    )
    opacities = torch.sigmoid(parameters["opacity_logits"][order])
    values = torch.cat([parameters["colors"][order], z[:, None]], dim=1)
    with torch.no_grad():
        reach = 2 * torch.log(255 * opacities).clamp(min=0)
        extent = torch.sqrt(reach[:, None] * torch.linalg.inv(conics).diagonal(dim1=1, dim2=2))
        low, high = centers - extent, centers + extent
        size = torch.tensor([camera.width, camera.height])
        seen = torch.nonzero(((low < size) & (high >= 0)).all(dim=1) & (reach > 0))[:, 0]
    tiles = []
    for y in range(0, camera.height, TILE_PX):
        height = min(TILE_PX, camera.height - y)
        in_strip = seen[(low[seen, 1] <= y + height - 1) & (high[seen, 1] >= y)]
        for x in range(0, camera.width, TILE_PX):
            width = min(TILE_PX, camera.width - x)
            i = in_strip[(low[in_strip, 0] <= x + width - 1) & (high[in_strip, 0] >= x)]
            rows, columns = torch.meshgrid(
                torch.arange(y, y + height), torch.arange(x, x + width), indexing="ij"
            )
            pixels = torch.stack([columns, rows], -1).reshape(-1, 2).to(torch.float32)
            weights, _ = definition.blend(pixels, centers[i], conics[i], opacities[i])
            tiles.append((weights @ values[i]).reshape(height, width, 4))
    across = -(-camera.width // TILE_PX)
    strips = [torch.cat(tiles[i : i + across], dim=1) for i in range(0, len(tiles), across)]
    return torch.cat(strips, dim=0)
