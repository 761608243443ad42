"""What tells that a camera is lost, or that what it says cannot be believed.

A registration can end well and be wrong: two images that do not belong together make a compromise, a hand that moves
with the camera takes the pose along, a foreign room has walls too. The tests here do not ask how well the images fit,
but whether they can be true: of a rigid world, seen by two sensors that both go on, by a camera of finite speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.frontend import FailureConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.projection import FREE, back_project, free_space, largest_of_3x3
from duagc.pipeline.registration import Level, RegistrationConfig, RgbdPyramid

Array = NDArray[np.float64]
Image = NDArray[np.floating]


class Reason(Enum):
    """Why a frame has no pose; the values stand in the log. The first five are outcomes of the registration."""

    NONE = ""
    LOW_OVERLAP = "low_overlap"
    ILL_CONDITIONED = "ill_conditioned"
    RESIDUAL = "residual"
    JUMP = "jump"
    NO_DEPTH = "no_depth"
    STUCK_DEPTH = "stuck_depth"
    STUCK_COLOR = "stuck_color"
    OBSTRUCTED = "obstructed"
    CONTRADICTION = "contradiction"
    UNCONFIRMED = "unconfirmed"


class StuckImages:
    """Notices that one image of the camera has stopped while the other goes on.

    An image that is the same to the last bit as the one before it shows the place where it was taken first. That is
    no harm while the camera stands still. So each stuck image is held against the other one at the time when it came
    first: as soon as that has changed, the two no longer belong together. Drivers do that under load: RedKitchen
    repeats one depth image in fifty.
    """

    def __init__(self, config: FailureConfig) -> None:
        self.config = config
        self._before: Level | None = None
        self._depth_came = self._color_came = np.zeros(
            (0, 0), dtype=np.float32
        )  # the other image then, coarse

    def look(self, pyramid: RgbdPyramid) -> Reason:
        """Look at the next frame; STUCK_DEPTH, STUCK_COLOR or NONE."""
        finest, coarsest = pyramid.levels[0], pyramid.levels[-1]
        before, self._before = self._before, finest
        same_depth = before is not None and self._same(finest.inverse_depth, before.inverse_depth)
        same_color = before is not None and self._same(finest.gray, before.gray)
        if not same_depth:
            self._depth_came = _normalized(coarsest.gray)
        if not same_color:
            self._color_came = coarsest.inverse_depth
        if same_depth:
            changed = np.abs(_normalized(coarsest.gray) - self._depth_came) > self.config.stuck_gray_change
            if changed.mean() > self.config.stuck_gray_share:
                return Reason.STUCK_DEPTH
        if same_color and _depth_changed(coarsest.inverse_depth, self._color_came, self.config):
            return Reason.STUCK_COLOR
        return Reason.NONE

    def _same(self, image: Image, before: Image) -> bool:
        """Whether nearly all measured pixels have the very value that they had before."""
        known = int(np.count_nonzero(image))
        same = int(np.count_nonzero((image == before) & (image != 0)))
        return known > 0 and same >= self.config.stuck_share * known


class Pace:
    """How much time usually lies between two frames."""

    FRAMES = 50  # that tell what is usual

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._intervals_s: tuple[float, ...] = ()

    def look(self, stamp_ns: int) -> None:
        """Look at the stamp of the next frame."""
        if self._last_ns is not None:
            interval_s = (stamp_ns - self._last_ns) * 1e-9
            self._intervals_s = (*self._intervals_s[1 - self.FRAMES :], interval_s)
        self._last_ns = stamp_ns

    def usual_s(self) -> float:
        """Median of the last intervals; 0 before there is one."""
        return float(np.median(self._intervals_s)) if self._intervals_s else 0.0


def _normalized(gray: Image) -> Image:
    """Gray values without their mean and spread: what is left does not depend on the exposure."""
    return (gray - gray.mean()) / max(float(gray.std()), 1e-3)


def _depth_changed(now: Image, then: Image, config: FailureConfig) -> bool:
    """Whether more than a share of the inverse depths known both times has changed."""
    known = (now > 0) & (then > 0)
    changed = known & (np.abs(now - then) > config.stuck_depth_change * then)
    return int(changed.sum()) > config.stuck_depth_share * max(int(known.sum()), 1)


def saturated_share(level: Level) -> float:
    """Share of pixels that are as dark or as bright as an image can be."""
    return float(np.mean((level.gray <= 0.01) | (level.gray >= 0.99)))


def has_enough_depth(pyramid: RgbdPyramid, config: RegistrationConfig) -> bool:
    """Whether the coarsest image that a registration begins with has as many known depths as it needs."""
    level = pyramid.levels[min(len(config.iterations), len(pyramid.levels)) - 1]
    return int(np.count_nonzero(level.inverse_depth)) >= config.min_samples


def intruders(
    level: Level, keyframe: Level, T_keyframe_camera: Array, config: FailureConfig
) -> tuple[int, int]:
    """How many pixels of a view stand where a keyframe saw free space, and how many the keyframe could tell at all.

    In a rigid world a surface inside a keyframe's view is never nearer than what the keyframe saw there. A pixel
    intrudes if its point is nearer than all that the keyframe measured in the 3x3 pixels around its projection, by
    more than the gate. Surfaces that come in from the side are outside the keyframe's view: it cannot tell.

    Args:
        level, keyframe: one resolution of the view and the same of the keyframe. T_keyframe_camera: [4, 4].
    """
    v, u = np.nonzero(level.inverse_depth)
    z = 1 / level.inverse_depth[v, u].astype(np.float64)
    points = se3.transform(T_keyframe_camera, back_project(level.camera, u, v, z))
    gates = config.intruder_gate_m, config.intruder_gate_relative
    _, where = free_space(points, largest_of_3x3(keyframe.inverse_depth), level.camera, *gates)
    return int(np.count_nonzero(where == FREE)), len(where)


@dataclass(frozen=True)
class SeenFrom:
    """A keyframe, coarse, and a view beside it: T_map_keyframe, T_keyframe_camera, [4, 4] each."""

    keyframe: Level
    T_map_keyframe: Array
    T_keyframe_camera: Array


class Obstruction:
    """Something before the camera: noticed when much of a view stands in space that was seen to be free.

    Every view is held against its keyframe and against the last clear view. That one was taken nearby: what appears
    from one frame to the next is inside it, where the keyframe, from elsewhere, cannot judge what is near the lens. The
    keyframe is older: it also knows what came in slowly.
    """

    def __init__(self, config: FailureConfig) -> None:
        self.config = config
        self.standing = False
        self._clear: tuple[Level, Array] | None = None  # the last view without, coarse, and its T_map_camera

    def look(self, view: Level, seen: SeenFrom) -> None:
        """Look at the next view that was tracked. What stands there is gone only when most of a view can be judged."""
        intruded, told = self.intruded(view, seen)
        if intruded:
            self.standing = True
        elif told >= self.config.min_told * int(np.count_nonzero(view.inverse_depth)):
            self.standing = False
        if not self.standing:
            self._clear = view, seen.T_map_keyframe @ seen.T_keyframe_camera

    def intruded(self, view: Level, seen: SeenFrom) -> tuple[bool, int]:
        """Whether too much of a view stands in free space; second, how many of its pixels could be judged."""
        judged = [intruders(view, seen.keyframe, seen.T_keyframe_camera, self.config)]
        if self._clear is not None:
            clear, T_map_clear = self._clear
            T_clear_camera = se3.inverse(T_map_clear) @ seen.T_map_keyframe @ seen.T_keyframe_camera
            judged.append(intruders(view, clear, T_clear_camera, self.config))
        intruded = any(intruding > self.config.max_intruders * told for intruding, told in judged)
        return intruded, max(told for _, told in judged)
