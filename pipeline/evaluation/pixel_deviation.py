"""The depth that a map renders at a pixel, and its standard deviation by the stated ones of the Gaussians it blends.

docs/explanation/information.md, "The deviation of a rendered pixel", derives the formula.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.consensus.evidence import rows_by_id, stated_positions
from duagc.pipeline.evaluation.rendering import in_world
from duagc.pipeline.evaluation.views import surface_depth
from duagc.pipeline.geometry import se3
from duagc.pipeline.kernels.blended_values import blended_values
from duagc.pipeline.messages import GaussianInformation, GaussianMap
from duagc.pipeline.runs.folder import RobotRun, position_information
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import sigma_along

if TYPE_CHECKING:
    from duagc.pipeline.geometry.camera import PinholeCamera
    from duagc.pipeline.geometry.masks import Mask
    from duagc.pipeline.kernels import Rasterizer

LEAST_ACROSS = 0.1
"""Of a ray of depth one, along a normal: a disc seen more from the side, by 84 degrees, is no surface for the ray."""
LEAST_STATED = 0.5
"""Share of a pixel's alpha of which something must be stated."""
NEAREST_M = 0.05
"""Depth of a center up to which its ray says nothing; as near as the rasterizer draws is farther."""


@dataclass(frozen=True)
class StatedMap:
    """A map with what is stated of its Gaussians.

    Attributes:
        gaussians: n.
        sigma_m: standard deviation of every mean along the normal of its disc, meters [n]; infinite where none is
            stated.
        depth: of a Gaussian at a pixel, as the map was made.
    """

    gaussians: Gaussians
    sigma_m: Array
    depth: DepthKind

    def __post_init__(self) -> None:
        if self.sigma_m.shape != (len(self.gaussians),):
            raise ValueError(f"sigma_m has shape {self.sigma_m.shape}, expected ({len(self.gaussians)},)")


@dataclass(frozen=True)
class RenderedDepth:
    """Images [h, w] in meters.

    Attributes:
        depth_m: 0 where alpha is below 0.5.
        sigma_m: its standard deviation; 0 likewise, and where less than half of alpha is of Gaussians that have one.
    """

    depth_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]


def stated_own(robot: RobotRun) -> StatedMap:
    """A robot's own map in its map frame, with what it states of it to its peers.

    Args:
        robot: of a run.
    """
    own, information = robot.own_map, robot.information
    rows = rows_by_id(own.gaussians.ids, information.ids)
    deviation_m = np.zeros(len(rows))
    deviation_m[rows >= 0] = information.deviation_m[rows[rows >= 0]]
    sums = _of_rows(information, rows)
    return _stated(own, stated_positions(own.gaussians, sums, deviation_m))


def stated_in_world(robot: RobotRun, shown: GaussianMap) -> StatedMap:
    """The fused or the final map of a robot.

    Training after fusion does not change what is stated of a Gaussian. Of those that a final map takes from a peer in
    the place of own ones, it states itself what their owner knows.

    Args:
        robot: of a run.
        shown: one of these maps of it.
    """
    blocks = np.zeros((len(shown.gaussians), 3, 3))
    for information in (robot.fused_map.information, shown.information):
        if information is not None:
            rows = rows_by_id(shown.gaussians.ids, information.ids)
            blocks[rows >= 0] = position_information(information.geometry[rows[rows >= 0]])
    return _stated(shown, blocks)


def own_in_world(robot: RobotRun, own: StatedMap) -> StatedMap:
    """The own map where consensus puts its keyframes: what is stated along a normal moves with it.

    Args:
        robot: whose keyframes move the map.
        own: its own map in the map frame (`stated_own`).
    """
    return StatedMap(in_world(robot, "own", own.gaussians), own.sigma_m, own.depth)


def _of_rows(information: GaussianInformation, rows: NDArray[np.int64]) -> Array:
    """Position blocks [n, 3, 3] of some rows; zero for row -1."""
    blocks = np.zeros((len(rows), 3, 3))
    blocks[rows >= 0] = position_information(information.geometry[rows[rows >= 0]])
    return blocks


def _stated(shown: GaussianMap, information: Array) -> StatedMap:
    return StatedMap(shown.gaussians, sigma_along(information, shown.gaussians.normals())[0], shown.depth)


def rendered_depth(
    rasterizer: Rasterizer,
    stated: StatedMap,
    camera: PinholeCamera,
    T_camera_map: ArrayLike,
    *,
    mask: Mask | None = None,
) -> RenderedDepth:
    """The depth of a map and its standard deviation at every pixel, from one render.

    Moved by its deviation along its normal n, a Gaussian moves by sigma / |n r| along the ray r of depth one. However
    the errors of Gaussians go together, their mean by blending weight deviates by no more than the mean of their
    deviations, which is drawn as a color; Gaussians without one are left out of it. Where the pixel blends surfaces,
    the blended depth is that of neither: the difference from the depth of the layer that stops half of the light
    counts in quadrature.

    Args:
        rasterizer: draws.
        stated: the map.
        camera: of the view.
        T_camera_map: [4, 4].
        mask: bool [h, w], pixels that are drawn; the others are 0. None: all.
    """
    T = np.asarray(T_camera_map, dtype=np.float64)
    blended = blended_values(
        stated.gaussians,
        _along_rays(stated, T),
        camera,
        T,
        rasterizer=rasterizer,
        depth_kind=stated.depth,
        mask=mask,
    )
    layer_m, depth_m = blended.layer_m, surface_depth(blended.render)
    sigma_m = np.zeros_like(depth_m)
    drawn = (depth_m > 0) & (blended.weight >= LEAST_STATED * blended.render.alpha)
    between_m = np.where(layer_m[drawn] > 0, depth_m[drawn] - layer_m[drawn], 0.0)
    sigma_m[drawn] = np.hypot(blended.mean[drawn], between_m)
    return RenderedDepth(depth_m, sigma_m)


def _along_rays(stated: StatedMap, T_camera_map: Array) -> Array:
    """Standard deviation of the depth [n], meters, where the ray through the center meets every disc."""
    centers = se3.transform(T_camera_map, stated.gaussians.means.astype(np.float64))
    normals = stated.gaussians.normals() @ T_camera_map[:3, :3].T
    across = np.abs(np.sum(normals * centers, axis=1)) / np.maximum(centers[:, 2], NEAREST_M)
    return np.asarray(stated.sigma_m / np.maximum(across, LEAST_ACROSS))
