"""How long the images of a log are read, row after row, where it does not state it: by motions that halves of them see.

Two frames are registered by the upper half of the first one alone, and by the lower half alone; by color for the color
camera, by depth for the depth camera. If that shows nothing, by the left and the right half: a camera that is turned
reads column after column. With a readout r the rows of a half were taken r a after the middle of the first
image, a its mean place from -1/2 to 1/2, and their points r b after that of the second. Where the camera has the
velocities v and w (right tangents per second), the two motions then differ by r (db w - da Ad v), db and da being
the differences of b and a between the halves (`motion_differences`). Where the velocity does not change, a readout
cannot be distinguished from another lens, and harms as little.

In images that what was found has made still, what is left is looked for again, until it may be chance: where rows
move far, the path that was tracked in rolling images bends with them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.config.motion_times import ReadoutConfig
from duagc.pipeline.config.registration import RegistrationConfig
from duagc.pipeline.frontend.frame_images import pyramid_of
from duagc.pipeline.frontend.frame_pairs import FramePairs, MovingView
from duagc.pipeline.frontend.motion_differences import (
    BY_COLOR,
    BY_DEPTH,
    LEVELS,
    MEASURED,
    STRIDES,
    FoundTime,
    MotionDifference,
    estimated_time,
    joint_information,
)
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import back_project, visible
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import RgbdFrame, RgbdLog
from duagc.pipeline.recording.rolling_shutter import LONGEST_S, Readout
from duagc.pipeline.registration import Reference, Registration, RgbdPyramid, register

KINDS = (BY_COLOR, BY_DEPTH)
ORIENTATIONS = (False, True)  # whether by columns
STEP_PX = 8  # between the pixels by which the rows of a half are averaged
SHORT_PERCENTILE = 10  # of the times between images
MOVED_FRAMES = 20  # by which it is known how far rows move
MOST_ROUNDS = 4
SETTLED = 0.25  # of the readout, at most, found in the last round
LARGEST = 1.0  # quantile of the changes of velocity
TYPICAL = 0.5  # the same where views of the largest change cannot be registered
LEAST_POINTS = 50  # of a half that both frames see


@dataclass(frozen=True)
class _Half:
    """The upper, lower, left or right half of an image, seen by another one.

    Attributes:
        reference: of the image with the depth of this half alone.
        place: mean row, or column, of its points in the image, as a share of all, from -1/2 to 1/2.
        place_seen: the same in the other image.
    """

    reference: Reference
    place: float
    place_seen: float


def certain_readout(frames: FramePairs, config: ReadoutConfig) -> Readout:
    """How long color and depth are read, each if it is certain and long enough to matter; else 0.

    Nothing is looked for where the log states a readout, and only that of color where it has sigma of every depth: such
    depth is computed from images or sweeps, and its errors look alike in views that are near each other.

    Args:
        frames: pairs of frames of the log, its images as they were read.
        config: of the estimate.
    """
    log, parts = frames.log, frames.parts
    if not config.enabled or log.states_readout:
        return Readout()
    kinds = KINDS[:1] if frames.has_sigma else KINDS
    longest_s = min(LONGEST_S, _interval_s(log))
    most = max(_moved(log, Readout(longest_s, longest_s, by_columns), parts) for by_columns in ORIENTATIONS)
    if most < config.least_move:
        return Readout()
    rounds = config.rounds if most >= config.move_to_track_again else 1

    def left_of(readout: Readout, quantile: float) -> list[FoundTime | None]:
        pairs = frames.spread(config.pairs, quantile)
        with _made_still(log, readout, parts):
            return _estimated(frames, pairs, config, kinds, by_columns=readout.by_columns)

    for by_columns in ORIENTATIONS:
        found, quantile = Readout(by_columns=by_columns), LARGEST
        left = left_of(found, quantile)
        if left[0] is None:  # halves of images that are sheared too much cannot be registered
            quantile = TYPICAL
            left = left_of(found, quantile)
        certain = _certain(left, config)
        if any(certain):
            first = found = _added(found, left, certain, longest_s)
            for done in range(2, (MOST_ROUNDS if rounds > 1 else 1) + 1):
                before, found = found, _added(found, left_of(found, quantile), certain, longest_s)
                in_first = math.copysign(1.0, first.color_s)  # the direction of the first round
                grown_s = in_first * (found.color_s - before.color_s)
                if done >= rounds and grown_s <= SETTLED * in_first * found.color_s:
                    break
            if min(first.color_s * found.color_s, first.depth_s * found.depth_s) < 0:
                return Readout()  # what contradicts itself was chance
            return found if _moved(log, found, parts) >= config.least_move else Readout()
    return Readout()


@contextmanager
def _made_still(log: RgbdLog, readout: Readout, parts: Sequence[Trajectory]) -> Iterator[None]:
    """Lets frames be read as if their images were read in such a time."""
    log.readout = readout
    log.move_depth(*parts)
    try:
        yield
    finally:
        log.readout = Readout()


def _interval_s(log: RgbdLog) -> float:
    """Seconds between images; where some are missing, between those that follow each other most closely."""
    stamps = [color for color, _ in log.pairing.pairs]
    return 1e-9 * float(np.percentile(np.diff(stamps), SHORT_PERCENTILE)) if len(stamps) > 1 else 0.0


def moves_rows_far(log: RgbdLog, config: ReadoutConfig) -> bool:
    """Whether the rows of a log, by its readout and its motion, move so far that it is worth to track it again.

    Args:
        log: knows how it moved.
        config: says how far.
    """
    return _move(log) >= config.move_to_track_again


def _moved(log: RgbdLog, readout: Readout, parts: Sequence[Trajectory]) -> float:
    """`_move` in such a time."""
    with _made_still(log, readout, parts):
        return _move(log)


def _move(log: RgbdLog) -> float:
    """How far the rows of the median frame move, in its median pixel, as a share of its width."""
    used = [index for index in range(len(log)) if not is_held_out(index)]
    some = [used[k] for k in evenly_spaced(len(used), min(MOVED_FRAMES, len(used)))]
    return float(np.median([log.moved_rows_px(index) for index in some])) / log.camera.width


def _certain(times: Sequence[FoundTime | None], config: ReadoutConfig) -> list[bool]:
    """Whether color and depth are certain to roll; depth only where color seems to roll in its direction.

    Depth errs alike over whole walls, which can look like a readout; and a depth camera with a rolling shutter comes
    with a color camera that has one, while the reverse is common: so color is certain where depth is.
    """
    color, depth = times
    if color is None:
        return [False, False]
    if depth is None or color.may_be_chance or color.time_s * depth.time_s < 0:
        return [color.is_certain(config), False]
    return [color.is_certain(config) or depth.is_certain(config), depth.is_certain(config)]


def _added(
    readout: Readout, left: Sequence[FoundTime | None], certain: Sequence[bool], longest_s: float
) -> Readout:
    """A readout with what is left of it, by kind, where that is certain to roll and what is left is no chance."""
    times_s = [readout.color_s, readout.depth_s]
    for kind, time in enumerate(left):
        if certain[kind] and time is not None and not time.may_be_chance:
            times_s[kind] = float(np.clip(times_s[kind] + time.time_s, -longest_s, longest_s))
    return Readout(times_s[0], times_s[1], readout.by_columns)


def _estimated(
    frames: FramePairs,
    pairs: Sequence[tuple[MovingView, MovingView]],
    config: ReadoutConfig,
    kinds: Sequence[RegistrationConfig],
    *,
    by_columns: bool,
) -> list[FoundTime | None]:
    """What is left of the readout of color and of depth, by rows or by columns; None where too few pairs tell.

    Depth is not looked at where it is none of the kinds.
    """
    camera = frames.log.camera
    found: list[list[MotionDifference]] = [[], []]
    for first, second in pairs:
        seen, other = frames.frame(first.index), frames.frame(second.index)
        T_start = first.pose_of(second)
        target = RgbdPyramid(pyramid_of(other, camera, LEVELS).levels[1:])
        halves = [_half(camera, seen, T_start, half, by_columns=by_columns) for half in (0, 1)]
        for kind, of_kind in zip(kinds, found, strict=False):
            if (difference := _difference(first, second, halves, target, kind=kind)) is not None:
                of_kind.append(difference)
    return [estimated_time(of_kind, config) for of_kind in found]


def _half(
    camera: PinholeCamera, frame: RgbdFrame, T_frame_other: Array, half: int, *, by_columns: bool
) -> _Half | None:
    """The first or the second half of a frame; None if the other frame sees hardly any of it."""
    lines = Readout(by_columns=by_columns).lines(camera)
    rest = slice(None, lines // 2) if half else slice(lines // 2, None)
    depth_m = frame.depth.copy()
    depth_m[(slice(None), rest) if by_columns else rest] = 0
    v, u = np.nonzero(depth_m[::STEP_PX, ::STEP_PX])
    v, u = STEP_PX * v, STEP_PX * u
    points = se3.transform(se3.inverse(T_frame_other), back_project(camera, u, v, depth_m[v, u]))
    index, column, row = visible(camera, points)
    if len(index) < LEAST_POINTS:
        return None
    here, there = (u[index], column) if by_columns else (v[index], row)
    pyramid = pyramid_of(replace(frame, depth=depth_m), camera, LEVELS)
    reference = Reference.from_pyramid(RgbdPyramid(pyramid.levels[1:]), STRIDES)
    return _Half(reference, _place(here, lines), _place(there, lines))


def _place(at: NDArray[np.int64], lines: int) -> float:
    return float(np.mean(at)) / max(lines - 1, 1) - 0.5


def _difference(
    first: MovingView,
    second: MovingView,
    halves: Sequence[_Half | None],
    target: RgbdPyramid,
    *,
    kind: RegistrationConfig,
) -> MotionDifference | None:
    """The difference of a pair; None if the motion of either half cannot be found."""
    T_start = first.pose_of(second)
    target = target.without_depth() if kind is BY_COLOR else target
    found: list[tuple[_Half, Registration]] = []
    for half in halves:
        if half is None:
            return None
        registered = register(half.reference, target, T_start, kind)
        if registered.outcome not in MEASURED:
            return None
        found.append((half, registered))
    (one, by_one), (two, by_two) = found
    T = by_one.T_reference_target
    Ad = se3.adjoint(se3.inverse(T))
    here, there = two.place - one.place, two.place_seen - one.place_seen
    return MotionDifference(
        se3.log(se3.inverse(T) @ by_two.T_reference_target),
        there * second.velocity - here * (Ad @ first.velocity),
        np.eye(6) - Ad,
        joint_information(by_one.information, by_two.information),
    )
