"""Results of tracking: where every frame was, and the keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.registration import Level, Reference, Registration
from duagc.pipeline.registration.features import Features


class Status(Enum):
    """Whether a frame's pose may be used; the values are in the log."""

    OK = "ok"
    LOST = "lost"
    RELOCALIZED = "relocalized"


@dataclass(frozen=True)
class TrackedFrame:
    """Where a frame was, relative to a keyframe.

    Attributes:
        frame_index: in the log.
        stamp_ns: its time.
        keyframe_index: the keyframe that it is anchored to.
        T_keyframe_camera: [4, 4]; the last known one if lost.
        information: [6, 6] of T_keyframe_camera, right tangent (translation m, rotation rad); zero if lost.
        status: whether the pose may be used.
        overlap: share of the keyframe's samples that it saw on the same surface.
        rms_depth_m: weighted depth residual.
        rms_gray: weighted gray residual.
        reason: why it is lost, or why only its color or only its depth was used.
        repeats: both images are those of the frame before.
    """

    frame_index: int
    stamp_ns: int
    keyframe_index: int
    T_keyframe_camera: Array
    information: Array
    status: Status
    overlap: float
    rms_depth_m: float
    rms_gray: float
    reason: Reason = Reason.NONE
    repeats: bool = False

    @staticmethod
    def by(
        frame_index: int,
        stamp_ns: int,
        *,
        keyframe_index: int,
        result: Registration,
        status: Status,
        reason: Reason = Reason.NONE,
    ) -> TrackedFrame:
        """A frame that was registered to a keyframe.

        Args:
            frame_index: in the log.
            stamp_ns: its time.
            keyframe_index: the keyframe.
            result: the registration.
            status: whether the camera was lost before.
            reason: why only its color or only its depth was used.
        """
        return TrackedFrame(
            frame_index=frame_index,
            stamp_ns=stamp_ns,
            keyframe_index=keyframe_index,
            T_keyframe_camera=result.T_reference_target,
            information=result.information,
            status=status,
            overlap=result.overlap,
            rms_depth_m=result.rms_depth_m,
            rms_gray=result.rms_gray,
            reason=reason,
        )


@dataclass(frozen=True)
class TrackedKeyframe:
    """A keyframe as it was tracked.

    Attributes:
        keyframe_index: in the order of time.
        frame_index: of its frame.
        stamp_ns: time of its frame.
        previous_index: the keyframe that it was tracked from; -1 of the first.
        T_map_keyframe: [4, 4], as tracked.
        reference: samples that frames are registered to.
        features: by which a lost camera is relocalized here.
        coarsest: the coarsest image of its pyramid.
        seen: the same without what may be an object in front of the camera.
        exposure: (gain, offset) of its gray values relative to keyframe 0.
    """

    keyframe_index: int
    frame_index: int
    stamp_ns: int
    previous_index: int
    T_map_keyframe: Array
    reference: Reference = field(repr=False)
    features: Features = field(repr=False)
    coarsest: Level = field(repr=False)
    seen: Level = field(repr=False)
    exposure: tuple[float, float] = (1.0, 0.0)

    @cached_property
    def center_map(self) -> Array:
        """The middle [3] of what it sees, in the map as tracked."""
        points = self.reference.levels[-1].points.astype(np.float64)
        middle = np.median(points, axis=0) if len(points) else np.zeros(3)
        return se3.transform(self.T_map_keyframe, middle[None])[0]

    @property
    def median_depth_m(self) -> float:
        """Median depth of what it sees, meters; infinite if it sees nothing."""
        return self.coarsest.median_depth_m


def tracked_path(frames: Sequence[TrackedFrame], T_map_keyframe: Array) -> Trajectory:
    """T_map_camera of the frames that have a pose.

    Args:
        frames: of a log.
        T_map_keyframe: [k, 4, 4], of the keyframes that they are anchored to.
    """
    placed = [frame for frame in frames if frame.status is not Status.LOST]
    poses = [T_map_keyframe[frame.keyframe_index] @ frame.T_keyframe_camera for frame in placed]
    stamps = np.array([frame.stamp_ns for frame in placed], dtype=np.int64)
    return Trajectory(stamps, np.array(poses).reshape(-1, 4, 4))
