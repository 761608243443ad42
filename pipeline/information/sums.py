"""The information of a map's Gaussians: Fisher sums over its images, without what the map itself holds fixed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from duagc.pipeline.config.information import InformationConfig
from duagc.pipeline.geometry import so3, spd
from duagc.pipeline.information.noise import ImageNoise
from duagc.pipeline.information.views import MapViews
from duagc.pipeline.kernels import FisherSums
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import LOG_COVARIANCE, pack_geometry, unpack_geometry

FLOOR_TOLERANCE = 1e-3  # of a log-scale; float32 logs of meters are good to 1e-6
_ROWS_AT_A_TIME = 1024  # 9x9 matrices of as many stay in the cache


def sum_information(views: MapViews, noise: ImageNoise, config: InformationConfig) -> FisherSums:
    """Gauss-Newton information of the Gaussians, summed over the images; the newest image is the last.

    Where the map or the depth image has a hole the depth adds nothing, where an image's mask forbids a pixel neither
    does color; a Gaussian that no image saw keeps zero.

    Args:
        views: the map and its images.
        noise: of the images.
        config: which images are summed.
    Source: paper eq. (2)-(4) with J^T R^-1 J in place of squared gradients.
    """
    camera, count = views.camera, len(views.gaussians)
    rasterizer, total = views.rasterizer(), FisherSums(count)
    chosen = views.images[-config.window_length :] if config.window == "rolling" else views.images
    color_precision = 1 / (noise.color_sigma**2 * noise.color_pixels)
    inverse_color = np.full((camera.height, camera.width), color_precision, np.float32)
    # newest first, so that `per_gaussian` can stop at the latest that saw a Gaussian
    for image in reversed(chosen):
        variance = np.square(noise.depth_sigma_m(image.depth_m, image.depth_sigma_m)) * noise.depth_pixels
        inverse_variance = 1.0 / variance
        inverse_depth = np.where(image.depth_m > 0, inverse_variance, 0.0).astype(np.float32)
        views.draw(rasterizer, image, image.mask)
        if config.window == "per_gaussian":
            one = FisherSums(count)
            rasterizer.fisher(inverse_color, inverse_depth, one)
            wanting = total.observations < config.window_length
            for name, array in total.arrays().items():
                array[wanting] += one.arrays()[name][wanting]
        else:
            rasterizer.fisher(inverse_color, inverse_depth, total)
    return total


def without_thickness(
    geometry: NDArray[np.float64],
    gaussians: Gaussians,
    floor_m: float,
    *,
    dtype: DTypeLike = np.float64,
) -> NDArray[Any]:
    """Geometry information [n, 45] with the directions of scales at the floor taken out.

    A scale at the floor is held there by the map, not by the images. In the eigenbasis of log Sigma its direction is
    v = vec(e e^T), e the axis; F becomes P F P with P = 1 - v v^T on the covariance block: what is left is the
    information given the floor, and v itself has none. The tilt of a disc (e e_t^T + e_t e^T) keeps its information.

    Args:
        geometry: float64 [n, 45].
        gaussians: whose it is.
        floor_m: least standard deviation of the map.
        dtype: of the result; what is computed is rounded to it at the end.
    """
    at_floor = gaussians.log_scales <= np.float32(np.log(floor_m) + FLOOR_TOLERANCE)
    result = geometry.astype(dtype)
    rows = np.flatnonzero(at_floor.any(axis=1))
    for start in range(0, len(rows), _ROWS_AT_A_TIME):
        part = rows[start : start + _ROWS_AT_A_TIME]
        result[part] = _projected(
            geometry[part], so3.from_quat_wxyz(gaussians.quats_wxyz[part]), at_floor[part]
        )
    return result


def _projected(
    geometry: NDArray[np.float64], axes: NDArray[np.float64], at_floor: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """P F P of information [n, 45] for every axis k (columns of [n, 3, 3]) where at_floor[:, k]."""
    F = unpack_geometry(geometry)
    for k in range(3):
        e = axes[:, :, k]
        v = np.zeros((len(e), 9))
        v[:, LOG_COVARIANCE] = spd.sym_to_vec(e[:, :, None] * e[:, None, :]) * at_floor[:, k, None]
        Fv = (F * v[:, None, :]).sum(axis=2)
        half = Fv - 0.5 * (Fv * v).sum(axis=1)[:, None] * v
        outer = half[:, :, None] * v[:, None, :]
        F -= outer + outer.swapaxes(1, 2)
    return pack_geometry(F)
