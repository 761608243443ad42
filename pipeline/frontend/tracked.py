"""What tracking makes of a log: where every frame was, and its keyframes."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import Level, Reference, Registration
from duagc.pipeline.registration.features import Features

Array = NDArray[np.float64]


class Status(Enum):
    """Whether a frame's pose may be used; the values stand in the log."""

    OK = "ok"
    LOST = "lost"
    RELOCALIZED = "relocalized"


@dataclass(frozen=True)
class TrackedFrame:
    """Where a frame was, relative to a keyframe.

    keyframe_index: the keyframe that it hangs on. T_keyframe_camera: [4, 4]; the last known one if lost.
    information: [6, 6] of T_keyframe_camera, right tangent (translation m, rotation rad); zero if lost. reason: why
    it is lost, or why only its color or only its depth was used.
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

    @staticmethod
    def by(
        frame_index: int,
        stamp_ns: int,
        keyframe_index: int,
        result: Registration,
        status: Status,
        reason: Reason = Reason.NONE,
    ) -> TrackedFrame:
        """A frame that was registered to a keyframe."""
        return TrackedFrame(
            frame_index,
            stamp_ns,
            keyframe_index,
            result.T_reference_target,
            result.information,
            status,
            result.overlap,
            result.rms_depth_m,
            result.rms_gray,
            reason,
        )


@dataclass(frozen=True)
class TrackedKeyframe:
    """A keyframe as it was tracked. exposure: (gain, offset) of its gray values relative to keyframe 0.

    features: by which a lost camera is found here. coarsest: the coarsest image of its pyramid.
    """

    keyframe_index: int
    frame_index: int
    stamp_ns: int
    previous_index: int
    T_map_keyframe: Array
    reference: Reference = field(repr=False)
    features: Features = field(repr=False)
    coarsest: Level = field(repr=False)
    exposure: tuple[float, float] = (1.0, 0.0)

    @cached_property
    def center_map(self) -> Array:
        """The middle [3] of what it sees, in the map as tracked."""
        points = self.reference.levels[-1].points.astype(np.float64)
        middle = np.median(points, axis=0) if len(points) else np.zeros(3)
        return se3.transform(self.T_map_keyframe, middle[None])[0]
