"""The noise of a robot's images, estimated from the residuals of its own map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.config.information import InformationConfig
from duagc.pipeline.geometry.depth_noise import NEAREST_M, DepthNoise
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.geometry.statistics import MAD_TO_SIGMA, mad_sigma, median_in_place
from duagc.pipeline.information.views import MapViews

CORRELATION_VIEWS = 8


@dataclass(frozen=True)
class ImageNoise:
    """Noise of color and depth images.

    Attributes:
        color_sigma: standard deviation of a color channel, 0..1.
        depth: model of the depth noise; its factor also applies to standard deviations of the log.
        from_log: whether the log has a standard deviation for every pixel, which replaces the model.
        color_pixels: neighboring pixels that are worth one independent one.
        depth_pixels: the same of depth.
    """

    color_sigma: float
    depth: DepthNoise
    from_log: bool = False
    color_pixels: float = 1.0
    depth_pixels: float = 1.0

    def depth_sigma_m(
        self, depth_m: NDArray[np.floating], logged_m: NDArray[np.float32] | None = None
    ) -> NDArray[np.float64]:
        """Standard deviation of measured depths, meters.

        Args:
            depth_m: [...], measured.
            logged_m: [...], standard deviation in the log, 0 where there is no depth; None: the log has none.
        """
        if logged_m is not None:
            # any number will do where there is no depth
            return self.depth.factor * np.where(logged_m > 0, logged_m, 1.0).astype(np.float64)
        return self.depth.sigma_m(np.asarray(depth_m, dtype=np.float64))

    def depth_formula(self) -> str:
        """The depth noise in words, for the record."""
        if self.from_log:
            return f"{self.depth.factor:.6g} * sigma of the log"
        model = f"{self.depth.base_m:.6g} + {self.depth.quadratic_per_m:.6g} * (z - {NEAREST_M:g})^2"
        return f"{self.depth.factor:.6g} * ({model})"


def estimate_noise(views: MapViews, config: InformationConfig, *, every: int = 4) -> ImageNoise:
    """Noise from the residuals of the map's own renders: 1.4826 times the median absolute residual.

    Only pixels that the map covers (alpha above 0.9) count, in every `every`-th block of 4x4 px in both directions;
    such blocks are what the rasterizer can leave out. The residuals hold the map's errors in addition to the sensor's,
    so that a poor map does not claim to be certain. Depth residuals are taken in units of the configured sigma(z), and
    their spread is the factor on it. Without such pixels the color is at its floor and the factor is 1.

    Args:
        views: the map and its images.
        config: model of the depth noise and limits.
        every: of the blocks, in both directions.
    """
    camera, rasterizer = views.camera, views.rasterizer()
    model = DepthNoise.stated(config)
    unit = ImageNoise(1.0, model)
    colors, depths = [np.zeros(0)], [np.zeros(0)]
    sample = np.ix_(_in_blocks(camera.height, every), _in_blocks(camera.width, every))
    mask = np.zeros((camera.height, camera.width), bool)
    mask[sample] = True
    for image in views.images:
        usable = mask if image.mask is None else mask & image.mask  # alpha is 0 elsewhere: not covered
        render = views.draw(rasterizer, image, usable)
        alpha, z = render.alpha[sample].astype(np.float64), image.depth_m[sample].astype(np.float64)
        covered = alpha > 0.9
        difference = render.color[sample].astype(np.float64) - _colors(image)[sample]
        colors.append(SHELF.put(np.abs(difference[covered]).ravel()))
        both = covered & (z > 0)
        residual = render.depth[sample][both] / alpha[both] - z[both]
        logged_m = None if image.depth_sigma_m is None else image.depth_sigma_m[sample][both]
        depths.append(SHELF.put(np.abs(residual) / unit.depth_sigma_m(z[both], logged_m)))
    color_sigma = _spread(colors) or 0.0
    factor = 1.0
    if config.depth_factor_from_residuals and (spread := _spread(depths)) is not None:
        factor = float(np.clip(spread, config.depth_factor_min, config.depth_factor_max))
    return ImageNoise(
        color_sigma=max(color_sigma, config.color_sigma_floor),
        depth=replace(model, factor=factor),
        from_log=any(image.depth_sigma_m is not None for image in views.images),
    )


def _spread(parts: list[NDArray[np.float64]]) -> float | None:
    """Robust standard deviation of absolute residuals in parts, which are given up; None without any."""
    values = np.concatenate(parts)
    parts.clear()
    SHELF.sweep(heap=True)
    return MAD_TO_SIGMA * median_in_place(values) if len(values) else None


def _in_blocks(side_px: int, every: int) -> NDArray[np.int64]:
    """Pixels along a side of the image that lie in every `every`-th block of four."""
    pixels = np.arange(side_px)
    return pixels[pixels // 4 % every == every // 2]


def with_correlation(
    noise: ImageNoise, views: MapViews, config: InformationConfig
) -> tuple[ImageNoise, float]:
    """The noise with its pixels per sample, and how many Gaussians a pixel draws; from some of the images.

    Residuals of neighboring pixels are alike, because a map's errors are: n pixels are worth n / m independent ones,
    with m the sum of the residuals' autocorrelation over the window (the effective sample size of a mean). Residuals
    beyond four times their robust spread count as that much.

    Args:
        noise: of single pixels.
        views: the map and its images.
        config: reach of the correlation.
    """
    camera, rasterizer = views.camera, views.rasterizer()
    chosen = views.images[:: max(1, -(-len(views.images) // CORRELATION_VIEWS))]
    sums = {
        "color": _Autocorrelation(config.correlation_px),
        "depth": _Autocorrelation(config.correlation_px),
    }
    drawn = pixels = 0
    for image in chosen:
        render = views.draw(rasterizer, image, image.mask)
        drawn += rasterizer.statistics().blended_pairs
        pixels += camera.height * camera.width if image.mask is None else int(np.count_nonzero(image.mask))
        covered = render.alpha > 0.9
        color = (render.color.astype(np.float64) - _colors(image)).mean(axis=2)
        both = covered & (image.depth_m > 0)
        z = np.where(both, image.depth_m, 1.0).astype(np.float64)
        off = (render.depth / np.maximum(render.alpha, 0.9) - z) / noise.depth_sigma_m(z, image.depth_sigma_m)
        sums["color"].add(color, covered)
        sums["depth"].add(off, both)
    found = {name: autocorrelation.pixels_per_sample() for name, autocorrelation in sums.items()}
    changed = replace(noise, color_pixels=found["color"], depth_pixels=found["depth"])
    return changed, max(1.0, drawn / max(pixels, 1))


def _colors(image: PosedRgbd) -> NDArray[np.float64]:
    """RGB [H, W, 3] in the colors of the map."""
    return image.color / 255.0 if image.exposure is None else image.unit_color.astype(np.float64)


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
