"""The information stage: Gauss-Newton Fisher sums of one robot's final map over its own keyframes.

Reads the robot's log (images of keyframes only; held-out frames are never decoded) and its frontend.mcap, writes
information.mcap. Source: method section 1 and 2, paper eq. (2)-(4) with J^T R^-1 J in place of squared gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.information import InformationConfig
from duagc.pipeline.config.registration import MovingConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry import se3, so3, spd
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import back_project, visible
from duagc.pipeline.geometry.statistics import mad_sigma
from duagc.pipeline.kernels import FisherSums, Rasterizer
from duagc.pipeline.messages import GaussianInformation, GaussianMap, Keyframe, Odometry
from duagc.pipeline.recording import LogWriter, open_rgbd, read_log
from duagc.pipeline.registration.moving import FreeSpace
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.schemas import topics

CORRELATION_VIEWS = 8
MEDIAN_PX = 5
NEAR_M = 0.05  # points closer to a camera than this are not judged by it
FLOOR_TOLERANCE = 1e-3  # of a log-scale; float32 logs of meters are good to 1e-6
_UPPER = np.triu_indices(9)
_ROWS_AT_A_TIME = 1024  # 9x9 matrices of as many stay in the cache


@dataclass(frozen=True)
class View:
    """One keyframe: color uint8 [H, W, 3] RGB, depth float32 [H, W] m, pose of the camera in the map.

    mask: bool [H, W], pixels that may be used; None = all. depth_sigma_m: [H, W] standard deviation of the depth as the
    log tells it; None: that of the sensor model.
    """

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    T_map_camera: NDArray[np.float64]
    mask: NDArray[np.bool_] | None = None
    depth_sigma_m: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Noise:
    """Noise of the images: color sigma (0..1) and depth sigma(z) = factor (base + quadratic (z - 0.4)^2), m.

    from_log: depth sigma = factor times what the log tells of every pixel.
    color_pixels, depth_pixels: how many neighboring pixels say together what one would say alone.
    """

    color_sigma: float
    depth_factor: float
    depth_base_m: float
    depth_quadratic_per_m: float
    from_log: bool = False
    color_pixels: float = 1.0
    depth_pixels: float = 1.0

    def depth_sigma_m(
        self, depth_m: NDArray, told_m: NDArray[np.float32] | None = None
    ) -> NDArray[np.float64]:
        """Standard deviation of measured depths, meters; told_m: what the log tells, if it does."""
        if told_m is not None:
            # where there is no depth any number will do
            return self.depth_factor * np.where(told_m > 0, told_m, 1.0).astype(np.float64)
        z = np.asarray(depth_m, dtype=np.float64)
        return self.depth_factor * (self.depth_base_m + self.depth_quadratic_per_m * (z - 0.4) ** 2)

    def depth_formula(self) -> str:
        """The depth noise in words, for the record."""
        if self.from_log:
            return f"{self.depth_factor:.6g} * sigma of the log"
        return f"{self.depth_factor:.6g} * ({self.depth_base_m:.6g} + {self.depth_quadratic_per_m:.6g} * (z - 0.4)^2)"


def run_information(
    log_path: Path,
    frontend_path: Path,
    out_path: Path,
    config: InformationConfig,
    moving: MovingConfig,
    threads: int = 1,
) -> GaussianInformation:
    """Write the Fisher information of a robot's final map, from its own keyframes.

    Args:
        log_path: the robot's sensor log. frontend_path: its frontend.mcap. out_path: information.mcap.
        moving: as the front end looked for what moves.
        threads: of the rasterizer; changes no bit of the result.
    Returns:
        What was written, in the order of the map's Gaussians.
    Raises:
        DuagError: no map in the front end's log, or a keyframe that is held out or not in the sensor log.
    """
    final, keyframes, log_time_ns = read_frontend(frontend_path)
    with open_rgbd(log_path) as log:
        if log.robot != final.robot:
            raise DuagError(f"{frontend_path}: has the map of {final.robot}, expected that of {log.robot}")
        beyond = [k.frame_index for k in keyframes if k.frame_index >= len(log)]
        if beyond:
            raise DuagError(
                f"{frontend_path}: {topics.KEYFRAME.of(log.robot)} names frame {beyond[0]}, "
                f"expected less than the {len(log)} frames of {log_path.name}"
            )
        views = []
        for keyframe in keyframes:
            frame = log.frame(keyframe.frame_index)
            views.append(View(frame.color, frame.depth, keyframe.T_map_camera, frame.mask, frame.depth_sigma))
        camera = log.camera
    views = without_moving(views, camera, moving)
    noise = estimate_noise(final.gaussians, camera, views, config, threads, depth=final.depth)
    noise, overlap = with_correlation(noise, final.gaussians, camera, views, config, threads, final.depth)
    sums = sum_information(final.gaussians, camera, views, noise, config, threads, depth=final.depth)
    result = GaussianInformation(
        stamp_ns=final.stamp_ns,
        robot=final.robot,
        kind="gauss_newton",
        window=config.window if config.window == "all" else f"{config.window} {config.window_length}",
        ids=final.gaussians.ids,
        geometry=without_thickness(sums.geometry, final.gaussians, config.thickness_floor_m).astype(
            np.float32
        ),
        color=sums.color.astype(np.float32),
        opacity=sums.opacity.astype(np.float32),
        observations=sums.observations,
        color_sigma=noise.color_sigma,
        depth_sigma=noise.depth_formula(),
        deviation_m=surface_deviation(final.gaussians, camera, views, config.deviation_gate_m).astype(
            np.float32
        ),
        color_pixels_per_sample=noise.color_pixels,
        depth_pixels_per_sample=noise.depth_pixels,
        overlap=overlap,
    )
    with LogWriter(out_path, robot=final.robot) as writer:
        writer.write(topics.INFORMATION.of(final.robot), result, log_time_ns)
    return result


def without_moving(views: Sequence[View], camera: PinholeCamera, config: MovingConfig) -> list[View]:
    """The views with what moved masked, as the front end did before it mapped them."""
    free = FreeSpace(camera, config)
    depths = [v.depth_m if v.mask is None else np.where(v.mask, v.depth_m, np.float32(0)) for v in views]
    for view, depth_m in zip(views, depths, strict=True):
        free.add(depth_m, view.T_map_camera)
    return [
        replace(view, mask=free.usable(depth_m, view.T_map_camera, view.mask))
        for view, depth_m in zip(views, depths, strict=True)
    ]


def read_frontend(path: Path) -> tuple[GaussianMap, list[Keyframe], int]:
    """The last map of a front end's log, the last word on every keyframe in order, and the log time of the map.

    Raises:
        DuagError: no map, or a keyframe whose frame is held out for evaluation.
    """
    final: GaussianMap | None = None
    log_time_ns = 0
    keyframes: dict[int, Keyframe] = {}
    held_out: set[int] = set()
    for record in read_log(path, (topics.MAP, topics.KEYFRAME, topics.ODOMETRY)):
        row = topics.find(record.topic)
        if row is None:
            continue
        if row[0] is topics.MAP:
            final, log_time_ns = record.message(), record.log_time_ns
        elif row[0] is topics.KEYFRAME:
            keyframe: Keyframe = record.message()
            keyframes[keyframe.keyframe_index] = keyframe
        elif row[0] is topics.ODOMETRY:
            odometry: Odometry = record.message()
            if odometry.held_out:
                held_out.add(odometry.frame_index)
    if final is None:
        raise DuagError(
            f"{path}: {topics.MAP.pattern} has no message, expected the map of a finished front end"
        )
    ordered = [keyframes[index] for index in sorted(keyframes)]
    for keyframe in ordered:
        if keyframe.frame_index in held_out:
            raise DuagError(
                f"{path}: {topics.KEYFRAME.of(keyframe.robot)} has frame {keyframe.frame_index}, "
                "expected no frame that is held out for evaluation"
            )
    return final, ordered, log_time_ns


def estimate_noise(
    gaussians: Gaussians,
    camera: PinholeCamera,
    views: Sequence[View],
    config: InformationConfig,
    threads: int = 1,
    every: int = 4,
    depth: DepthKind = "blended",
) -> Noise:
    """Noise from the residuals of the map's own renders: 1.4826 times the median absolute residual.

    Only pixels that the map covers (alpha above 0.9) count, in every `every`-th block of 4x4 px in both
    directions; such blocks are what the rasterizer can leave out. The residuals hold the map's errors beside the
    sensor's, so that a poor map does not call itself certain. Depth residuals are taken in units of the configured
    sigma(z); their spread is the factor on it. Without such pixels the color is at its floor and the factor is 1.
    """
    rasterizer = Rasterizer(threads=threads)
    unit = Noise(1.0, 1.0, config.depth_sigma_base_m, config.depth_sigma_quadratic_per_m)
    colors, depths = [np.zeros(0)], [np.zeros(0)]
    sample = np.ix_(_in_blocks(camera.height, every), _in_blocks(camera.width, every))
    mask = np.zeros((camera.height, camera.width), bool)
    mask[sample] = True
    for view in views:
        usable = mask if view.mask is None else mask & view.mask  # alpha is 0 elsewhere: not covered
        render = rasterizer.forward(
            gaussians, camera, se3.inverse(view.T_map_camera), mask=usable, depth_kind=depth
        )
        alpha, z = render.alpha[sample].astype(np.float64), view.depth_m[sample].astype(np.float64)
        covered = alpha > 0.9
        difference = render.color[sample].astype(np.float64) - view.color[sample] / 255.0
        colors.append(np.abs(difference[covered]).ravel())
        both = covered & (z > 0)
        residual = render.depth[sample][both] / alpha[both] - z[both]
        told = None if view.depth_sigma_m is None else view.depth_sigma_m[sample][both]
        depths.append(np.abs(residual) / unit.depth_sigma_m(z[both], told))
    color, units = np.concatenate(colors), np.concatenate(depths)
    color_sigma = mad_sigma(color) if len(color) else 0.0
    factor = 1.0
    if config.depth_factor_from_residuals and len(units):
        factor = mad_sigma(units)
        factor = float(np.clip(factor, config.depth_factor_min, config.depth_factor_max))
    return Noise(
        color_sigma=max(color_sigma, config.color_sigma_floor),
        depth_factor=factor,
        depth_base_m=config.depth_sigma_base_m,
        depth_quadratic_per_m=config.depth_sigma_quadratic_per_m,
        from_log=any(view.depth_sigma_m is not None for view in views),
    )


def with_correlation(
    noise: Noise,
    gaussians: Gaussians,
    camera: PinholeCamera,
    views: Sequence[View],
    config: InformationConfig,
    threads: int = 1,
    depth: DepthKind = "blended",
) -> tuple[Noise, float]:
    """The noise with its pixels per sample, and how many Gaussians a pixel draws; from some of the views.

    Residuals of neighboring pixels are alike, because a map's errors are: n pixels then say as much as n / m that are
    independent, with m the sum of the residuals' autocorrelation over the window (the effective sample size of a mean).
    Residuals beyond four times their robust spread count as that much.
    """
    rasterizer = Rasterizer(threads=threads)
    chosen = views[:: max(1, -(-len(views) // CORRELATION_VIEWS))]
    sums = {
        "color": _Autocorrelation(config.correlation_px),
        "depth": _Autocorrelation(config.correlation_px),
    }
    drawn = pixels = 0
    for view in chosen:
        render = rasterizer.forward(
            gaussians, camera, se3.inverse(view.T_map_camera), mask=view.mask, depth_kind=depth
        )
        drawn += rasterizer.statistics().blended_pairs
        pixels += camera.height * camera.width if view.mask is None else int(np.count_nonzero(view.mask))
        covered = render.alpha > 0.9
        color = (render.color.astype(np.float64) - view.color / 255.0).mean(axis=2)
        both = covered & (view.depth_m > 0)
        z = np.where(both, view.depth_m, 1.0).astype(np.float64)
        off = (render.depth / np.maximum(render.alpha, 0.9) - z) / noise.depth_sigma_m(z, view.depth_sigma_m)
        sums["color"].add(color, covered)
        sums["depth"].add(off, both)
    found = {name: autocorrelation.pixels_per_sample() for name, autocorrelation in sums.items()}
    changed = replace(noise, color_pixels=found["color"], depth_pixels=found["depth"])
    return changed, max(1.0, drawn / max(pixels, 1))


class _Autocorrelation:
    """Sums of products of residuals some pixels apart, over images."""

    def __init__(self, reach_px: int) -> None:
        self.reach_px = reach_px
        side = 2 * reach_px + 1
        self.products, self.counts = np.zeros((side, side)), np.zeros((side, side))

    def add(self, residual: NDArray[np.float64], usable: NDArray[np.bool_]) -> None:
        """Take the usable pixels of an image [H, W]."""
        if not usable.any():
            return
        limit = 4 * mad_sigma(residual[usable])
        x = np.where(usable, np.clip(residual, -limit, limit), 0.0)
        r, (h, w) = self.reach_px, x.shape
        for i in range(min(r, h - 1) + 1):
            for j in range(-min(r, w - 1), min(r, w - 1) + 1):
                if i == 0 and j < 0:
                    continue  # the other half is the same, turned
                a = np.s_[: h - i, max(0, -j) : w - max(0, j)]
                b = np.s_[i:, max(0, j) : w + min(0, j)]
                product, count = float(np.sum(x[a] * x[b])), int(np.count_nonzero(usable[a] & usable[b]))
                for v, u in {(r + i, r + j), (r - i, r - j)}:
                    self.products[v, u] += product
                    self.counts[v, u] += count

    def pixels_per_sample(self) -> float:
        """Sum of the correlations over the window; 1 for independent residuals, and where there are none."""
        r = self.reach_px
        if not self.products[r, r] > 0:
            return 1.0
        covariance = self.products / np.maximum(self.counts, 1.0)
        return max(1.0, float(np.sum(covariance) / covariance[r, r]))


def surface_deviation(
    gaussians: Gaussians, camera: PinholeCamera, views: Sequence[View], gate_m: float
) -> NDArray[np.float64]:
    """How far every Gaussian's mean is from the surface that the depth images show, meters [n].

    Splats that overlap make up for each other's places: where a sum of them is drawn to a millimeter, each may be a
    centimeter off, and no pixel tells. What tells is the depth image itself: the median, over the views that measured a
    surface within the gate, of the mean's distance from the tangent plane at its pixel (of the depth's median over
    5 x 5 px, or the sensor's noise would pass for the map's deviation). Not the root mean square: at an edge some views
    look past a Gaussian at another surface. The median over all Gaussians counts as half a view more; a Gaussian that
    no view measured has the gate.
    """
    import cv2

    means, n = gaussians.means.astype(np.float64), len(gaussians)
    all_rows, all_distances = [np.zeros(0, np.int64)], [np.zeros(0)]
    for view in views:
        usable = view.depth_m if view.mask is None else np.where(view.mask, view.depth_m, np.float32(0))
        smooth = np.asarray(cv2.medianBlur(np.ascontiguousarray(usable), MEDIAN_PX), dtype=np.float32)
        points = se3.transform(se3.inverse(view.T_map_camera), means)
        rows, distance_m = _from_tangent_planes(points, smooth, camera)
        near = np.abs(distance_m) < gate_m
        all_rows.append(rows[near])
        all_distances.append(np.abs(distance_m[near]))
    rows, distance_m = np.concatenate(all_rows), np.concatenate(all_distances)
    distance_m = distance_m[np.lexsort((distance_m, rows))]
    count = np.bincount(rows, minlength=n)
    measured = count > 0
    deviation_m = np.full(n, gate_m)
    if measured.any():
        views_of, first = count[measured], (np.cumsum(count) - count)[measured]
        median = distance_m[first + (views_of - 1) // 2]
        typical = np.median(median)
        deviation_m[measured] = np.sqrt((views_of * median**2 + 0.5 * typical**2) / (views_of + 0.5))
    return deviation_m


def _from_tangent_planes(
    points_camera: NDArray[np.float64], depth_m: NDArray[np.float32], camera: PinholeCamera
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows of the points whose pixel and its neighbors two pixels off were measured, and their distances, meters."""
    rows, u, v = visible(camera, points_camera, NEAR_M, margin_px=2)

    def surface(du: int, dv: int) -> NDArray[np.float64]:
        return back_project(camera, u + du, v + dv, depth_m[v + dv, u + du].astype(np.float64))

    at, right, left, below, above = (surface(*d) for d in ((0, 0), (2, 0), (-2, 0), (0, 2), (0, -2)))
    normal = np.cross(right - left, below - above)
    length = np.linalg.norm(normal, axis=1)
    measured = (length > 0) & np.all([p[:, 2] > 0 for p in (at, right, left, below, above)], axis=0)
    off = np.sum(normal * (points_camera[rows] - at), axis=1) / np.where(length > 0, length, 1.0)
    return rows[measured], off[measured]


def _in_blocks(side_px: int, every: int) -> NDArray[np.int64]:
    """Pixels along a side of the image that lie in every `every`-th block of four."""
    pixels = np.arange(side_px)
    return pixels[pixels // 4 % every == every // 2]


def sum_information(
    gaussians: Gaussians,
    camera: PinholeCamera,
    views: Sequence[View],
    noise: Noise,
    config: InformationConfig,
    threads: int = 1,
    depth: DepthKind = "blended",
) -> FisherSums:
    """One sweep over the views at the current Gaussians; the newest view is the last.

    Where the map or the depth image has a hole the depth brings nothing, where a view's mask forbids a pixel neither
    does color; a Gaussian that no view saw keeps zero.
    """
    rasterizer = Rasterizer(threads=threads)
    total = FisherSums(len(gaussians))
    chosen = views[-config.window_length :] if config.window == "rolling" else views
    color_precision = 1 / (noise.color_sigma**2 * noise.color_pixels)
    inverse_color = np.full((camera.height, camera.width), color_precision, np.float32)
    # newest first, so that `per_gaussian` can stop at the latest that saw a Gaussian
    for view in reversed(chosen):
        variance = np.square(noise.depth_sigma_m(view.depth_m, view.depth_sigma_m)) * noise.depth_pixels
        inverse_variance = 1.0 / variance
        inverse_depth = np.where(view.depth_m > 0, inverse_variance, 0.0).astype(np.float32)
        rasterizer.forward(
            gaussians, camera, se3.inverse(view.T_map_camera), mask=view.mask, depth_kind=depth
        )
        if config.window == "per_gaussian":
            one = FisherSums(len(gaussians))
            rasterizer.fisher(inverse_color, inverse_depth, one)
            wanting = total.observations < config.window_length
            for name, array in total.arrays().items():
                array[wanting] += one.arrays()[name][wanting]
        else:
            rasterizer.fisher(inverse_color, inverse_depth, total)
    return total


def without_thickness(
    geometry: NDArray[np.float64], gaussians: Gaussians, floor_m: float
) -> NDArray[np.float64]:
    """Geometry information [n, 45] with the directions of scales at the floor taken out.

    A scale at the floor is held there by the map, not by the images. In the eigenbasis of log Sigma its direction is
    v = vec(e e^T), e the axis; F becomes P F P with P = 1 - v v^T on the covariance block: what is left is the
    information given the floor, and v itself has none. The tilt of a disc (e e_t^T + e_t e^T) keeps its information.
    """
    at_floor = gaussians.log_scales <= np.float32(np.log(floor_m) + FLOOR_TOLERANCE)
    result = geometry.copy()
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
    F = np.zeros((len(geometry), 9, 9))
    F[:, _UPPER[0], _UPPER[1]] = geometry
    F[:, _UPPER[1], _UPPER[0]] = geometry
    for k in range(3):
        e = axes[:, :, k]
        v = np.zeros((len(e), 9))
        v[:, 3:] = spd.sym_to_vec(e[:, :, None] * e[:, None, :]) * at_floor[:, k, None]
        Fv = (F * v[:, None, :]).sum(axis=2)
        half = Fv - 0.5 * (Fv * v).sum(axis=1)[:, None] * v
        outer = half[:, :, None] * v[:, None, :]
        F -= outer + outer.swapaxes(1, 2)
    return F[:, _UPPER[0], _UPPER[1]]
