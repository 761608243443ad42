"""A time by which two motions of a camera differ, found from pairs of frames among which its velocity changes.

Both frames of a pair are registered to each other twice, by parts that were taken at different times: by color and by
depth, or by the upper and the lower half of the images. The two motions differ by

    log(T_first^-1 T_second) = time * rate + (1 - Ad) c,    Ad = adjoint of T_second_first,

where `rate` is known from the velocities, and c is the pose of one camera, or half, in the other, the same in all
pairs: cameras that are turned against each other, or a wrong lens, are no time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.config.motion_times import MotionTimeConfig
from duagc.pipeline.config.registration import RegistrationConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.statistics import CHI2_6_MEDIAN, evenly_spaced
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import RgbdLog
from duagc.pipeline.registration import Outcome

STEP_NS = 10_000_000  # in which a velocity is taken
LEVELS = 4  # of pyramids; the finest is left out
STRIDES = (4, 2, 1)
FARTHEST_NS = 700_000_000  # between the frames of a pair
MOST_OF_VIEW = 0.2  # of the width of the image that the view moves between them
TYPICAL_DEPTH_M = 2.0  # at which a translation counts as a motion of the view
MEASURED = (Outcome.OK, Outcome.ILL_CONDITIONED)  # directions that are not determined have no information
BY_COLOR = RegistrationConfig(residuals="gray")
BY_DEPTH = RegistrationConfig(residuals="depth")
FIRST_SIGMA_S = 1.0  # of a time of which nothing is known
ROUNDS = 20  # of reweighting
PARTS = 5  # of the log, each of which is left out once
CHANCE_SIGMAS = 2.0  # up to which a time may be chance


@dataclass(frozen=True)
class FoundTime:
    """A time by which motions differ.

    Attributes:
        time_s: the time.
        sigma_s: standard deviation: by what is left, or by how much it depends on parts of the log, if that is more.
    """

    time_s: float
    sigma_s: float

    @property
    def may_be_chance(self) -> bool:
        """Whether nothing at all may be there."""
        return abs(self.time_s) <= CHANCE_SIGMAS * self.sigma_s

    def is_certain(self, config: MotionTimeConfig) -> bool:
        """Whether it is well known, no chance, and long enough to matter.

        Args:
            config: of the estimate.
        """
        is_known = self.sigma_s <= config.most_sigma_s
        return is_known and abs(self.time_s) >= max(config.least_s, config.sigmas * self.sigma_s)


@dataclass(frozen=True)
class MotionDifference:
    """What two motions of a pair of frames differ by.

    Attributes:
        off: [6], right tangent of the second frame, less what the stamps say.
        by_time: [6], its derivative by the time that is sought, 1/s.
        by_cameras: [6, 6], its derivative by the pose of one camera in the other.
        information: [6, 6] of `off`.
    """

    off: Array
    by_time: Array
    by_cameras: Array
    information: Array


@dataclass(frozen=True)
class MovingView:
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

    def pose_of(self, other: MovingView) -> Array:
        """T_view_other [4, 4] of another view.

        Args:
            other: posed in the same map.
        """
        return np.asarray(se3.inverse(self.T_map_camera) @ other.T_map_camera)


def view_pairs(
    log: RgbdLog, parts: Sequence[Trajectory], count: int, quantile: float = 1.0
) -> Iterator[tuple[MovingView, MovingView]]:
    """Pairs of frames spread over a log, in order of time, between which the velocity changes most.

    Args:
        log: of the robot.
        parts: T_map_camera of the frames that were tracked; of every part that has a frame of its own.
        count: about how many.
        quantile: of the changes to the views near one, in that to which it is paired: 1: the largest.
    """
    views = [_views(log, part) for part in parts]
    total = max(sum(len(part) for part in views), 1)
    for part in views:
        share = min(-(-count * len(part) // total), len(part))
        for first in (part[k] for k in evenly_spaced(len(part), share)):
            second = _changed(first, part, log.camera.fx, MOST_OF_VIEW * log.camera.width, quantile=quantile)
            if second is not None:
                yield first, second


def has_sigma(log: RgbdLog) -> bool:
    """Whether the log has sigma of its depth, pixel by pixel: depth that was computed from images or sweeps.

    Args:
        log: of the robot.
    """
    first = next((k for k, (_, depth) in enumerate(log.pairing.pairs) if depth is not None), None)
    return first is not None and log.frame(first).depth_sigma is not None


def joint_information(first: Array, second: Array) -> Array:
    """Information [6, 6] of the difference of two motions, by that of each.

    Args:
        first: [6, 6].
        second: [6, 6].
    """
    both = np.linalg.pinv(first + second, rcond=1e-9, hermitian=True)
    information = first @ both @ second
    return np.asarray(0.5 * (information + information.T))


def change(T_first_second: Array, first: Array, second: Array) -> Array:
    """Change [..., 6] of a velocity from one view to another, right tangent of the second.

    Args:
        T_first_second: [..., 4, 4].
        first: [6], velocity of the first view.
        second: [..., 6], that of the second.
    """
    return np.asarray(second - se3.adjoint(se3.inverse(T_first_second)) @ first)


def estimated_time(found: Sequence[MotionDifference], config: MotionTimeConfig) -> FoundTime | None:
    """The time that differences tell; None if they are too few.

    Args:
        found: in order of time.
        config: of the estimate.
    """
    if len(found) < config.min_pairs:
        return None
    time_s, sigma_s = _solve(found, config)
    ends = [len(found) * k // PARTS for k in range(PARTS + 1)]
    without = [_solve([*found[:a], *found[b:]], config)[0] for a, b in pairwise(ends)]
    jackknife_s = float(np.sqrt((PARTS - 1) * np.var(without)))
    return FoundTime(time_s, max(sigma_s, jackknife_s))


def _views(log: RgbdLog, part: Trajectory) -> list[MovingView]:
    """Frames with depth, pose and velocity that are not held out."""
    motion, index_of = log.motion_along(part), {color: k for k, (color, _) in enumerate(log.pairing.pairs)}
    found = []
    for stamp, T in zip(part.stamps_ns.tolist(), part.poses, strict=True):
        index = index_of[stamp]
        if is_held_out(index) or log.pairing.pairs[index][1] is None:
            continue
        T_step = motion.between(stamp, stamp + STEP_NS)
        if T_step is not None:
            found.append(MovingView(index, stamp, T, se3.log(T_step) / (1e-9 * STEP_NS)))
    return found


def _changed(
    first: MovingView, views: Sequence[MovingView], focal_px: float, reach_px: float, *, quantile: float
) -> MovingView | None:
    """The view next to one, in time and place, in which the camera moves most differently; None if there is none."""
    near = [v for v in views if v is not first and abs(v.stamp_ns - first.stamp_ns) <= FARTHEST_NS]
    if not near:
        return None
    px = focal_px * np.array([*[1 / TYPICAL_DEPTH_M] * 3, 1.0, 1.0, 1.0])
    T = se3.inverse(first.T_map_camera) @ np.array([view.T_map_camera for view in near])
    velocities = np.array([view.velocity for view in near])
    changed = np.linalg.norm(px * change(T, first.velocity, velocities), axis=1)
    reached = (changed > 0) & (np.linalg.norm(px * se3.log(T), axis=1) <= reach_px)
    ranked = np.flatnonzero(reached)[np.argsort(-changed[reached], kind="stable")]
    return near[int(ranked[round((1 - quantile) * (len(ranked) - 1))])] if len(ranked) else None


def _solve(found: Sequence[MotionDifference], config: MotionTimeConfig) -> tuple[float, float]:
    """The time and its standard deviation by what is left, seconds; differences far off count little (Cauchy)."""
    prior = np.diag([FIRST_SIGMA_S**-2, *[config.cameras_m**-2] * 3, *[config.cameras_rad**-2] * 3])
    J = np.array([np.concatenate([d.by_time[:, None], d.by_cameras], axis=1) for d in found])
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
