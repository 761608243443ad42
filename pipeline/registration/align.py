"""Motion between two RGB-D views by joint point-to-plane and photometric Gauss-Newton.

For a sample p (reference frame) with normal n and intensity I, seen by the target at q = T_reference_target^-1 p,

    depth residual   r_d = m . (x z(u) - q),             m = R^T n, u = project(q), x the ray and z the depth there
    grey residual    r_g = gray(u) - (gain I + offset)   gain, offset: affine brightness between the views

are each divided by their noise, weighted by Huber's function at a scale from the median absolute deviation, and
minimised together over the right tangent (translation, rotation) of T_reference_target and (gain, offset), from
the coarsest pyramid level to the finest. Point-to-plane alone slides along walls, grey values alone know no scale;
together they hold all six directions (Steinbruecker et al. 2011; Kerl et al. 2013; Park et al. 2017).

Directions that the images do not determine (a bare wall) stay where the guess or its prior has them and carry zero
information (solution remapping: Zhang, Kaess and Singh 2016).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.config import Config
from pipeline.geometry import se3, so3
from pipeline.geometry.camera import PinholeCamera
from pipeline.registration.pyramid import Level, RgbdPyramid
from pipeline.registration.reference import Reference

Array = NDArray[np.float64]
Floats = NDArray[np.floating]

MAD_TO_SIGMA = 1.4826  # of a normal distribution
MAD_STRIDE = 4  # residuals between those that estimate a scale, where there are thousands
SETTLED = 4e-6  # m, rad: steps shrink by a third or more each, so less than half of the last one is left
SETTLED_COARSE = 4e-5  # the next level begins with an error of its own size anyway
GATE_SIGMAS = 3  # of depth whose noise is told: the gate is no narrower
TILES = (10, 8)  # columns and rows of the tiles over which correlated residuals are summed


class RegistrationConfig(Config):
    """Joint point-to-plane and photometric registration."""

    residuals: Literal["joint", "depth", "gray"] = "joint"
    """Which residuals count: both, point-to-plane only, or grey values only (for comparisons)."""
    iterations: tuple[int, ...] = (4, 5, 6)
    """Gauss-Newton steps per pyramid level, finest first."""
    depth_gate_m: float = 0.1
    """Smallest limit of the distance between a sample and the surface it falls on; farther ones do not count."""
    depth_gate_relative: float = 0.05
    """The same as a fraction of the depth; the larger limit holds."""
    normal_gate_rad: float = 0.0
    """Largest angle between the normals of a sample and of the surface it falls on; 0 = no test, the default, because
    normals of a structured-light camera scatter by more than any useful limit."""
    huber_sigmas: float = 1.5
    """Residuals beyond this many sigmas count linearly."""
    depth_sigma_base_m: float = 0.0012
    """Depth noise sigma(z) = base + slope * (z - 0.4)^2, where the log does not tell it pixel by pixel; only its shape
    counts, its scale is estimated."""
    depth_sigma_slope_per_m: float = 0.0019
    """See depth_sigma_base_m (Nguyen, Izadi and Lovell 2012)."""
    depth_sigma_floor: float = 0.05
    """Smallest estimated scale of the depth noise at the finest level, as a multiple of sigma(z). Four times more at
    each coarser one, where edges are blurred: without noise the depth would else outweigh the grey values so far
    that the way to the minimum becomes a narrow valley, which takes hundreds of steps."""
    gray_sigma_floor: float = 0.002
    """Smallest estimated noise of grey values (about half a step of 8 bits)."""
    gray_sigma_of_depth: float = 0.03
    """Smallest estimated noise of grey values as a multiple of the scale of the depth noise. A camera with poor depth
    also has depth registered to colour only to a pixel, and texture turns that pixel into a grey error that is the
    same in all frames; without this the many sharp grey values overrule the depth (RedKitchen: 2.7 cm, with it 2.3)."""
    min_gradient: float = 0.0
    """Grey gradient (1/px) below which a sample's grey value is not used."""
    min_samples: int = 100
    """Fewer agreeing samples are LOW_OVERLAP."""
    min_overlap: float = 0.3
    """Smaller overlap is LOW_OVERLAP."""
    max_conflict: float = 0.3
    """Largest fraction of seen samples that lie in space which the target saw to be free."""
    max_depth_scale: float = 8.0
    """Largest estimated scale of the depth noise, as a multiple of sigma(z); more is RESIDUAL."""
    max_gray_rms: float = 0.15
    """Largest weighted grey residual; more is RESIDUAL."""
    max_gain: float = 2.0
    """The gain must lie between 1 / max_gain and max_gain; else RESIDUAL (covered lens, other scene)."""
    max_sigma_m: float = 0.03
    """Directions with a larger standard deviation at the median depth are weak: they stay at the guess, or where the
    prior pulls them, and carry no information. The outcome is ILL_CONDITIONED unless the prior knows them better."""
    max_translation_m: float = 0.3
    """Largest correction of the guess; more is JUMP."""
    max_rotation_rad: float = 0.35
    """Largest correction of the guess; more is JUMP."""


class Outcome(Enum):
    """How a registration ended. Only OK may be used as a measurement."""

    OK = "ok"
    LOW_OVERLAP = "low_overlap"
    ILL_CONDITIONED = "ill_conditioned"
    RESIDUAL = "residual"
    JUMP = "jump"


@dataclass(frozen=True)
class Registration:
    """The motion between a reference and a target view.

    T_reference_target: [4, 4]. information: [6, 6], inverse covariance of its right tangent (translation m,
    rotation rad), zero if nothing was measured. overlap: fraction of the samples that the target sees on the same
    surface, of those it could tell. view: fraction of the samples inside the target image. conflict: fraction of
    the told samples that stand in free space. rms_depth_m, rms_gray: weighted residuals. exposure: (gain, offset)
    with target grey = gain * reference grey + offset. samples: how many agree. overstated: factor by which the
    normal matrix was divided to give the information. condition: ratio of the largest to the smallest eigenvalue
    of the information before weak directions were taken out, rotations scaled by the median depth. weak: [m, 6],
    directions in the right tangent that the images do not determine; the information is zero along them.
    """

    T_reference_target: Array
    information: Array
    outcome: Outcome
    overlap: float
    view: float
    conflict: float
    rms_depth_m: float
    rms_gray: float
    exposure: tuple[float, float]
    samples: int
    overstated: float
    condition: float
    weak: Array = field(default_factory=lambda: np.zeros((0, 6)))

    @property
    def ok(self) -> bool:
        """Whether the result may be used as a measurement."""
        return self.outcome is Outcome.OK

    def weak_names(self) -> list[str]:
        """The largest part of every weak direction in words, for example "translation x"."""
        names = [f"{kind} {axis}" for kind in ("translation", "rotation") for axis in "xyz"]
        return [names[int(np.argmax(np.abs(direction)))] for direction in self.weak]


@dataclass(frozen=True)
class _Residuals:
    """Weighted residuals of one kind; J float32 [n, 8] by (translation, rotation, gain, offset), r = value / noise."""

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

    def nothing(self) -> _Residuals:
        """The same kind and scale without any residual."""
        u, v = self.pixels
        return _Residuals(self.jacobian[:0], self.residual[:0], self.weight[:0], self.scale, (u[:0], v[:0]))

    def rms(self) -> float:
        """Root of the weighted mean square of the residuals, Huber's weight only, in units of the noise given."""
        if not len(self.residual):
            return 0.0
        w = self.weight.astype(np.float64)
        return float(np.sqrt(np.sum(w * self.residual.astype(np.float64) ** 2) / np.sum(w)))


@dataclass(frozen=True)
class _Linearisation:
    """Residuals at one pose and level, and what was seen of the samples."""

    depth: _Residuals
    gray: _Residuals
    overlap: float
    view: float
    conflict: float
    agreeing: int
    median_depth_m: float
    sigma_mean_m: float

    def normal_equations(self) -> tuple[Array, Array]:
        H_depth, g_depth = self.depth.normal_equations()
        H_gray, g_gray = self.gray.normal_equations()
        return H_depth + H_gray, g_depth + g_gray


def register(
    reference: Reference,
    pyramid: RgbdPyramid,
    T_reference_target_guess: Array,
    config: RegistrationConfig | None = None,
    prior_information: Array | None = None,
) -> Registration:
    """Register a target view to a reference.

    Args:
        reference: samples per level; at least as many levels as `pyramid`.
        pyramid: the target view. `without_depth`, grey values alone are used, and every sample inside the image
            counts as seen: overlap is then the view.
        T_reference_target_guess: where to start, [4, 4].
        config: limits and noise.
        prior_information: [6, 6] in the right tangent of the guess; pulls towards it, is not part of the
            information returned.
    Returns:
        The motion with an outcome; if that is not OK, the motion is the best found and must not be trusted.
    """
    config = config or RegistrationConfig()
    guess = _orthonormal(np.asarray(T_reference_target_guess, dtype=np.float64))
    T, exposure, system = _minimise(reference, pyramid, guess, config, prior_information, _ALL_DIRECTIONS)
    found = _Determined.by(system, config)
    if len(found.weak) and system.agreeing >= config.min_samples:
        # once more without the weak directions: what was found along them is noise
        T, exposure, system = _minimise(
            reference, pyramid, guess, config, prior_information, found.projection
        )
        found = _Determined.by(system, config).without(found)
    return _judge(system, found, T, guess, exposure, config, prior_information)


def linearise(
    reference: Reference,
    pyramid: RgbdPyramid,
    T_reference_target: Array,
    exposure: tuple[float, float] = (1.0, 0.0),
    config: RegistrationConfig | None = None,
    level: int = 0,
) -> Registration:
    """The cost of a pair near one pose, as a quadratic: for whoever minimises the costs of many pairs together.

    Args:
        reference, pyramid: as for `register`. level: the one that is used, 0 = finest.
        T_reference_target: where the cost is expanded. exposure: (gain, offset) there.
    Returns:
        Information at that pose, and the pose and exposure one Gauss-Newton step from it: the minimum of the
        quadratic. Along weak directions there is no step and no information. The outcome is that of `register`.
    """
    config = config or RegistrationConfig()
    T = _orthonormal(np.asarray(T_reference_target, dtype=np.float64))
    start = np.array(exposure)
    system = _linearise(reference, pyramid, level, T, start, config)
    found = _Determined.by(system, config)
    step = _step(system, T, T, None, found.projection)
    return _judge(system, found, T @ se3.exp(step[:6]), T, start + step[6:], config, None)


_ALL_DIRECTIONS = np.eye(6)


def _minimise(
    reference: Reference,
    pyramid: RgbdPyramid,
    guess: Array,
    config: RegistrationConfig,
    prior_information: Array | None,
    projection: Array,
) -> tuple[Array, Array, _Linearisation]:
    """Pose, (gain, offset) and residuals at the minimum, from the coarsest level to the finest.

    projection: [6, 6] P; the images count only along P x of a step x.
    """
    T, exposure = guess, np.array([1.0, 0.0])
    levels = min(len(pyramid.levels), len(config.iterations), len(reference.levels))
    for index in reversed(range(levels)):
        for _ in range(config.iterations[index]):
            system = _linearise(reference, pyramid, index, T, exposure, config)
            if system.agreeing < config.min_samples:
                break
            step = _step(system, T, guess, prior_information, projection)
            T = _orthonormal(T @ se3.exp(step[:6]))
            exposure = exposure + step[6:]
            if np.max(np.abs(step[:6])) < (SETTLED if index == 0 else SETTLED_COARSE):
                break
    return T, exposure, _linearise(reference, pyramid, 0, T, exposure, config)


def _orthonormal(T: Array) -> Array:
    """The same motion with an exact rotation: predictions from predictions would double the rounding every time."""
    return se3.from_rotation_translation(so3.project(T[:3, :3]), T[:3, 3])


def _step(
    system: _Linearisation, T: Array, guess: Array, prior_information: Array | None, projection: Array
) -> Array:
    """Gauss-Newton step [8], slightly damped, limited to 0.3 m and 0.3 rad."""
    H, gradient = system.normal_equations()
    if projection is not _ALL_DIRECTIONS:
        P = np.eye(8)
        P[:6, :6] = projection
        H, gradient = P.T @ H @ P, P.T @ gradient
    if prior_information is not None:
        H[:6, :6] += prior_information
        gradient[:6] += prior_information @ se3.log(se3.inverse(guess) @ T)
    # brightness is not observable on an untextured view: a weak pull keeps the system regular
    H[6:, 6:] += np.eye(2)
    step = -np.linalg.solve(_regular(H + 1e-6 * np.diag(np.diag(H))), gradient)
    if prior_information is None:
        step[:6] = projection @ step[:6]
    largest = np.max(np.abs(step[:6]))
    return np.asarray(step * min(1.0, 0.3 / largest) if largest > 0 else step)


def _regular(H: Array) -> Array:
    """A normal matrix that can be solved even where nothing was seen: then the answer stays near zero."""
    return H + (1e-10 * np.trace(H) / len(H) + 1e-300) * np.eye(len(H))


def _linearise(
    reference: Reference,
    pyramid: RgbdPyramid,
    index: int,
    T_reference_target: Array,
    exposure: Array,
    config: RegistrationConfig,
) -> _Linearisation:
    """Residuals of all samples of level `index` at one pose. Samples without a partner have none."""
    samples, level = reference.levels[index], pyramid.levels[index]
    camera = level.camera
    T_target_reference = se3.inverse(T_reference_target).astype(np.float32)
    q = T_target_reference[:3, :3] @ samples.points.T + T_target_reference[:3, 3:]
    front = np.maximum(q[2], np.float32(0.05))
    u = np.float32(camera.fx) * q[0] / front + np.float32(camera.cx)
    v = np.float32(camera.fy) * q[1] / front + np.float32(camera.cy)
    inside = (q[2] > 0.05) & (u >= 1) & (u < camera.width - 2) & (v >= 1) & (v < camera.height - 2)
    seen = np.flatnonzero(inside)
    q, u, v = q[:, seen], u[seen], v[seen]

    gray, gu, gv, inverse_depth, *told = _interpolate(level, u, v)
    with np.errstate(invalid="ignore"):
        # without a depth image every sample may be what is seen there
        z = 1 / inverse_depth if level.has_depth else q[2]
        gate = np.maximum(np.float32(config.depth_gate_m), np.float32(config.depth_gate_relative) * q[2])
        if told:
            gate = np.maximum(gate, np.float32(GATE_SIGMAS) * told[0])
        off = z - q[2]
        agree = np.abs(off) < gate
        # beyond the gate in front of the surface: that space was seen to be free; behind it: hidden
        free = off >= gate
    m = T_target_reference[:3, :3] @ samples.normals[seen].T
    if config.normal_gate_rad > 0:
        agree &= _normals_agree(level, u, v, m, config.normal_gate_rad)
    agreeing = np.flatnonzero(agree)
    conflicts, judged = int(free.sum()), int(np.isfinite(z).sum())
    total = len(samples) - (len(seen) - judged)

    q, m, u, v, z = q[:, agreeing], m[:, agreeing], u[agreeing], v[agreeing], z[agreeing]
    gray, gu, gv = gray[agreeing], gu[agreeing], gv[agreeing]
    intensities = samples.intensities[seen[agreeing]]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy]).astype(np.float32)
    surface = np.stack([rays[0] * z, rays[1] * z, z])
    sigma = _depth_sigma(z, config) if not told else told[0][agreeing]
    if (
        told and samples.depth_sigmas is not None
    ):  # of two views alike it stays the same, as that of the model
        sigma = np.sqrt(np.float32(0.5) * (sigma**2 + samples.depth_sigmas[seen[agreeing]] ** 2))
    floor = config.depth_sigma_floor * 4.0**index
    depth = _depth_residuals(surface, q, m, sigma, floor, (u, v), config)
    if not level.has_depth:
        depth = depth.nothing()
    floor = max(config.gray_sigma_floor, config.gray_sigma_of_depth * depth.scale)
    images = gray, gu, gv
    photometric = _gray_residuals(camera, images, intensities, q, exposure, floor, (u, v), config)
    return _Linearisation(
        depth.nothing() if config.residuals == "gray" else depth,
        photometric.nothing() if config.residuals == "depth" else photometric,
        overlap=len(agreeing) / max(total, 1),
        view=len(seen) / max(len(samples), 1),
        conflict=conflicts / max(judged, 1),
        agreeing=len(agreeing),
        median_depth_m=float(np.median(z)) if len(z) else 0.0,
        sigma_mean_m=float(sigma.mean(dtype=np.float64)) if len(z) else 0.0,
    )


def _interpolate(level: Level, u: Floats, v: Floats) -> tuple[Floats, ...]:
    """Grey value, its two derivatives, inverse depth (NaN where unknown) and sigma if known, at pixels inside."""
    width = level.camera.width
    u0, v0 = u.astype(np.int32), v.astype(np.int32)
    a, b = (u - u0)[:, None], (v - v0)[:, None]
    corner, channels = v0 * width + u0, level.channels
    top = channels.take(corner, axis=0)
    top += a * (channels.take(corner + 1, axis=0) - top)
    bottom = channels.take(corner + width, axis=0)
    bottom += a * (channels.take(corner + width + 1, axis=0) - bottom)
    top += b * (bottom - top)
    return tuple(np.ascontiguousarray(top.T))


def _normals_agree(
    level: Level, u: Floats, v: Floats, normals: Floats, limit_rad: float
) -> NDArray[np.bool_]:
    """Whether normals [3, n] are within the limit of the target's at the nearest pixels; unknown ones do not agree."""
    nearest = (v + np.float32(0.5)).astype(np.int32) * level.camera.width + (u + np.float32(0.5)).astype(
        np.int32
    )
    target = level.normals.reshape(-1, 3).take(nearest, axis=0)
    cosine = target[:, 0] * normals[0] + target[:, 1] * normals[1] + target[:, 2] * normals[2]
    return cosine > np.float32(np.cos(limit_rad))


def _depth_sigma(z: Floats, config: RegistrationConfig) -> Floats:
    """Noise of a depth z, metres, up to the scale that is estimated."""
    base, slope = np.float32(config.depth_sigma_base_m), np.float32(config.depth_sigma_slope_per_m)
    return base + slope * (z - np.float32(0.4)) ** 2


def _depth_residuals(
    surface: Floats,
    q: Floats,
    m: Floats,
    sigma: Floats,
    floor: float,
    pixels: tuple[Floats, Floats],
    config: RegistrationConfig,
) -> _Residuals:
    """Point-to-plane distance over sigma(z); derivative by the target's motion: m by v, surface x m by w."""
    J = np.zeros((len(sigma), 8), dtype=np.float32)
    J[:, 0], J[:, 1], J[:, 2] = m / sigma
    J[:, 3], J[:, 4], J[:, 5] = _cross(surface, m) / sigma
    residual = np.sum(m * (surface - q), axis=0) / sigma
    return _weighted(J, residual, floor, config.huber_sigmas, pixels)


def _gray_residuals(
    camera: PinholeCamera,
    images: tuple[Floats, Floats, Floats],
    intensities: Floats,
    q: Floats,
    exposure: Array,
    floor: float,
    pixels: tuple[Floats, Floats],
    config: RegistrationConfig,
) -> _Residuals:
    """Grey difference; dq = -v - w x q, so the derivative is -d by v and -(q x d) by w with d = d gray / d q."""
    gray, gu, gv = images
    if config.min_gradient > 0:
        keep = np.flatnonzero(gu * gu + gv * gv >= np.float32(config.min_gradient) ** 2)
        gray, gu, gv, intensities, q = gray[keep], gu[keep], gv[keep], intensities[keep], q[:, keep]
        pixels = (pixels[0][keep], pixels[1][keep])
    dx, dy = gu * np.float32(camera.fx) / q[2], gv * np.float32(camera.fy) / q[2]
    d = np.stack([dx, dy, -(dx * q[0] + dy * q[1]) / q[2]])
    J = np.empty((len(gray), 8), dtype=np.float32)
    J[:, 0], J[:, 1], J[:, 2] = -d
    J[:, 3], J[:, 4], J[:, 5] = -_cross(q, d)
    J[:, 6], J[:, 7] = -intensities, -1
    residual = gray - (np.float32(exposure[0]) * intensities + np.float32(exposure[1]))
    return _weighted(J, residual, floor, config.huber_sigmas, pixels)


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross products of vectors [3, n]."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _weighted(
    J: Floats, residual: Floats, floor: float, huber_sigmas: float, pixels: tuple[Floats, Floats]
) -> _Residuals:
    """Scale by the median absolute deviation, weights by Huber: w = 1 / (scale^2 max(1, |r| / (k scale)))."""
    magnitude = np.abs(residual)
    part = magnitude[::MAD_STRIDE] if len(magnitude) > 1000 * MAD_STRIDE else magnitude
    scale = max(MAD_TO_SIGMA * float(np.median(part)), floor) if len(residual) else floor
    weight = 1 / (
        np.maximum(np.float32(1), magnitude / np.float32(huber_sigmas * scale)) * np.float32(scale**2)
    )
    return _Residuals(J, residual, weight, scale, pixels)


@dataclass(frozen=True)
class _Determined:
    """What the residuals at one pose determine.

    information: [6, 6]. weak: [m, 6] directions that are not determined. projection: [6, 6], takes a tangent to its
    part along the other directions. sigma_m: of the weakest direction at the median depth, weak ones included.
    """

    information: Array
    weak: Array
    projection: Array
    overstated: float
    condition: float

    @staticmethod
    def by(system: _Linearisation, config: RegistrationConfig) -> _Determined:
        H, _ = system.normal_equations()
        overstated = _overstatement(system, H)
        # the brightness was estimated with the pose: its uncertainty is the pose's too (Schur complement)
        information = (H[:6, :6] - H[:6, 6:] @ np.linalg.solve(H[6:, 6:] + np.eye(2), H[6:, :6])) / overstated
        information = 0.5 * (information + information.T)
        lever = _lever(system)
        values, vectors = np.linalg.eigh(information * np.outer(lever, lever))
        known = values * config.max_sigma_m**2 >= 1
        strong, projection = vectors[:, known], _ALL_DIRECTIONS
        if not known.all():
            projection = (lever[:, None] * strong) @ (strong.T / lever)
            information = (strong * values[known]) @ strong.T / np.outer(lever, lever)
        weak = (vectors[:, ~known] * lever[:, None]).T
        weak = weak / np.linalg.norm(weak, axis=1, keepdims=True)
        condition = float(values[-1] / values[0]) if values[0] > 0 else float("inf")
        return _Determined(information, weak, projection, overstated, condition)

    def without(self, before: _Determined) -> _Determined:
        """The same with nothing known along the directions that were weak before."""
        P = before.projection
        information = P.T @ self.information @ P
        return replace(
            self,
            information=0.5 * (information + information.T),
            weak=before.weak,
            projection=P,
            condition=before.condition,
        )


def _lever(system: _Linearisation) -> Array:
    """Scales of the tangent [6] by which a rotation counts as the displacement at the median depth."""
    return np.array([1.0, 1.0, 1.0, *[1.0 / max(system.median_depth_m, 0.1)] * 3])


def _judge(
    system: _Linearisation,
    found: _Determined,
    T: Array,
    guess: Array,
    exposure: Array,
    config: RegistrationConfig,
    prior_information: Array | None,
) -> Registration:
    """Outcome and figures of the final pose."""
    lever = _lever(system)
    known = found.information if prior_information is None else found.information + prior_information
    weakest = float(np.linalg.eigvalsh(known * np.outer(lever, lever))[0])
    moved_m, turned_rad = se3.distance(guess, T)
    gain = exposure[0]
    if system.agreeing < config.min_samples or system.overlap < config.min_overlap:
        outcome = Outcome.LOW_OVERLAP
    elif (
        system.conflict > config.max_conflict
        or system.depth.scale > config.max_depth_scale
        or system.gray.rms() > config.max_gray_rms
        or not 1 / config.max_gain < gain < config.max_gain
    ):
        outcome = Outcome.RESIDUAL
    elif weakest * config.max_sigma_m**2 < 1 - 1e-9:
        outcome = Outcome.ILL_CONDITIONED
    elif moved_m > config.max_translation_m or turned_rad > config.max_rotation_rad:
        outcome = Outcome.JUMP
    else:
        outcome = Outcome.OK
    return Registration(
        T,
        found.information if system.agreeing >= config.min_samples else np.zeros((6, 6)),
        outcome,
        overlap=system.overlap,
        view=system.view,
        conflict=system.conflict,
        rms_depth_m=system.depth.rms() * system.sigma_mean_m,
        rms_gray=system.gray.rms(),
        exposure=(float(exposure[0]), float(exposure[1])),
        samples=system.agreeing,
        overstated=found.overstated,
        condition=found.condition,
        weak=found.weak,
    )


def _overstatement(system: _Linearisation, H: Array) -> float:
    """By which factor the normal matrix overstates the information, at least 1: the larger of two estimates.

    Correlation. Neighbouring residuals share noise, calibration and model errors. If they did not, the outer
    products of the gradients summed over image tiles would have the expectation H; their ratio to H, averaged over
    the eight directions, is the factor (cluster-robust covariance, reduced to one number so that weak directions
    stay weak).

    Tension. Depth and grey values, each alone, would put the target elsewhere; at the joint minimum their
    gradients g cancel, and chi^2 = g^T (H_depth^-1 + H_gray^-1) g, the squared distance between the two answers in
    units of their covariance, should be 6. What exceeds it is calibration error that no image noise explains
    (Birge ratio).
    """
    columns, rows = TILES
    parts = [part for part in (system.depth, system.gray) if len(part.residual)]
    if not parts:
        return 1.0
    u_max = max(float(part.pixels[0].max()) for part in parts) + 1
    v_max = max(float(part.pixels[1].max()) for part in parts) + 1
    outer, tension = np.zeros((8, 8)), 0.0
    for part in parts:
        u, v = part.pixels
        tile = (v * (rows / v_max)).astype(np.int64) * columns + (u * (columns / u_max)).astype(np.int64)
        scaled = part.jacobian * (part.weight * part.residual)[:, None]
        sums = np.stack([np.bincount(tile, scaled[:, k], rows * columns) for k in range(8)])
        outer = outer + sums @ sums.T
    for part in parts if len(parts) == 2 else []:
        H_part, gradient = part.normal_equations()
        answer = np.linalg.solve(_regular(H_part[:6, :6] + 1e-3 * H[:6, :6]), gradient[:6])
        tension += float(gradient[:6] @ answer)
    correlation = float(np.trace(np.linalg.solve(_regular(H), outer))) / 8
    return max(1.0, correlation, tension / 6)
