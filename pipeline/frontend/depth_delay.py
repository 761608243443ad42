"""How much earlier than its stamps say depth was taken, by the motions that color and depth see for themselves.

Two frames are registered by color alone, and by depth alone. With a delay d the depth of each is what the camera saw d
before. Where the camera has the velocities v and w (right tangents per second), the two motions then differ by

    log(T_color^-1 T_depth) = d (Ad v - w) + (1 - Ad) c,    Ad = adjoint of T_second_first,

c being the pose of the depth camera in the color camera, the same in all frames. So a delay shows between frames among
which the velocity changes, and cameras that are turned against each other are no delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.config.frontend import DelayConfig
from duagc.pipeline.config.registration import RegistrationConfig
from duagc.pipeline.frontend.frame_images import pyramid_of
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import RgbdLog
from duagc.pipeline.recording.moved_depth import DepthMotion
from duagc.pipeline.registration import Outcome, Reference, RgbdPyramid, register

STEP_NS = 10_000_000  # in which a velocity is taken
LEVELS = 4  # of pyramids; the finest is left out
STRIDES = (4, 2, 1)
FARTHEST_NS = 700_000_000  # between the frames of a pair
MOST_OF_VIEW = 0.2  # of the width of the image that the view moves between them
TYPICAL_DEPTH_M = 2.0  # at which a translation counts as a motion of the view
MEASURED = (Outcome.OK, Outcome.ILL_CONDITIONED)  # directions that are not determined have no information
BY_COLOR = RegistrationConfig(residuals="gray")
BY_DEPTH = RegistrationConfig(residuals="depth")
FIRST_SIGMA_S = 1.0  # of a delay of which nothing is known
CHI2_6_MEDIAN = 5.348  # median of chi^2 with 6 degrees of freedom
ROUNDS = 20  # of reweighting
PARTS = 5  # of the log, each of which is left out once


@dataclass(frozen=True)
class Delay:
    """A delay of depth.

    Attributes:
        delay_s: how much earlier than its stamps say it was taken.
        sigma_s: standard deviation: by what is left, or by how much it depends on parts of the log, if that is more.
    """

    delay_s: float
    sigma_s: float


@dataclass(frozen=True)
class MotionDifference:
    """What the motion of a pair of frames by depth differs from that by color.

    Attributes:
        off: [6], right tangent of the second frame, less what the stamps say.
        by_delay: [6], its derivative by the delay, 1/s.
        by_cameras: [6, 6], its derivative by the pose of the depth camera in the color camera.
        information: [6, 6] of `off`.
    """

    off: Array
    by_delay: Array
    by_cameras: Array
    information: Array


@dataclass(frozen=True)
class _View:
    """A frame with its pose and velocity.

    Attributes:
        index: in the log.
        stamp_ns: its time.
        T_map_camera: [4, 4].
        velocity: [6], right tangent, 1/s.
    """

    index: int
    stamp_ns: int
    T_map_camera: Array
    velocity: Array


def certain_delay_ns(log: RgbdLog, parts: Sequence[Trajectory], config: DelayConfig) -> int:
    """The delay of a log's depth if it is certain, and long enough to matter; else 0.

    A log that has sigma of every depth computed it from images or sweeps: its errors look alike in views that are near
    each other, which passes for a delay, and a stereo pair has none.

    Args:
        log: its depth as it was taken.
        parts: T_map_camera of the frames that were tracked; of every part that has a frame of its own.
        config: of the estimate.
    """
    if not config.enabled or _has_sigma(log):
        return 0
    found = estimated_delay(differences(log, parts, config), config)
    if found is None or abs(found.delay_s) < max(config.least_s, config.sigmas * found.sigma_s):
        return 0
    return round(1e9 * found.delay_s)


def _has_sigma(log: RgbdLog) -> bool:
    """Whether the log has sigma of its depth, pixel by pixel."""
    first = next(k for k, (_, depth) in enumerate(log.pairing.pairs) if depth is not None)
    return log.frame(first).depth_sigma is not None


def estimated_delay(found: Sequence[MotionDifference], config: DelayConfig) -> Delay | None:
    """The delay that differences tell; None if they are too few.

    Args:
        found: in order of time.
        config: of the estimate.
    """
    if len(found) < config.min_pairs:
        return None
    delay_s, sigma_s = _solve(found, config)
    ends = [len(found) * k // PARTS for k in range(PARTS + 1)]
    without = [_solve([*found[:a], *found[b:]], config)[0] for a, b in pairwise(ends)]
    jackknife_s = float(np.sqrt((PARTS - 1) * np.var(without)))
    return Delay(delay_s, max(sigma_s, jackknife_s))


def differences(log: RgbdLog, parts: Sequence[Trajectory], config: DelayConfig) -> list[MotionDifference]:
    """Differences between motions by depth and by color, of pairs of frames spread over a log.

    Args:
        log: its depth as it was taken.
        parts: T_map_camera of the frames that were tracked; of every part that has a frame of its own.
        config: of the estimate.
    """
    views = [_views(log, part) for part in parts]
    total, found = max(sum(len(part) for part in views), 1), []
    for part in views:
        share = min(-(-config.pairs * len(part) // total), len(part))
        for first in (part[k] for k in evenly_spaced(len(part), share)):
            second = _changed(first, part, log.camera.fx, MOST_OF_VIEW * log.camera.width)
            if second is not None and (difference := _difference(log, first, second)) is not None:
                found.append(difference)
    return found


def _views(log: RgbdLog, part: Trajectory) -> list[_View]:
    """Frames with depth, pose and velocity that are not held out."""
    motion, index_of = DepthMotion(part), {color: k for k, (color, _) in enumerate(log.pairing.pairs)}
    found = []
    for stamp, T in zip(part.stamps_ns.tolist(), part.poses, strict=True):
        index = index_of[stamp]
        if is_held_out(index) or log.pairing.pairs[index][1] is None:
            continue
        T_step = motion.between(stamp, stamp + STEP_NS)
        if T_step is not None:
            found.append(_View(index, stamp, T, se3.log(T_step) / (1e-9 * STEP_NS)))
    return found


def _changed(first: _View, views: Sequence[_View], focal_px: float, reach_px: float) -> _View | None:
    """The view next to one, in time and place, in which the camera moves most differently; None if there is none."""
    px = focal_px * np.array([*[1 / TYPICAL_DEPTH_M] * 3, 1.0, 1.0, 1.0])
    best, most = None, 0.0
    for second in views:
        if second is first or abs(second.stamp_ns - first.stamp_ns) > FARTHEST_NS:
            continue
        T = se3.inverse(first.T_map_camera) @ second.T_map_camera
        change = float(np.linalg.norm(px * _change(T, first, second)))
        if change > most and np.linalg.norm(px * se3.log(T)) <= reach_px:
            best, most = second, change
    return best


def _change(T_first_second: Array, first: _View, second: _View) -> Array:
    """Change [6] of the velocity from one view to another, right tangent of the second."""
    return np.asarray(se3.adjoint(se3.inverse(T_first_second)) @ first.velocity - second.velocity)


def _difference(log: RgbdLog, first: _View, second: _View) -> MotionDifference | None:
    """The difference of a pair; None if either motion cannot be found."""
    seen, other = (_half_size(log, view.index) for view in (first, second))
    reference, T_start = (
        Reference.from_pyramid(seen, STRIDES),
        se3.inverse(first.T_map_camera) @ second.T_map_camera,
    )
    by_color = register(reference, other.without_depth(), T_start, BY_COLOR)
    by_depth = register(reference, other, T_start, BY_DEPTH)
    if by_color.outcome not in MEASURED or by_depth.outcome not in MEASURED:
        return None
    T = by_color.T_reference_target
    Ad = se3.adjoint(se3.inverse(T))
    late_s = [1e-9 * log.frame_offset_ns(view.index) for view in (first, second)]
    stated = second.velocity * late_s[1] - Ad @ first.velocity * late_s[0]
    both = np.linalg.pinv(by_color.information + by_depth.information, rcond=1e-9, hermitian=True)
    information = by_color.information @ both @ by_depth.information
    return MotionDifference(
        se3.log(se3.inverse(T) @ by_depth.T_reference_target) - stated,
        _change(T, first, second),
        np.eye(6) - Ad,
        0.5 * (information + information.T),
    )


def _half_size(log: RgbdLog, index: int) -> RgbdPyramid:
    return RgbdPyramid(pyramid_of(log.frame(index), log.camera, LEVELS).levels[1:])


def _solve(found: Sequence[MotionDifference], config: DelayConfig) -> tuple[float, float]:
    """Delay and its standard deviation by what is left, seconds; differences far off count little (Cauchy)."""
    prior = np.diag([FIRST_SIGMA_S**-2, *[config.cameras_m**-2] * 3, *[config.cameras_rad**-2] * 3])
    J = np.array([np.concatenate([d.by_delay[:, None], d.by_cameras], axis=1) for d in found])
    off, W = np.array([d.off for d in found]), np.array([d.information for d in found])
    H, x = prior, np.zeros(7)
    for _ in range(ROUNDS):
        left = off - J @ x
        chi2 = np.einsum("ki,kij,kj->k", left, W, left)
        scale = max(float(np.median(chi2)) / CHI2_6_MEDIAN, 1e-9)
        weighted = np.swapaxes(J, 1, 2) @ W / (scale + chi2 / 6)[:, None, None]
        H = (weighted @ J).sum(axis=0) + prior
        x = np.linalg.solve(H, (weighted @ off[..., None]).sum(axis=0)[:, 0])
    return float(x[0]), float(np.sqrt(np.linalg.inv(H)[0, 0]))
