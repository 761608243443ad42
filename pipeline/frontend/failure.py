"""Signs that a camera is lost, or that its images cannot be used.

A registration can end well and be wrong: two images that do not belong together make a compromise, a hand that moves
with the camera takes the pose along, a foreign room has walls too. The tests here do not ask how well the images fit,
but whether they can be true: of a rigid world, seen by two sensors that both go on, by a camera of finite speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import FailureConfig
from duagc.pipeline.frontend.hidden_pixels import HiddenPixels, carried
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.inverse_depth import chance_difference
from duagc.pipeline.geometry.masks import Mask
from duagc.pipeline.kernels.free_space import free_space
from duagc.pipeline.kernels.free_space_definition import FREE, UNKNOWN
from duagc.pipeline.registration import Level, RegistrationConfig, RgbdPyramid

Image = NDArray[np.floating]

ROWS_COMPARED_FIRST = 16  # every so many: two images of a moving camera differ in most pixels


class Reason(Enum):
    """Why a frame has no pose, or only part of it was used; recorded in the log.

    The four after NONE are outcomes of the registration.
    """

    NONE = ""
    LOW_OVERLAP = "low_overlap"
    ILL_CONDITIONED = "ill_conditioned"
    RESIDUAL = "residual"
    JUMP = "jump"
    NO_DEPTH = "no_depth"
    NO_PIXEL = "no_pixel"
    FROZEN_DEPTH = "frozen_depth"
    FROZEN_COLOR = "frozen_color"
    REPEATED = "repeated"
    OBSTRUCTED = "obstructed"
    CONTRADICTION = "contradiction"
    UNCONFIRMED = "unconfirmed"
    SOMETHING_MOVED = "something_moved"
    SMALL_SUBMAP = "small_submap"
    OTHER_COMPONENT = "other_component"
    CONTRADICTED_BY_FEATURES = "contradicted_by_features"
    CONTRADICTED_BY_DEPTH = "contradicted_by_depth"


class FrozenImageDetector:
    """Detects that one image of the camera has stopped while the other goes on.

    An image that is the same to the last bit as the one before it shows the place where it was taken first. That is
    no harm while the camera stands still. So each frozen image is compared with what the other one was when it came
    first: as soon as that has changed, the two no longer belong together. Drivers do that under load: RedKitchen
    repeats one depth image in fifty.

    Attributes:
        repeats: how many frames in a row, up to the last one, were the very ones before them, both images.
    """

    def __init__(self, config: FailureConfig) -> None:
        """Begin before the first frame.

        Args:
            config: what counts as the same and as changed.
        """
        self.config = config
        self._before: Level | None = None
        self.repeats = 0
        # the other image, coarse, when each came first
        self._gray_then = self._inverse_depth_then = np.zeros((0, 0), dtype=np.float32)

    def update(self, pyramid: RgbdPyramid) -> Reason:
        """Take the next frame; FROZEN_DEPTH, FROZEN_COLOR or NONE.

        Args:
            pyramid: its images.
        """
        finest, coarsest = pyramid.levels[0], pyramid.levels[-1]
        before, self._before = self._before, finest
        same_depth = before is not None and self._same(finest.inverse_depth, before.inverse_depth)
        same_color = before is not None and self._same(finest.gray, before.gray)
        self.repeats = self.repeats + 1 if same_depth and same_color else 0
        if not same_depth:
            self._gray_then = _normalized(coarsest.gray)
        if not same_color:
            self._inverse_depth_then = coarsest.inverse_depth
        if same_depth:
            changed = np.abs(_normalized(coarsest.gray) - self._gray_then) > self.config.frozen_gray_change
            if changed.mean() > self.config.frozen_gray_share:
                return Reason.FROZEN_DEPTH
        if same_color and _depth_changed(coarsest.inverse_depth, self._inverse_depth_then, self.config):
            return Reason.FROZEN_COLOR
        return Reason.NONE

    def _same(self, image: Image, before: Image) -> bool:
        """Whether nearly all measured pixels have the very value that they had before."""
        rows, rows_before = image[::ROWS_COMPARED_FIRST], before[::ROWS_COMPARED_FIRST]
        changed = int(np.count_nonzero((rows != rows_before) & (rows != 0)))
        if changed > (1 - self.config.frozen_share) * image.size + 1:
            return False
        known = int(np.count_nonzero(image))
        same = int(np.count_nonzero((image == before) & (image != 0)))
        return known > 0 and same >= self.config.frozen_share * known


@dataclass
class RecentMedian:
    """The median of the last values of something.

    Attributes:
        most: number of the last values whose median is taken.
        values: these, in order.
        median: of them; 0 before there is one.
    """

    most: int
    values: tuple[float, ...] = ()
    median: float = 0.0

    def add(self, value: float) -> None:
        """Take the next value.

        Args:
            value: it.
        """
        self.values = (*self.values, value)[-self.most :]
        self.median = float(np.median(self.values))


class FrameIntervals:
    """How much time lies between frames."""

    def __init__(self, frames: int) -> None:
        """Begin before the first frame.

        Args:
            frames: number of the last intervals whose median is taken.
        """
        self._last_ns: int | None = None
        self._last_s = RecentMedian(frames)

    def update(self, stamp_ns: int) -> None:
        """Take the stamp of the next frame.

        Args:
            stamp_ns: its time.
        """
        if self._last_ns is not None:
            self._last_s.add((stamp_ns - self._last_ns) * 1e-9)
        self._last_ns = stamp_ns

    @property
    def median_s(self) -> float:
        """Median of the last intervals, seconds; 0 before there is one."""
        return self._last_s.median


def _normalized(gray: Image) -> Image:
    """Gray values without their mean and spread: what is left does not depend on the exposure."""
    return (gray - gray.mean()) / max(float(gray.std()), 1e-3)


def _depth_changed(now: Image, then: Image, config: FailureConfig) -> bool:
    """Whether more than a share of the inverse depths known both times has changed."""
    known = (now > 0) & (then > 0)
    changed = known & (np.abs(now - then) > config.frozen_depth_change * then)
    return int(changed.sum()) > config.frozen_depth_share * max(int(known.sum()), 1)


def saturated_share(level: Level) -> float:
    """Share of usable pixels that are as dark or as bright as an image can be; 1 if there is none.

    Args:
        level: of a frame.
    """
    return saturated_share_of(level.gray if level.mask is None else level.gray[level.mask])


def saturated_share_of(gray: NDArray[np.float32]) -> float:
    """Share of pixels that are as dark or as bright as an image can be; 1 if there is none.

    Args:
        gray: values 0..1, of any shape.
    """
    return np.count_nonzero((gray <= 0.01) | (gray >= 0.99)) / gray.size if gray.size else 1.0


def shows_anything(pyramid: RgbdPyramid, config: FailureConfig) -> bool:
    """Whether the masks leave a pixel, not nearly all are saturated, and some show a depth, or gray values that differ.

    A covered lens shows neither. The coarsest gray image decides: there the noise of a dark image is averaged out.

    Args:
        pyramid: of the frame.
        config: limits of saturation and contrast.
    """
    finest, coarsest = pyramid.levels[0], pyramid.levels[-1]
    if saturated_share(finest) > config.max_saturated:
        return False
    gray = coarsest.gray if coarsest.mask is None else coarsest.gray[coarsest.mask]
    contrast = float(np.ptp(gray)) if gray.size else 0.0
    return bool(finest.inverse_depth.any()) or contrast >= config.min_contrast


def has_enough_depth(pyramid: RgbdPyramid, config: RegistrationConfig) -> bool:
    """Whether the coarsest image that a registration begins with has as many known depths as it needs.

    Args:
        pyramid: of the frame.
        config: of the registration.
    """
    level = pyramid.levels[min(len(config.iterations), len(pyramid.levels)) - 1]
    return int(np.count_nonzero(level.inverse_depth)) >= config.min_samples


def free_space_violations(
    level: Level, keyframe: Level, T_keyframe_camera: Array, config: FailureConfig
) -> tuple[int, int]:
    """How many pixels of a view are in space that a keyframe saw to be free, and how many it can judge at all.

    A pixel violates free space if its point is nearer than all that the keyframe measured in the 3x3 pixels around its
    projection, by more than the gates and noise. Surfaces that come in from the side are outside the keyframe's view.

    Args:
        level: one resolution of the view.
        keyframe: the same of the keyframe.
        T_keyframe_camera: [4, 4].
        config: the gates.

    Returns:
        Number of violations, and number of pixels whose place the keyframe measured.
    """
    where = free_space(
        level.points,
        T_keyframe_camera,
        keyframe.nearest,
        level.camera,
        gate_m=config.free_space_gate_m,
        gate_relative=config.free_space_gate_relative,
        gate_inverse=chance_difference(level.inverse_depth_sigma, keyframe.inverse_depth_sigma),
    )
    return int(np.count_nonzero(where == FREE)), int(np.count_nonzero(where != UNKNOWN))


@dataclass(frozen=True)
class Viewpoint:
    """Where a view was taken, by a keyframe.

    Attributes:
        keyframe: the keyframe's coarsest image.
        T_map_keyframe: [4, 4].
        T_keyframe_camera: [4, 4], of the view.
    """

    keyframe: Level
    T_map_keyframe: Array
    T_keyframe_camera: Array


class OcclusionDetector:
    """Detects an object in front of the camera: much of a view is in space that was seen to be free.

    Every view is compared with its keyframe and with the last view without an object. That one was taken nearby: what
    appears from one frame to the next is inside it, where the keyframe, from elsewhere, cannot judge what is near the
    lens. The keyframe is older: it also shows what came in slowly.

    Attributes:
        active: whether an object came and has not been seen to be gone.
        occluded: whether the last view shows it.
        unoccluded: the last view without an object, coarse, and its T_map_camera [4, 4].
        shown: where the object was in the last view, bool [h, w], and the inverse depth of that view, [h, w], 1/m, both
            of the coarsest image; None: it was not looked for, or is no more there.
    """

    def __init__(self, config: FailureConfig) -> None:
        """Begin without an object.

        Args:
            config: gates and shares.
        """
        self.config = config
        self.active = False
        self.occluded = False
        self.unoccluded: tuple[Level, Array] | None = None
        self.shown: tuple[Mask, Image] | None = None

    def update(self, view: Level, viewpoint: Viewpoint, seen: Level | None = None) -> None:
        """Take the next view that was tracked. An object is gone only when most of a view can be judged.

        Args:
            view: its coarsest image.
            viewpoint: where it was tracked.
            seen: the image without what may be an object; None: the same.
        """
        self.occluded, visible = self.judge(view, viewpoint)
        if self.occluded:
            self.active = True
        elif visible >= self.config.min_visible * int(np.count_nonzero(view.inverse_depth)):
            self.active = False
        if not self.active:
            self.shown = None
        self._remember(seen or view, viewpoint)

    def update_by(self, hidden: HiddenPixels, view: Level, viewpoint: Viewpoint, whole: Level) -> None:
        """The same of a view in which the object was looked for.

        Args:
            hidden: by the object.
            view: its coarsest image, without the pixels of the object.
            viewpoint: where it was tracked.
            whole: its coarsest image.
        """
        self.shown = hidden.mask, whole.inverse_depth
        self.occluded = hidden.share > self.config.max_free_space_violations
        self.active = self.occluded or (self.active and hidden.visible < self.config.min_visible)
        self._remember(view, viewpoint)

    def carry(self, view: Level, min_region: float) -> None:
        """Follow the object into a view of a camera that is lost.

        Args:
            view: its coarsest image.
            min_region: smallest object, as a share of the image.
        """
        if self.shown is not None:
            mask = carried(*self.shown, view, min_region=min_region)
            self.shown = (mask, view.inverse_depth) if mask.any() else None

    def _remember(self, view: Level, viewpoint: Viewpoint) -> None:
        if not self.active:
            self.unoccluded = view, viewpoint.T_map_keyframe @ viewpoint.T_keyframe_camera

    def judge(self, view: Level, viewpoint: Viewpoint) -> tuple[bool, int]:
        """Whether too much of a view is in free space, and how many of its pixels could be judged.

        Args:
            view: its coarsest image.
            viewpoint: where it was taken.
        """
        T_keyframe_camera = viewpoint.T_keyframe_camera
        found = [free_space_violations(view, viewpoint.keyframe, T_keyframe_camera, self.config)]
        if self.unoccluded is not None:
            before, T_map_before = self.unoccluded
            T_before_camera = se3.inverse(T_map_before) @ viewpoint.T_map_keyframe @ T_keyframe_camera
            found.append(free_space_violations(view, before, T_before_camera, self.config))
        occluded = any(
            violations > self.config.max_free_space_violations * visible for violations, visible in found
        )
        return occluded, max(visible for _, visible in found)
