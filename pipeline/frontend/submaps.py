"""Submaps: tracking goes on in a new map where the camera is lost and relocalization fails.

Every submap has a tracker and a frame of its own. While the current submap is lost, every frame goes to the trackers of
all submaps that resemble it, which relocalize it as ever, and to a candidate for the next submap. A candidate that was
tracked for long enough, and has moved, becomes the current submap, and its frames get their poses afterwards; if it is
lost before, it begins again. So relocalization always comes first, and a log in which nothing is lost knows nothing of
this. Submaps are joined by `submap_joining`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend.current_frame import CurrentFrame
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.frame_images import RgbdImages
from duagc.pipeline.frontend.hidden_pixels import HiddenPixels
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import MotionPrior
from duagc.pipeline.registration.features import count_matches

NO_SUBMAP = -1
_UNUSABLE_IMAGES = frozenset(
    {
        Reason.NO_PIXEL,
        Reason.NO_DEPTH,
        Reason.FROZEN_DEPTH,
        Reason.FROZEN_COLOR,
        Reason.CONTRADICTION,
    }
)
"""Reasons of a loss that lie in the images: no submap begins with such a frame."""


@dataclass(frozen=True)
class TrackedSubmap:
    """What was tracked in one frame of its own.

    Attributes:
        number: from 1, in the order in which submaps began.
        keyframes: in the order of time; poses in the frame of the submap.
        pairs: registrations between them, by `keyframe_index`.
    """

    number: int
    keyframes: Sequence[TrackedKeyframe]
    pairs: Sequence[RelativePose]


@dataclass(frozen=True)
class TrackedLog:
    """A log as it was tracked.

    Attributes:
        frames: every frame of the log; `keyframe_index` counts within its submap.
        submap_of: number of the submap of every frame, also of a lost one; NO_SUBMAP of a frame whose submap was
            dropped.
        submaps: in the order in which they began.
    """

    frames: list[TrackedFrame]
    submap_of: list[int]
    submaps: list[TrackedSubmap]


@dataclass
class _Candidate:
    """A submap that may begin; its frames by their place in the log."""

    tracker: Tracker
    frames: dict[int, TrackedFrame] = field(default_factory=dict)


class SubmapTracker:
    """Tracks one camera in as many submaps as it takes. Feed it the frames in order."""

    def __init__(
        self,
        camera: PinholeCamera,
        config: FrontendConfig,
        motion: MotionPrior | None = None,
        *,
        max_depth_offset_s: float | None = None,
    ) -> None:
        """Begin without a keyframe.

        Args:
            camera: of all frames.
            config: of the front end.
            motion: how the camera moved by other sensors, where the log has any.
            max_depth_offset_s: as of `Tracker`.
        """
        self._begin = partial(Tracker, camera, config, motion, max_depth_offset_s=max_depth_offset_s)
        self.config = config
        self._trackers = [self._begin()]
        self._current = 0
        self._candidate: _Candidate | None = None
        self._frames: list[TrackedFrame] = []
        self._submap_of: list[int] = []  # index of the tracker

    def state(self) -> tuple[object, ...]:
        """All that it knows; `go_on` takes it."""
        return self._trackers, self._current, self._candidate, self._frames, self._submap_of

    def go_on(self, state: tuple[Any, ...]) -> None:
        """Go on from where another one was.

        Args:
            state: of that one.
        """
        self._trackers, self._current, self._candidate, self._frames, self._submap_of = state

    def path(self) -> Trajectory:
        """T_submap_camera of the frames of the current submap so far."""
        keyframes = self._trackers[self._current].keyframes
        placed = [
            frame
            for frame, submap in zip(self._frames, self._submap_of, strict=True)
            if submap == self._current and frame.status is not Status.LOST
        ]
        poses = [keyframes[f.keyframe_index].T_map_keyframe @ f.T_keyframe_camera for f in placed]
        stamps = np.array([frame.stamp_ns for frame in placed], dtype=np.int64)
        return Trajectory(stamps, np.array(poses).reshape(-1, 4, 4))

    def track(self, images: RgbdImages) -> None:
        """Track one frame.

        Args:
            images: of the frame; its time increases.
        """
        frame = self._trackers[self._current].prepared(images)
        tracked = self._trackers[self._current].track_frame(frame)
        searching = self.config.submaps.enabled and bool(self._trackers[0].keyframes)
        if searching and _is_lost(tracked):
            tracked = self._relocalize_elsewhere(frame) or tracked
        self._frames.append(tracked)
        self._submap_of.append(self._current)
        if tracked.status is not Status.LOST:
            self._candidate = None
        elif searching and _is_lost(tracked):
            self._track_candidate(frame, tracked.reason)

    def _relocalize_elsewhere(self, frame: CurrentFrame) -> TrackedFrame | None:
        """The frame in another submap that resembles it, the latest first; None if it is in none of them."""
        for index in reversed(range(len(self._trackers))):
            if index != self._current and self._resembles(self._trackers[index], frame):
                tracked = self._trackers[index].track_frame(frame)
                if tracked.status is not Status.LOST:
                    self._current = index
                    return tracked
        return None

    def _resembles(self, tracker: Tracker, frame: CurrentFrame) -> bool:
        """Whether some keyframe shares enough features with a frame: else the submap is not searched."""
        limits = self.config.tracking.relocalization
        most, ratio = limits.features_compared, limits.ratio
        return any(
            count_matches(keyframe.features, frame.features, most, ratio) >= limits.min_matches
            for keyframe in tracker.alike(frame)
            if len(keyframe.features)
        )

    def _track_candidate(self, frame: CurrentFrame, reason: Reason) -> None:
        """Track a lost frame in the candidate, or begin a new one; make it the current submap once it is one.

        It is without an object that was in front of the camera when it was lost, for as long as that is followed.
        """
        at, limits = len(self._frames) - 1, self.config.submaps
        shown = self._trackers[self._current].state.occlusion.shown
        if shown is not None:
            known = frame.pyramid.levels[-1].inverse_depth > 0
            share = int(np.count_nonzero(known & shown[0])) / max(int(np.count_nonzero(known)), 1)
            frame = frame.without(HiddenPixels(shown[0], share, visible=0.0))
        if self._candidate is not None:
            tracked = self._candidate.tracker.track_frame(frame)
            if tracked.status is Status.LOST:
                self._candidate = None
            else:
                self._candidate.frames[at] = tracked
        if self._candidate is None and reason not in _UNUSABLE_IMAGES:
            tracker = self._begin()
            tracked = tracker.track_frame(frame)
            if tracked.status is not Status.LOST:
                self._candidate = _Candidate(tracker, {at: tracked})
        candidate = self._candidate
        if (
            candidate is not None
            and len(candidate.frames) >= limits.min_frames
            and len(candidate.tracker.keyframes) >= limits.min_keyframes
        ):
            self._current, self._candidate = len(self._trackers), None
            self._trackers.append(candidate.tracker)
            for index, tracked in candidate.frames.items():
                self._frames[index], self._submap_of[index] = tracked, self._current

    def finish(self) -> TrackedLog:
        """All frames and submaps. A first submap that remained too small is dropped if there are others.

        So it is if the log ended within a candidate of more frames: a bad first image costs only itself then.
        """
        trackers, frames, limits = list(self._trackers), list(self._frames), self.config.submaps
        submap_of = [index + 1 for index in self._submap_of]
        posed = sum(n == 1 and f.status is not Status.LOST for f, n in zip(frames, submap_of, strict=True))
        small = posed < limits.min_frames or len(trackers[0].keyframes) < limits.min_keyframes
        if small and len(trackers) == 1 and self._candidate and len(self._candidate.frames) > posed:
            trackers.append(self._candidate.tracker)
            for k, tracked in self._candidate.frames.items():
                frames[k], submap_of[k] = tracked, len(trackers)
        dropped = len(trackers) > 1 and small
        if dropped:
            for k in (k for k, number in enumerate(submap_of) if number == 1):
                if frames[k].status is not Status.LOST:
                    frames[k] = lost(frames[k], Reason.SMALL_SUBMAP)
                submap_of[k] = NO_SUBMAP
        submaps = [TrackedSubmap(n, t.keyframes, t.pairs) for n, t in enumerate(trackers, 1)]
        return TrackedLog(frames, submap_of, submaps[dropped:])


def _is_lost(frame: TrackedFrame) -> bool:
    """Whether a frame that shows something has no pose."""
    return frame.status is Status.LOST and frame.reason is not Reason.NO_PIXEL


def lost(frame: TrackedFrame, reason: Reason) -> TrackedFrame:
    """A frame whose pose does not count.

    Args:
        frame: as it was tracked.
        reason: why its pose does not count.
    """
    return replace(
        frame,
        information=np.zeros((6, 6)),
        status=Status.LOST,
        overlap=0.0,
        rms_depth_m=0.0,
        rms_gray=0.0,
        reason=reason,
    )
