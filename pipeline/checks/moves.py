"""Pairs of frames of a log, each registered, and the depth of one moved into the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.checks import MotionChecks
from duagc.pipeline.config.frontend import RelocalizationConfig
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.frontend.current_frame import features_of
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import visible
from duagc.pipeline.recording import RgbdLog
from duagc.pipeline.registration import Reference, Registration, RgbdPyramid, register
from duagc.pipeline.registration.feature_motion import motion_from_features
from duagc.pipeline.registration.features import Features

Image = NDArray[np.float32]

FEATURES = RelocalizationConfig()
"""How features are found and matched: as those of frames whose motion is not predicted."""
WEAK_SHARE = 0.1  # of a direction of motion that the images do not determine


@dataclass(frozen=True)
class Move:
    """A pair of frames.

    Attributes:
        first_ns: time of the first frame.
        second_ns: time of the second frame.
        T_first_second: [4, 4], by registration; None if that failed.
        residual: median difference of depth moved into the other frame, relative.
        sigma_m: standard deviation of the length of the translation, by the covariance of the registration.
        turned_rad: angle of the rotation.
        depth_m: median depth of the first frame.
        depth_rms_m: weighted depth residual of the registration.
        depth_offset_ns: the larger of the two times between color and depth.
        residual_as_range: as `residual`, if depth were the distance along the ray; NaN if that does not register.
    """

    first_ns: int
    second_ns: int
    T_first_second: Array | None
    residual: float = np.nan
    sigma_m: float = 0.0
    turned_rad: float = 0.0
    depth_m: float = 0.0
    depth_rms_m: float = 0.0
    depth_offset_ns: int = 0
    residual_as_range: float = np.nan

    @property
    def speed_m_s(self) -> float:
        """Of the translation; NaN if the registration failed."""
        if self.T_first_second is None:
            return np.nan
        return float(np.linalg.norm(self.T_first_second[:3, 3]) / ((self.second_ns - self.first_ns) * 1e-9))


def moves(log: RgbdLog, config: MotionChecks, *, as_range: bool = False) -> list[Move]:
    """Pairs of frames spread over the log, each registered and the depth of one moved into the other.

    Args:
        log: of a robot.
        config: how many pairs, and how far apart.
        as_range: register each once more as if depth were the distance along the ray.
    """
    frames = _with_depth_of_their_own(log)
    stamps = np.array([log.pairing.pairs[index][0] for index in frames], dtype=np.int64)
    found = []
    last = len(stamps) - 1
    for first in np.unique(np.linspace(0, last - 1, min(config.pairs, last)).astype(int)).tolist():
        near = int(np.searchsorted(stamps, stamps[first] + round(1e9 * config.pair_s), side="right")) - 1
        view, following = _View(log, frames[first]), _View(log, frames[first + 1])
        move = _move(view, following, as_range=as_range, T_guess=_matched(view, following))
        if near > first + 1:
            farther = _View(log, frames[near])
            T_guess = _matched(view, farther)
            if T_guess is None:
                T_guess = _extrapolated(move, farther.frame.stamp_ns)
            moved = _move(view, farther, as_range=as_range, T_guess=T_guess)
            move = move if moved.T_first_second is None else moved
        found.append(move)
    return found


class _View:
    """A frame of a pair, its pyramid and its features; these are made when they are first needed."""

    def __init__(self, log: RgbdLog, index: int) -> None:
        self.camera, self.frame = log.camera, log.frame(index)

    def pyramid_of(self, depth_m: Image) -> RgbdPyramid:
        """With some depth [h, w], meters along z."""
        frame = self.frame
        return RgbdPyramid.build(
            frame.color.astype(np.float32) / 255,
            depth_m,
            self.camera,
            depth_sigma_m=frame.depth_sigma,
            mask=frame.mask,
        )

    @cached_property
    def pyramid(self) -> RgbdPyramid:
        return self.pyramid_of(self.frame.usable_depth)

    @cached_property
    def features(self) -> Features:
        return features_of(self.pyramid, FEATURES)


def _matched(first: _View, second: _View) -> Array | None:
    """The motion [4, 4] that features agree on, which need no prediction; None: on none."""
    # the draws only choose which samples are tried: the same for every pair
    rng = random_streams.generator(0, "checks.moves")
    return motion_from_features(first.features, second.features, FEATURES, rng).accepted_motion


def _extrapolated(move: Move, to_ns: int) -> Array:
    """Where a camera would be that goes on as it moved: a plane with little texture has many minima farther away."""
    if move.T_first_second is None:
        return np.eye(4)
    times = (to_ns - move.first_ns) / (move.second_ns - move.first_ns)
    return se3.exp(times * se3.log(move.T_first_second))


def _with_depth_of_their_own(log: RgbdLog) -> list[int]:
    """Indices of frames, of those that share a depth image the nearest to it in time: of one image nothing moves."""
    nearest: dict[int, tuple[int, int]] = {}
    for index, (color_ns, depth_ns) in enumerate(log.pairing.pairs):
        if depth_ns is not None:
            here = abs(depth_ns - color_ns), index
            nearest[depth_ns] = min(nearest.get(depth_ns, here), here)
    return sorted(index for _, index in nearest.values())


def _move(first: _View, second: _View, *, as_range: bool, T_guess: Array | None) -> Move:
    T_guess = np.eye(4) if T_guess is None else T_guess
    result = register(Reference.from_pyramid(first.pyramid), second.pyramid, T_guess)
    stamps_ns = first.frame.stamp_ns, second.frame.stamp_ns
    if not result.ok:
        return Move(*stamps_ns, None)
    T, depths = result.T_reference_target, (first.frame.usable_depth, second.frame.usable_depth)
    known = depths[0] > 0
    return Move(
        *stamps_ns,
        T,
        residual=_moved(*depths, T, first.camera),
        sigma_m=_length_sigma_m(result),
        turned_rad=float(se3.distance(np.eye(4), T)[1]),
        depth_m=float(np.median(depths[0][known])) if known.any() else 0.0,
        depth_rms_m=result.rms_depth_m,
        depth_offset_ns=max(abs(first.frame.depth_offset_ns), abs(second.frame.depth_offset_ns)),
        residual_as_range=_residual_as_range(first, second, T_guess) if as_range else np.nan,
    )


def _residual_as_range(first: _View, second: _View, T_guess: Array) -> float:
    """`Move.residual` if depth were the distance along the ray; NaN if that does not register."""
    lengths = first.camera.ray_lengths().astype(np.float32)
    along_z = first.frame.usable_depth / lengths, second.frame.usable_depth / lengths
    a, b = first.pyramid_of(along_z[0]), second.pyramid_of(along_z[1])
    result = register(Reference.from_pyramid(a), b, T_guess)
    return _moved(*along_z, result.T_reference_target, first.camera) if result.ok else np.nan


def _length_sigma_m(result: Registration) -> float:
    """Standard deviation of the length of a translation; infinite where a direction of it was not measured."""
    along = np.zeros(6)
    along[:3] = result.T_reference_target[:3, :3].T @ result.T_reference_target[:3, 3]
    along /= max(float(np.linalg.norm(along)), 1e-12)
    if len(result.weak) and np.abs(result.weak @ along).max() > WEAK_SHARE:
        return float("inf")
    variance = float(along @ np.linalg.pinv(result.information) @ along)
    return float(np.sqrt(max(variance, 0.0)))


def _moved(first_m: Image, second_m: Image, T_first_second: Array, camera: PinholeCamera) -> float:
    """Median relative difference of depth moved into the second frame; NaN if it shows nothing of the first."""
    points = camera.back_project(first_m)[::4, ::4].reshape(-1, 3)
    points = points[points[:, 2] > 0]
    moved = se3.transform(se3.inverse(T_first_second), points)
    index, u, v = visible(camera, moved, near_m=0.0)
    expected, found = moved[index, 2], second_m[v, u]
    both = found > 0
    return float(np.median(np.abs(found - expected)[both] / expected[both])) if both.any() else np.nan


def has_exact_depth(found: Sequence[Move], config: MappingConfig) -> bool:
    """Whether maps will be made for exact depth, as far as some pairs of frames tell.

    Args:
        found: the pairs.
        config: of the maps.
    """
    measured = [move for move in found if move.T_first_second is not None and move.depth_rms_m > 0]
    if not measured:
        return config.depth_kind(None) == "ray_plane"
    noise_m, depth_m = np.median([(move.depth_rms_m, move.depth_m) for move in measured], axis=0).tolist()
    return config.depth_kind(noise_m, depth_m) == "ray_plane"
