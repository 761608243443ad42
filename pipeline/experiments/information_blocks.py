"""The whole information of some Gaussians of a finished run's own maps: with its cross terms, by window, and by (2).

Everything is summed from the derivatives of single pixels, in float64, over the keyframes and with the noise of the
information stage, whose sums must come out again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.progress import track
from duagc.pipeline.geometry import se3, so3, spd
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.information.noise import ImageNoise
from duagc.pipeline.information.sums import FLOOR_TOLERANCE
from duagc.pipeline.information.views import MapViews
from duagc.pipeline.kernels.pixel_jacobians import Footprint, PixelJacobians
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import LOG_COVARIANCE, THETA_SIZE

PARAMETERS = 14
COVERED_ALPHA = 0.9
"""Opacity of a pixel from which its residual is one of noise: as the information stage estimates the noise."""
_LOG_SCALES = slice(7, 10)  # of the 14 parameters
_COLOR, _DEPTH = slice(0, 3), 3  # of the channels of a pixel


@dataclass
class BlockSums:
    """Sums over pixels and keyframes for r Gaussians; directions at the thickness floor are taken out of all.

    Those of `chart` and the windows have the noise of the information stage; those of the covered pixels, which (2) is
    compared on, that of single pixels.

    Attributes:
        parameters: [r, 14, 14], J^T R^-1 J over mean 3, quaternion 4, log-scale 3, color 3, logit 1.
        chart: [r, 13, 13], the same over mean 3, vec log Sigma 6, color 3, logit 1.
        rolling: by K, [r, 13, 13], over the last K keyframes.
        latest: by K, [r, 13, 13], over the last K keyframes that saw the Gaussian.
        covered: [r, 13, 13], J^T R^-1 J over the covered pixels.
        covered_color: [r, 13, 13], its part of the color.
        squared: [r, 13, 13], over the same pixels, g g^T with g = J^T R^-1 times the pixel's residual.
        squared_color: [r, 13, 13], the same of the color alone, as (2) is printed.
        views: [r], keyframes that saw it.
        pixels: [r], over all keyframes.
        weight: [r], sum of the blending weights.
        depth_m: [r], sum over the keyframes of the depth of its center.
        residual: [r], sum of weight times root mean square of the color residual.
    """

    parameters: Array
    chart: Array
    rolling: dict[int, Array]
    latest: dict[int, Array]
    covered: Array
    covered_color: Array
    squared: Array
    squared_color: Array
    views: NDArray[np.int64]
    pixels: NDArray[np.int64]
    weight: Array
    depth_m: Array
    residual: Array

    @staticmethod
    def zeros(count: int, windows: Sequence[int]) -> BlockSums:
        """Of nothing yet.

        Args:
            count: of the Gaussians.
            windows: numbers of keyframes K.
        """

        def square(size: int = THETA_SIZE) -> Array:
            return np.zeros((count, size, size))

        return BlockSums(
            parameters=square(PARAMETERS),
            chart=square(),
            rolling={K: square() for K in windows},
            latest={K: square() for K in windows},
            covered=square(),
            covered_color=square(),
            squared=square(),
            squared_color=square(),
            views=np.zeros(count, np.int64),
            pixels=np.zeros(count, np.int64),
            weight=np.zeros(count),
            depth_m=np.zeros(count),
            residual=np.zeros(count),
        )


def sum_blocks(
    views: MapViews,
    noise: ImageNoise,
    rows: NDArray[np.int64],
    windows: Sequence[int],
    *,
    thickness_floor_m: float,
    what: str = "information",
) -> BlockSums:
    """Sums of some Gaussians over the images of their map; the newest image is the last.

    Args:
        views: the map and its images.
        noise: of the images.
        rows: [r], of the Gaussians.
        windows: numbers of keyframes K.
        thickness_floor_m: least standard deviation of the map.
        what: is summed, for the progress.
    """
    sums = BlockSums.zeros(len(rows), windows)
    footprints = PixelJacobians(views.gaussians, rows, views.camera, views.depth_kind)
    newest_first = list(reversed(range(len(views.images))))
    for back, index in enumerate(track(newest_first, what)):
        image = views.images[index]
        for found in footprints.view(se3.inverse(image.T_world_camera), image.mask):
            _add(sums, found, image, noise, back=back)
    _hold_thickness(sums, views.gaussians.select(rows), thickness_floor_m)
    return sums


def _add(sums: BlockSums, found: Footprint, image: PosedRgbd, noise: ImageNoise, *, back: int) -> None:
    """Add one view of one Gaussian; `back` keyframes are newer."""
    k, (x, y) = found.row, found.pixels.T
    measured_m = image.depth_m[y, x].astype(np.float64)
    logged_m = None if image.depth_sigma_m is None else image.depth_sigma_m[y, x]
    of_color = 1 / noise.color_sigma**2
    of_depth = np.where(measured_m > 0, 1 / np.square(noise.depth_sigma_m(measured_m, logged_m)), 0.0)
    J = found.by_screen
    color, depth = _gram(J[_COLOR] * np.sqrt(of_color)), _gram(J[_DEPTH] * np.sqrt(of_depth)[:, None])
    whole = color / noise.color_pixels + depth / noise.depth_pixels
    chart = _chained(whole, found.by_chart)
    sums.parameters[k] += _chained(whole, found.by_parameters)
    sums.chart[k] += chart
    for K, of_window in sums.rolling.items():
        of_window[k] += chart * (back < K)
    for K, of_window in sums.latest.items():
        of_window[k] += chart * (sums.views[k] < K)

    residual = found.color - image.unit_color[y, x].astype(np.float64)
    covered = found.alpha > COVERED_ALPHA
    off_m = found.depth / np.maximum(found.alpha, COVERED_ALPHA) - measured_m
    score_color = of_color * np.einsum("cms,mc->ms", J[_COLOR], residual)[covered]
    score = score_color + ((of_depth * off_m)[:, None] * J[_DEPTH])[covered]
    covered_color = _gram(J[_COLOR][:, covered] * np.sqrt(of_color))
    covered_depth = _gram((J[_DEPTH] * np.sqrt(of_depth)[:, None])[covered])
    sums.covered_color[k] += _chained(covered_color, found.by_chart)
    sums.covered[k] += _chained(covered_color + covered_depth, found.by_chart)
    sums.squared_color[k] += _chained(_gram(score_color), found.by_chart)
    sums.squared[k] += _chained(_gram(score), found.by_chart)

    sums.views[k] += 1
    sums.pixels[k] += len(x)
    sums.weight[k] += found.weights.sum()
    sums.depth_m[k] += found.depth_m
    sums.residual[k] += float(found.weights @ np.sqrt((residual**2).mean(axis=1)))


def _gram(rows: Array) -> Array:
    """Sum of the outer products [s, s] of rows [..., s]."""
    flat = rows.reshape(-1, rows.shape[-1])
    return flat.T @ flat


def _chained(of_screen: Array, by_inputs: Array) -> Array:
    return by_inputs.T @ of_screen @ by_inputs


def _hold_thickness(sums: BlockSums, gaussians: Gaussians, floor_m: float) -> None:
    """Take out what the map holds fixed, as `information.sums.without_thickness` does for the 9x9."""
    at_floor = gaussians.log_scales <= np.float32(np.log(floor_m) + FLOOR_TOLERANCE)
    axes = so3.from_quat_wxyz(gaussians.quats_wxyz)
    v = np.zeros((len(gaussians), 3, THETA_SIZE))  # one direction for each axis, orthogonal to each other
    for axis in range(3):
        e = axes[:, :, axis]
        v[:, axis, LOG_COVARIANCE] = spd.sym_to_vec(e[:, :, None] * e[:, None, :]) * at_floor[:, axis, None]
    P = np.eye(THETA_SIZE) - np.einsum("nki,nkj->nij", v, v)
    free = np.ones((len(gaussians), PARAMETERS))
    free[:, _LOG_SCALES] -= at_floor
    sums.parameters *= free[:, :, None] * free[:, None, :]
    of_chart = [sums.chart, sums.covered, sums.covered_color, sums.squared, sums.squared_color]
    for matrices in (*of_chart, *sums.rolling.values(), *sums.latest.values()):
        matrices[:] = P @ matrices @ P
