"""How many keyframes a front end will make of a log, from some places of it on small images.

From a frame on, others are registered at growing gaps until one would become the next keyframe, and from there on again
until a place lies between two: keyframes come once in so many frames there. The mean over places that are spread evenly
over the log is the rate of the whole log. A place itself is no keyframe: where a camera turns back, it sees least of
what comes; one that turns to and fro keeps the keyframe that it made on its way.
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
MOST_HOPS = 6  # keyframes from one to the next, before a place
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
    chain = _Chain(log, config.max_width, rule)
    gaps = [chain.gap_around(start) if start < last else None for start in starts]
    rates = [1 / gap for gap in gaps if gap is not None]
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


class _Chain:
    """Keyframes one after another, as a tracker would make them; it jumps where the next place is far."""

    def __init__(self, log: RgbdLog, max_width: int, rule: KeyframeConfig) -> None:
        self._log, self._width, self._rule = log, max_width, rule
        self._first = FIRST_GAP
        self._gap: float | None = None  # frames between the last two keyframes
        self._at = 0  # frame of the last one
        self._guessed = False  # whether that is a frame that may be none

    def gap_around(self, place: int) -> float | None:
        """Frames between the keyframes before and after a frame; infinite: it shows nothing; None: nothing registers.

        Args:
            place: index of the frame, later than that of the call before.
        """
        if place < self._at:
            return self._gap
        if self._at and not (self._gap and place - self._at <= MOST_HOPS * self._gap < math.inf):
            self._start(place if self._gap in (None, math.inf) else place - math.ceil(self._gap))
        for _ in range(MOST_HOPS):
            begun, guessed = self._at, self._guessed
            gap = self._hop()
            if self._at > begun:
                self._gap = gap
                if self._at > place and not guessed:
                    break
            elif begun < place:
                self._start(place)
            else:
                self._gap = gap if begun == place else self._gap
                break
        return self._gap

    def _start(self, frame: int) -> None:
        self._at, self._guessed = frame, True

    def _hop(self) -> float | None:
        """Go on to the next keyframe, or as far as it is known that there is none; the frames to the next one."""
        if self._at >= len(self._log) - 1:
            return None
        place = _Place(self._log, self._at, self._width, self._rule)
        gap = place.gap(self._first)
        if gap is not None and gap < len(self._log):
            self._first = max(1, round(gap / 2))
        self._at, self._guessed = self._at + place.known, not place.found
        return gap


class _Place:
    """Frames that follow one frame, which would be a keyframe."""

    def __init__(self, log: RgbdLog, start: int, max_width: int, rule: KeyframeConfig) -> None:
        self._log, self._start, self._width, self._rule = log, start, max_width, rule
        self._pyramids: dict[int, RgbdPyramid] = {}  # by gap: what was too far is tried again from nearer
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

    @property
    def found(self) -> bool:
        """Whether there is a next keyframe."""
        return self._far is not None

    @property
    def known(self) -> int:
        """Frames up to the next keyframe, or up to the last of which it is known that it is none."""
        return math.ceil(self._between()) if self.found else self._near[0]

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
        if gap not in self._pyramids:
            self._pyramids[gap] = self._built(gap)
        return self._pyramids[gap]

    def _built(self, gap: int) -> RgbdPyramid:
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
