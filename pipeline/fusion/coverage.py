"""Which Gaussians of peers a robot imports: those in space that none of its own keyframes observed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import visible
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import MEAN, mean_block

Index = NDArray[np.int64]
DepthImages = Iterable[tuple[int, NDArray[np.float32]]]
"""(own keyframe index, depth [H, W] in meters, 0 invalid), read once."""
_NEAR_M = 0.05  # points closer to a camera than this are not judged by it


def select_unseen(
    theta: Array,
    information: Array,
    *,
    T_world_keyframe: Array,
    surfaces: DepthImages,
    context: MapContext,
) -> Index:
    """Rows of the Gaussians to import, ascending: those in space that no own keyframe observed.

    Args:
        theta: [n, 13] of the candidates, world frame.
        information: [n, 31] of the candidates.
        T_world_keyframe: [k, 4, 4], own keyframes.
        surfaces: depth of known surfaces by own keyframe (`known_surfaces`).
        context: camera and settings.
    """
    config = context.config
    rows = np.arange(len(theta))
    position = np.trace(mean_block(information), axis1=-2, axis2=-1)
    if config.added_need_information:
        rows, position = rows[position > 0], position[position > 0]
    new = ~explained(theta[rows, MEAN], T_world_keyframe, surfaces, context.camera, config=config)
    rows, position = rows[new], position[new]
    if config.max_added is not None and len(rows) > config.max_added:
        rows = np.sort(rows[np.lexsort((rows, -position))[: config.max_added]])
    return rows


def known_surfaces(
    own_world: Gaussians, T_world_keyframe: Array, depth_images: DepthImages, context: MapContext
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Depth of the surfaces that own keyframes know, where the own map is opaque.

    The measured depth, the rendered one where it is missing, and of these the farthest within a few pixels.

    Args:
        own_world: the own map, world frame.
        T_world_keyframe: [k, 4, 4], own keyframes.
        depth_images: of own keyframes.
        context: camera and settings.
    """
    from scipy.ndimage import maximum_filter

    config, rasterizer = context.config, Rasterizer()
    for keyframe, measured in depth_images:
        T_camera_world = se3.inverse(T_world_keyframe[keyframe])
        render = rasterizer.forward(own_world, context.camera, T_camera_world, depth_kind=context.depth_kind)
        drawn = render.depth / np.maximum(render.alpha, np.float32(1e-3))
        surface = np.where(measured > 0, measured, drawn)
        known = np.where(render.alpha >= config.explained_opacity, surface, np.float32(0))
        yield keyframe, maximum_filter(known, 2 * config.explained_px + 1)


def explained(
    points_world: Array,
    T_world_keyframe: Array,
    depth_images: DepthImages,
    camera: PinholeCamera,
    *,
    config: FusionConfig,
) -> NDArray[np.bool_]:
    """Whether some keyframe observed the space at each point [n]: it measured a surface there or behind it.

    A keyframe that measured something nearer gives no evidence on what is hidden behind.

    Args:
        points_world: [n, 3], meters.
        T_world_keyframe: [k, 4, 4].
        depth_images: of these keyframes.
        camera: of the depth images.
        config: tolerances.
    """
    seen = np.zeros(len(points_world), dtype=bool)
    for keyframe, depth in depth_images:
        left = np.flatnonzero(~seen)
        p = se3.transform(se3.inverse(T_world_keyframe[keyframe]), points_world[left])
        index, column, row = visible(camera, p, _NEAR_M)
        left, z = left[index], p[index, 2]
        measured = depth[row, column].astype(np.float64)
        reach = measured + config.explained_m + config.explained_relative * z
        seen[left[(measured > 0) & (z <= reach)]] = True
    return seen
