"""The residuals of a registration at one pose: point-to-plane distances and gray differences with their weights.

What `compiled.linearize_at` sums up, to be read and to test against.

For a sample p (reference frame) with normal n and intensity I, seen by the target at q = T_reference_target^-1 p,

    depth residual   r_d = m . (x z(u) - q),             m = R^T n, u = project(q), x the ray and z the depth there
    gray residual    r_g = gray(u) - (gain I + offset)   gain, offset: affine brightness between the views

are each divided by their noise and weighted by Huber's function at a scale from the median absolute deviation.

A sample whose surface the target would see from behind has no partner: there it sees another surface, such as the
other side of a thin wall.

Depth that is poor may also be registered to color only to a pixel, so the scale of its residuals sets a floor of the
gray noise (`gray_floor_of_depth`).

An error of the depth of a sample moves q along the ray of the reference. With t the reference in the frame of the
target and p_z the depth of the sample, the gray value that it meets has the standard deviation
sigma_z |d gray / d q . t| / p_z, which `gray_noise_of_depth` adds to the noise of the gray residual (`_weighted`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.registration import RegistrationConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.depth_noise import DepthNoise
from duagc.pipeline.geometry.inverse_depth import chance_difference
from duagc.pipeline.geometry.projection import from_behind
from duagc.pipeline.geometry.statistics import huber_divisor, mad_sigma, median
from duagc.pipeline.kernels.alignment import TILE_COLUMNS, TILE_ROWS
from duagc.pipeline.registration.normal_equations import NormalEquations, SamplesSeen, System
from duagc.pipeline.registration.pyramid import Level, RgbdPyramid
from duagc.pipeline.registration.reference import Reference, ReferenceLevel

Floats = NDArray[np.floating]
Index = NDArray[np.int64]

MAD_STRIDE = 4  # residuals between those that estimate a scale
MAD_FROM = 1000 * MAD_STRIDE  # residuals up to which all estimate it
GATE_SIGMAS = 3  # of depth whose sigma is measured: the gate is no narrower


@dataclass(frozen=True)
class Residuals:
    """Weighted residuals of one kind.

    Attributes:
        jacobian: float32 [n, 8], by (translation, rotation, gain, offset).
        residual: [n], value over noise.
        weight: [n].
        scale: robust standard deviation of the residuals.
        pixels: columns and rows [n] in the target image.
    """

    jacobian: Floats
    residual: Floats
    weight: Floats
    scale: float
    pixels: tuple[Floats, Floats]

    def normal_equations(self) -> tuple[Array, Array]:
        """H [8, 8] and gradient [8], summed in double precision in the order of the samples."""
        J = self.jacobian.astype(np.float64)
        Jw = J * self.weight[:, None]
        return Jw.T @ J, Jw.T @ self.residual.astype(np.float64)

    def summed(self, u_max: float, v_max: float) -> NormalEquations:
        """Normal equations, with the gradient of every tile of the image.

        Args:
            u_max: largest column of a residual, px.
            v_max: largest row.
        """
        u, v = self.pixels
        row = (v * (TILE_ROWS / (v_max + 1))).astype(np.int64)
        tile = row * TILE_COLUMNS + (u * (TILE_COLUMNS / (u_max + 1))).astype(np.int64)
        forces = self.jacobian * (self.weight * self.residual)[:, None]
        tiles = [np.bincount(tile, forces[:, k], TILE_ROWS * TILE_COLUMNS) for k in range(8)]
        H, gradient = self.normal_equations()
        return NormalEquations(H, gradient, self.scale, len(self.residual), self.rms(), np.stack(tiles))

    def nothing(self) -> Residuals:
        """The same kind and scale without any residual."""
        u, v = self.pixels
        return Residuals(self.jacobian[:0], self.residual[:0], self.weight[:0], self.scale, (u[:0], v[:0]))

    def rms(self) -> float:
        """Root of the weighted mean square of the residuals, Huber's weight only, in units of the noise given."""
        if not len(self.residual):
            return 0.0
        w = self.weight.astype(np.float64)
        return float(np.sqrt(np.sum(w * self.residual.astype(np.float64) ** 2) / np.sum(w)))


@dataclass(frozen=True, kw_only=True)
class Linearization:
    """Residuals at one pose and level, and how the samples were seen.

    Attributes:
        depth: point-to-plane distances.
        gray: gray differences.
        seen: how the samples were seen.
    """

    depth: Residuals
    gray: Residuals
    seen: SamplesSeen

    def system(self) -> System:
        """What a registration needs of it."""
        parts = [part for part in (self.depth, self.gray) if len(part.residual)]
        u_max = max((float(part.pixels[0].max()) for part in parts), default=0.0)
        v_max = max((float(part.pixels[1].max()) for part in parts), default=0.0)
        depth, gray = (part.summed(u_max, v_max) for part in (self.depth, self.gray))
        return System(depth=depth, gray=gray, seen=self.seen)


def linearize_at(
    reference: Reference,
    pyramid: RgbdPyramid,
    index: int,
    T_reference_target: Array,
    *,
    exposure: Array,
    config: RegistrationConfig,
) -> Linearization:
    """Residuals of all samples of one level at one pose. Samples without a partner have none.

    Args:
        reference: the samples.
        pyramid: the target view.
        index: of the level.
        T_reference_target: [4, 4].
        exposure: (gain, offset), [2].
        config: gates and noise.
    """
    samples, level = reference.levels[index], pyramid.levels[index]
    camera = level.camera
    T_target_reference = se3.inverse(T_reference_target).astype(np.float32)
    q = _rotated(T_target_reference, samples.points.T) + T_target_reference[:3, 3:]
    front = np.maximum(q[2], np.float32(0.05))
    u = np.float32(camera.fx) * q[0] / front + np.float32(camera.cx)
    v = np.float32(camera.fy) * q[1] / front + np.float32(camera.cy)
    inside = (q[2] > 0.05) & (u >= 1) & (u < camera.width - 2) & (v >= 1) & (v < camera.height - 2)
    seen = np.flatnonzero(inside)
    q, u, v = q.take(seen, axis=1), u.take(seen), v.take(seen)

    gray, gu, gv, inverse_depth, *measured_sigma = _interpolate(level, u, v)
    with np.errstate(invalid="ignore"):
        # without a depth image every sample may be what is seen there, where the pixels may be used
        z = 1 / inverse_depth if level.has_depth else np.where(np.isnan(inverse_depth), inverse_depth, q[2])
        gate = np.maximum(np.float32(config.depth_gate_m), np.float32(config.depth_gate_relative) * q[2])
        if measured_sigma:
            gate = np.maximum(gate, np.float32(GATE_SIGMAS) * measured_sigma[0])
        off = z - q[2]
        agree = np.abs(off) < gate
        # what noise alone may explain says nothing
        by_chance = np.float32(chance_between(reference, pyramid)) * z * q[2]
        decided = agree | ~(np.abs(off) < by_chance)
        # beyond the gate in front of the surface: that space was seen to be free; behind it: hidden
        free = decided & (off >= gate)
    m = _rotated(T_target_reference, samples.normals.take(seen, axis=0).T)
    agree &= ~from_behind(q.T, m.T)
    if config.normal_gate_rad > 0:
        agree &= _normals_agree(level, u, v, m, limit_rad=config.normal_gate_rad)
    agreeing = np.flatnonzero(agree)
    conflicts, judged = int(free.sum()), int((decided & np.isfinite(z)).sum())
    total = len(samples) - (len(seen) - judged)

    q, m = q.take(agreeing, axis=1), m.take(agreeing, axis=1)
    u, v, z, gray, gu, gv = (each.take(agreeing) for each in (u, v, z, gray, gu, gv))
    intensities = samples.intensities.take(seen.take(agreeing))
    surface = np.empty((3, len(z)), dtype=np.float32)
    surface[0] = ((u - camera.cx) / camera.fx).astype(np.float32) * z
    surface[1] = ((v - camera.cy) / camera.fy).astype(np.float32) * z
    surface[2] = z
    sigma = measured_sigma[0][agreeing] if measured_sigma else DepthNoise.stated(config).sigma_m(z)
    if measured_sigma and samples.depth_sigmas is not None:
        # of two views alike it stays the same, as that of the model
        sigma = np.sqrt(np.float32(0.5) * (sigma**2 + samples.depth_sigmas[seen[agreeing]] ** 2))
    floor = config.depth_sigma_floor * 4.0**index
    depth = _depth_residuals(surface, q, m, sigma, floor=floor, pixels=(u, v), config=config)
    if not level.has_depth:
        depth = depth.nothing()
    floor = max(config.gray_sigma_floor, gray_floor_of_depth(reference, pyramid, config) * depth.scale)
    images = gray, gu, gv
    by_depth = None
    if config.gray_noise_of_depth:
        ours = seen[agreeing]
        by_depth = _displacement(samples, ours, T_target_reference[:3, 3], scale=depth.scale, config=config)
    photometric = _gray_residuals(
        camera,
        images,
        intensities,
        q,
        by_depth=by_depth,
        exposure=exposure,
        floor=floor,
        pixels=(u, v),
        config=config,
    )
    return Linearization(
        depth=depth.nothing() if config.residuals == "gray" else depth,
        gray=photometric.nothing() if config.residuals == "depth" else photometric,
        seen=SamplesSeen(
            overlap=len(agreeing) / max(total, 1),
            view=len(seen) / max(len(samples), 1),
            conflict=conflicts / max(judged, 1),
            agreeing=len(agreeing),
            median_depth_m=median(z) if len(z) else 0.0,
            sigma_mean_m=float(sigma.mean(dtype=np.float64)) if len(z) else 0.0,
        ),
    )


def chance_between(reference: Reference, pyramid: RgbdPyramid) -> float:
    """By how much inverse depths of one surface differ at most by their noise in two views, 1/m.

    Args:
        reference: of one view; of unknown noise: that of the other one counts for both.
        pyramid: of the other view.
    """
    sigma, other = pyramid.inverse_depth_sigma, reference.inverse_depth_sigma
    return chance_difference(sigma, sigma if other is None else other)


def gray_floor_of_depth(reference: Reference, pyramid: RgbdPyramid, config: RegistrationConfig) -> float:
    """Smallest noise of gray values, as a multiple of the scale of the residuals of depth.

    Where noise of the inverse depth exceeds the gate of depth, that scale shows this noise alone: of what is
    configured there is the share of the samples that lie elsewhere. Where a log states the noise, gates follow it.

    Args:
        reference: the samples; those of the coarsest level are asked.
        pyramid: the target view.
        config: gates, and the multiple.
    """
    z, share = reference.levels[-1].points[:, 2], 1.0
    if len(z) and pyramid.levels[0].depth_sigma_m is None:
        gate = np.maximum(config.depth_gate_m, config.depth_gate_relative * z)
        share = float(np.mean(chance_between(reference, pyramid) * np.square(z) < gate))
    return config.gray_sigma_of_depth * reference.contrast * share


def _rotated(T: Floats, vectors: Floats) -> Floats:
    """Vectors [3, n], rotated."""
    x, y, z = vectors
    return np.stack([T[k, 0] * x + T[k, 1] * y + T[k, 2] * z for k in range(3)])


def _channels(level: Level) -> Floats:
    """(gray, d/du, d/dv, inverse depth or NaN, and sigma where known) for interpolation, [h * w, 4 or 5].

    NaN makes every value that touches an unknown depth unknown, and fails every gate.
    """
    depths = level.usable_inverse_depth
    sigma = [] if level.depth_sigma_m is None else [level.depth_sigma_m]
    known = np.where(depths > 0, depths, np.float32(np.nan))
    return np.stack([level.gray, *level.gradients, known, *sigma], axis=-1).reshape(-1, 4 + len(sigma))


def _interpolate(level: Level, u: Floats, v: Floats) -> tuple[Floats, ...]:
    """Gray value, its two derivatives, inverse depth (NaN where unknown) and sigma if known, at pixels inside."""
    width = level.camera.width
    u0, v0 = u.astype(np.int32), v.astype(np.int32)
    a, b = ((pixel - corner.astype(np.float32))[:, None] for pixel, corner in ((u, u0), (v, v0)))
    corner, channels = v0 * width + u0, _channels(level)
    top = channels.take(corner, axis=0)
    top += a * (channels.take(corner + 1, axis=0) - top)
    bottom = channels.take(corner + width, axis=0)
    bottom += a * (channels.take(corner + width + 1, axis=0) - bottom)
    top += b * (bottom - top)
    return tuple(np.ascontiguousarray(top.T))


def _normals_agree(
    level: Level, u: Floats, v: Floats, normals: Floats, *, limit_rad: float
) -> NDArray[np.bool_]:
    """Whether normals [3, n] are within the limit of the target's at the nearest pixels; unknown ones do not agree."""
    nearest = (v + np.float32(0.5)).astype(np.int32) * level.camera.width + (u + np.float32(0.5)).astype(
        np.int32
    )
    target = level.normals.reshape(-1, 3).take(nearest, axis=0)
    cosine = target[:, 0] * normals[0] + target[:, 1] * normals[1] + target[:, 2] * normals[2]
    return cosine > np.float32(np.cos(limit_rad))


def _depth_residuals(
    surface: Floats,
    q: Floats,
    m: Floats,
    sigma: Floats,
    *,
    floor: float,
    pixels: tuple[Floats, Floats],
    config: RegistrationConfig,
) -> Residuals:
    """Point-to-plane distance over sigma(z); derivative by the target's motion: m by v, surface x m by w."""
    J = np.zeros((len(sigma), 8), dtype=np.float32)
    J[:, 0], J[:, 1], J[:, 2] = m / sigma
    J[:, 3], J[:, 4], J[:, 5] = _cross(surface, m) / sigma
    residual = np.sum(m * (surface - q), axis=0) / sigma
    return _weighted(J, residual, floor=floor, huber_sigmas=config.huber_sigmas, pixels=pixels)


def _displacement(
    samples: ReferenceLevel, index: Index, t: Floats, *, scale: float, config: RegistrationConfig
) -> Floats:
    """How far samples lie from where the target sees them by one sigma of their depth, [3, n], but for their own rays.

    The scale of the depth residuals holds the noise of both views, so half of its square is the sample's.
    """
    z = samples.points[index, 2]
    sigma = (
        DepthNoise.stated(config).sigma_m(z) if samples.depth_sigmas is None else samples.depth_sigmas[index]
    )
    return -t[:, None] * (np.float32(scale * np.sqrt(0.5)) * sigma / z)


def _gray_residuals(
    camera: PinholeCamera,
    images: tuple[Floats, Floats, Floats],
    intensities: Floats,
    q: Floats,
    *,
    by_depth: Floats | None,
    exposure: Array,
    floor: float,
    pixels: tuple[Floats, Floats],
    config: RegistrationConfig,
) -> Residuals:
    """Gray difference; dq = -v - w x q, so the derivative is -d by v and -(q x d) by w with d = d gray / d q."""
    gray, gu, gv = images
    if config.min_gradient > 0:
        keep = np.flatnonzero(gu * gu + gv * gv >= np.float32(config.min_gradient) ** 2)
        gray, gu, gv, intensities = (each.take(keep) for each in (gray, gu, gv, intensities))
        q, pixels = q.take(keep, axis=1), (pixels[0].take(keep), pixels[1].take(keep))
        by_depth = None if by_depth is None else by_depth.take(keep, axis=1)
    dx, dy = gu * np.float32(camera.fx) / q[2], gv * np.float32(camera.fy) / q[2]
    d = np.stack([dx, dy, -(dx * q[0] + dy * q[1]) / q[2]])
    J = np.empty((len(gray), 8), dtype=np.float32)
    J[:, 0], J[:, 1], J[:, 2] = -d
    J[:, 3], J[:, 4], J[:, 5] = -_cross(q, d)
    J[:, 6], J[:, 7] = -intensities, -1
    residual = gray - (np.float32(exposure[0]) * intensities + np.float32(exposure[1]))
    known = None if by_depth is None else np.sum(d * by_depth, axis=0) ** 2
    return _weighted(
        J, residual, floor=floor, huber_sigmas=config.huber_sigmas, pixels=pixels, known_variance=known
    )


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross products of vectors [3, n]."""
    out = np.empty_like(a)
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.multiply(a[i], b[j], out=out[k])
        out[k] -= a[j] * b[i]
    return out


def _weighted(
    J: Floats,
    residual: Floats,
    *,
    floor: float,
    huber_sigmas: float,
    pixels: tuple[Floats, Floats],
    known_variance: Floats | None = None,
) -> Residuals:
    """Scale by the median absolute deviation, weights by Huber: w = 1 / (scale^2 max(1, |r| / (k scale))).

    Where a part of every residual's variance is known [n], the median of it is taken from the square of the scale, to
    no less than the floor, and its own part is added to that for each residual.
    """
    magnitude = np.abs(residual)
    part = magnitude[::MAD_STRIDE] if len(magnitude) > MAD_FROM else magnitude
    scale = max(mad_sigma(part), floor) if len(residual) else floor
    if known_variance is None or not len(residual):
        weight = 1 / (huber_divisor(magnitude, np.float32(huber_sigmas * scale)) * np.float32(scale**2))
    else:
        rest = max(scale**2 - median(known_variance), floor**2)
        variance = np.float32(rest) + known_variance
        weight = 1 / (huber_divisor(magnitude, np.float32(huber_sigmas) * np.sqrt(variance)) * variance)
    return Residuals(J, residual, weight, scale, pixels)
