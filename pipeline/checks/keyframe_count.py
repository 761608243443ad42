"""How many keyframes a front end will make of a log, from some places of it on small images.

From each place on, frames are registered at growing gaps until one would become the next keyframe. Keyframes come once
in so many frames there; the mean over places that are spread evenly over the log is the rate of the whole log.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.checks import KeyframeChecks
from duagc.pipeline.config.frontend import KeyframeConfig
from duagc.pipeline.config.registration import RegistrationConfig
from duagc.pipeline.frontend.keyframe_graph import becomes_keyframe, shared_view
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import RgbdLog
from duagc.pipeline.registration import Reference, RgbdPyramid, register

REGISTRATION = RegistrationConfig(
    iterations=(6, 10, 15)
)  # more than by default: gaps are long, nothing is predicted
STRIDES = (2, 1, 1)
FIRST_GAP = 4  # frames; later places begin with half of what the one before found
SIGMAS = 2.0  # of the mean over places
MODEL = 0.1  # relative: what small images and straight lines between gaps are wrong by (docs/lab, keyframes-of-a-log)


@dataclass(frozen=True)
class KeyframeCount:
    """Keyframes of a robot.

    Attributes:
        expected: number.
        low: end of an interval of about 95 %.
        high: its other end.
    """

    expected: int
    low: int
    high: int


def count_keyframes(log: RgbdLog, config: KeyframeChecks, rule: KeyframeConfig) -> KeyframeCount:
    """Estimate the number of keyframes without tracking; a second for a log of any length.

    Args:
        log: of a robot.
        config: how many places are looked at.
        rule: when a frame becomes a keyframe.
    """
    last = len(log) - 1
    count = max(1, min(config.places, len(log) // config.frames_per_place))
    starts = np.unique((np.arange(count) + 0.5) / count * last).astype(int).tolist()
    rates, first = [], FIRST_GAP
    for start in starts:
        gap = _Place(log, start, config.max_width, rule).gap(first) if start < last else None
        if gap is not None:
            rates.append(1 / gap)
            first = max(1, round(gap / 2)) if gap < len(log) else first
    return _count(len(log), rates, len(starts) - len(rates))


def _count(frames: int, rates: Sequence[float], failed: int) -> KeyframeCount:
    """Keyframes by their rates at some places; where nothing registers there may be none, or one a frame."""
    mean = float(np.mean(rates)) if rates else 0.0
    if mean == 0.0:
        return KeyframeCount(frames if failed else 1, 1, frames if failed else 1)
    spread = float(np.std(rates, ddof=1)) if len(rates) > 1 else mean
    relative = math.hypot(MODEL, SIGMAS * spread / math.sqrt(len(rates)) / mean)
    share = failed / (len(rates) + failed)
    found = (mean, (1 - share) * mean / (1 + relative), (1 - share) * mean * (1 + relative) + share)
    expected, low, high = (min(frames, 1 + round(rate * (frames - 1))) for rate in found)
    return KeyframeCount(expected, low, high)


class _Place:
    """Frames that follow one frame, which would be a keyframe."""

    def __init__(self, log: RgbdLog, start: int, max_width: int, rule: KeyframeConfig) -> None:
        self._log, self._start, self._width, self._rule = log, start, max_width, rule
        self._reference = Reference.from_pyramid(self._pyramid(0), STRIDES)
        self._last = len(log) - 1 - start
        self._near = (0, 0.0, np.eye(4))  # gap, view lost, motion
        self._far: tuple[int, float] | None = None  # gap, view lost; that of the next keyframe, or later

    def gap(self, step: int) -> float | None:
        """Frames until the next keyframe; infinite: of a frame that shows nothing; None: none can be registered.

        Args:
            step: gap that is tried first.
        """
        if len(self._reference.levels[0]) < REGISTRATION.min_samples:
            return math.inf
        while step:
            near = self._near[0]
            found = self._registered(min(near + step, self._last))
            if found is None:
                step //= 2  # too far to begin from there
                continue
            leaves, gap, lost, T = found
            if leaves:
                self._far = gap, lost
            else:
                self._near = gap, lost, T
            step = self._step()
        return self._between() if self._near[0] or self._far else None

    def _step(self) -> int:
        """How many frames to go on; 0: it is known between which two the next keyframe comes."""
        near = self._near[0]
        if self._far is None:
            return min(near, self._last - near)
        far, lost = self._far
        known = far - near <= 1 or lost <= (2.0 if near else 1.5) * self._limit
        return 0 if known else (far - near) // 2

    def _between(self) -> float:
        """Where the lost view reaches the limit, on a straight line through two gaps."""
        near, lost, _ = self._near
        if self._far is None:
            return max(near, near * self._limit / lost) if lost > 0 else math.inf
        far, lost_far = self._far
        at = (self._limit - lost) / max(lost_far - lost, 1e-6)
        return float(math.ceil(near + (far - near) * min(max(at, 0.0), 1.0)))

    @property
    def _limit(self) -> float:
        return 1 - self._rule.min_overlap

    def _registered(self, gap: int) -> tuple[bool, int, float, Array] | None:
        """Whether a frame would be the next keyframe; its gap, the share of the view that is lost, and the motion."""
        pyramid = self._pyramid(gap)
        near, _, T = self._near
        for guess in [se3.exp(se3.log(T) * (gap / near)), T] if near else [T]:
            result = register(self._reference, pyramid, guess, REGISTRATION)
            if result.ok:
                leaves = becomes_keyframe(result, pyramid, self._rule)
                return leaves, gap, 1 - shared_view(result, pyramid), result.T_reference_target
        return None

    def _pyramid(self, gap: int) -> RgbdPyramid:
        """Small images of a frame, three levels."""
        frame, width = self._log.frame(self._start + gap), self._log.camera.width
        skipped = max(0, math.ceil(math.log2(width / self._width)))
        pyramid = RgbdPyramid.build(
            frame.color,
            frame.usable_depth,
            self._log.camera,
            skipped + len(STRIDES),
            depth_sigma_m=frame.depth_sigma,
            mask=frame.mask,
        )
        return RgbdPyramid(pyramid.levels[skipped:])
