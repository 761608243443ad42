"""Tracking of disturbed frames, next to a run over the undisturbed ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.experiments.disturbances import Disturbance
from duagc.pipeline.experiments.shots import Shot
from duagc.pipeline.frontend.frame_images import RgbdImages
from duagc.pipeline.frontend.tracked import Status, TrackedFrame
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3

WRONG_M, WRONG_RAD = 0.05, np.deg2rad(3.0)
"""A pose called good that is farther than this from that of the undisturbed run is wrong."""


@dataclass(frozen=True)
class DisturbanceRow:
    """A tracked frame of a disturbed run.

    Attributes:
        shot: the frame.
        frame: as it was tracked.
        T_map_camera: [4, 4].
        moved_m: distance from the pose of the undisturbed run.
        turned_rad: the same of the rotation.
    """

    shot: Shot
    frame: TrackedFrame
    T_map_camera: NDArray[np.float64]
    moved_m: float
    turned_rad: float

    @property
    def good(self) -> bool:
        """Whether the tracker gave a pose."""
        return self.frame.status is not Status.LOST

    @property
    def wrong(self) -> bool:
        """Whether it gave one that is wrong."""
        far = self.moved_m > WRONG_M or self.turned_rad > WRONG_RAD
        return self.good and (self.shot.foreign or far)


def track(tracker: Tracker, shot: Shot) -> tuple[TrackedFrame, NDArray[np.float64]]:
    """The tracked frame and its pose T_map_camera [4, 4], before any optimization.

    Args:
        tracker: that takes the frame.
        shot: the frame.
    """
    image = shot.color.astype(np.float32) * np.float32(1 / 255)
    frame = tracker.track(
        RgbdImages(frame_index=shot.index, stamp_ns=shot.stamp_ns, image=image, depth_m=shot.depth)
    )
    if not tracker.keyframes:
        return frame, np.eye(4)
    return frame, tracker.keyframes[frame.keyframe_index].T_map_keyframe @ frame.T_keyframe_camera


class Undisturbed:
    """A run over undisturbed frames, with copies of the tracker as it was before some of them."""

    def __init__(self, tracker: Tracker, shots: Sequence[Shot], starts: Sequence[int]) -> None:
        """Track all frames.

        Args:
            tracker: that has tracked nothing yet.
            shots: the frames.
            starts: indices of the frames before which a copy of the tracker is kept.
        """
        self.shots = shots
        self.frames: list[TrackedFrame] = []
        self.poses: list[NDArray[np.float64]] = []
        self._before: dict[int, Tracker] = {}
        for shot in shots:
            if shot.index in starts:
                self._before[shot.index] = tracker.copied()
            frame, pose = track(tracker, shot)
            self.frames.append(frame)
            self.poses.append(pose)

    def tracker(self, start: int, config: FrontendConfig | None = None) -> Tracker:
        """A tracker as it was before a frame.

        Args:
            start: index of the frame.
            config: of the tracker from now on; None: the same.
        """
        return self._before[start].copied(config)

    def disturbed(
        self,
        start: int,
        disturbance: Disturbance,
        frames: int = 45,
        config: FrontendConfig | None = None,
    ) -> list[DisturbanceRow]:
        """Track on from a frame with a disturbance that begins there.

        Args:
            start: index of the frame.
            disturbance: of the frames from there on.
            frames: number of frames.
            config: of the tracker from there on; None: the same.
        """
        tracker = self.tracker(start, config)
        rows = []
        for shot in disturbance(self.shots[start : start + frames], np.random.default_rng(start)):
            frame, pose = track(tracker, shot)
            moved_m, turned_rad = se3.distance(self.poses[shot.index], pose)
            rows.append(DisturbanceRow(shot, frame, pose, float(moved_m), float(turned_rad)))
        return rows
