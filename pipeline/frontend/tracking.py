"""Tracking of one RGB-D camera, frame to keyframe, without rendering.

Every frame is registered to the latest keyframe from a constant-velocity guess. If that fails, it is tried again
from other starts and with wider gates, then against earlier keyframes; if all fail the frame is `lost`, which the
log says, and nothing is made of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from pipeline.frontend.config import FrontendConfig, is_held_out
from pipeline.frontend.keyframes import KeyframePair, becomes_keyframe, predicted_overlap
from pipeline.geometry import se3
from pipeline.geometry.camera import PinholeCamera
from pipeline.registration import Reference, Registration, RegistrationConfig, RgbdPyramid, register

Array = NDArray[np.float64]
Image = NDArray[np.floating]


class Status(Enum):
    """Whether a frame's pose may be used; the values stand in the log."""

    OK = "ok"
    LOST = "lost"
    RELOCALISED = "relocalised"


@dataclass(frozen=True)
class TrackedFrame:
    """Where a frame was, relative to a keyframe.

    keyframe_index: the keyframe that it hangs on. T_keyframe_camera: [4, 4]; the last known one if lost.
    information: [6, 6] of T_keyframe_camera, right tangent (translation m, rotation rad); zero if lost.
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


@dataclass(frozen=True)
class TrackedKeyframe:
    """A keyframe as it was tracked. exposure: (gain, offset) of its grey values relative to keyframe 0."""

    keyframe_index: int
    frame_index: int
    stamp_ns: int
    previous_index: int
    T_map_keyframe: Array
    reference: Reference = field(repr=False)
    exposure: tuple[float, float] = (1.0, 0.0)


class Tracker:
    """Tracks one camera. Feed it the frames in order."""

    def __init__(self, camera: PinholeCamera, config: FrontendConfig) -> None:
        self.camera, self.config = camera, config
        self.keyframes: list[TrackedKeyframe] = []
        self.pairs: list[KeyframePair] = []
        """Registrations between keyframes, for `keyframes.refine`."""
        self._current = 0  # keyframe that frames are tracked against
        self._T_keyframe_camera = np.eye(4)  # of the last frame that was tracked
        self._motion = np.eye(4)  # T_camera_next of the two frames before, identity after a loss
        self._lost = False

    def track(
        self,
        frame_index: int,
        stamp_ns: int,
        image: Image,
        depth_m: Image,
        *,
        mask: NDArray[np.bool_] | None = None,
    ) -> TrackedFrame:
        """Track one frame; the first becomes keyframe 0 and the origin of the map.

        Args:
            image: colour [h, w, 3] or grey [h, w], 0..1. depth_m: [h, w], metres, 0 = unknown.
            mask: bool [h, w], False where a pixel must not be used; its depth counts as unknown. None = all may.
        """
        if mask is not None:
            depth_m = np.where(mask, depth_m, 0)
        pyramid = RgbdPyramid.build(image, depth_m, self.camera, levels=len(self.config.tracking.strides))
        if not self.keyframes:
            self._add_keyframe(frame_index, stamp_ns, pyramid, -1, np.eye(4), None)
            nothing = np.zeros((6, 6))
            return TrackedFrame(frame_index, stamp_ns, 0, np.eye(4), nothing, Status.OK, 1.0, 0.0, 0.0)
        found = self._register(pyramid)
        if found is None:
            self._motion, self._lost = np.eye(4), True
            return self._lost_frame(frame_index, stamp_ns)
        keyframe_index, result = found
        status = Status.RELOCALISED if self._lost else Status.OK
        followed = keyframe_index == self._current and not self._lost
        self._motion = (
            se3.inverse(self._T_keyframe_camera) @ result.T_reference_target if followed else np.eye(4)
        )
        self._current, self._T_keyframe_camera, self._lost = keyframe_index, result.T_reference_target, False
        if not is_held_out(frame_index) and becomes_keyframe(result, pyramid, self.config.keyframes):
            return self._promote(frame_index, stamp_ns, pyramid, keyframe_index, result, status)
        return _tracked(frame_index, stamp_ns, keyframe_index, result, status)

    # --- one frame ------------------------------------------------------------------------------------------------

    def _register(self, pyramid: RgbdPyramid) -> tuple[int, Registration] | None:
        """The first registration that is OK: its keyframe and result."""
        tracking = self.config.tracking
        for index, guess, config in self._attempts():
            reference = self.keyframes[index].reference
            result = register(reference, pyramid, guess, config)
            if result.ok and config is tracking.recovery:
                # wide gates let wrong surfaces in: what they found must hold with the usual ones
                result = register(reference, pyramid, result.T_reference_target, tracking.registration)
            if result.ok:
                return index, result
        return None

    def _attempts(self) -> Iterator[tuple[int, Array, RegistrationConfig]]:
        """Keyframe, guess of T_keyframe_camera and limits of every attempt, the likeliest first."""
        tracking, last = self.config.tracking, self._T_keyframe_camera
        predicted = last @ self._motion
        yield self._current, predicted, tracking.registration
        yield self._current, last, tracking.registration
        yield self._current, last, tracking.recovery
        yield self._current, predicted, tracking.recovery
        T_map_last = self.keyframes[self._current].T_map_keyframe @ last
        for keyframe in self.keyframes[: -tracking.relocalisation_keyframes - 1 : -1]:
            if keyframe.keyframe_index != self._current:
                yield (
                    keyframe.keyframe_index,
                    se3.inverse(keyframe.T_map_keyframe) @ T_map_last,
                    tracking.recovery,
                )
            yield keyframe.keyframe_index, np.eye(4), tracking.recovery

    def _lost_frame(self, frame_index: int, stamp_ns: int) -> TrackedFrame:
        return TrackedFrame(
            frame_index,
            stamp_ns,
            self._current,
            self._T_keyframe_camera,
            np.zeros((6, 6)),
            Status.LOST,
            0.0,
            0.0,
            0.0,
        )

    # --- keyframes ------------------------------------------------------------------------------------------------

    def _promote(
        self,
        frame_index: int,
        stamp_ns: int,
        pyramid: RgbdPyramid,
        previous: int,
        result: Registration,
        status: Status,
    ) -> TrackedFrame:
        """Make a tracked frame the next keyframe; it then hangs on itself, with the information of its tracking."""
        T_map_keyframe = self.keyframes[previous].T_map_keyframe @ result.T_reference_target
        new = len(self.keyframes)
        self.pairs.append(KeyframePair(previous, new, result.T_reference_target, result.information))
        self._register_to_neighbours(pyramid, previous, T_map_keyframe, new)
        self._add_keyframe(frame_index, stamp_ns, pyramid, previous, T_map_keyframe, result)
        self._current, self._T_keyframe_camera = new, np.eye(4)
        return TrackedFrame(
            frame_index,
            stamp_ns,
            new,
            np.eye(4),
            result.information,
            status,
            result.overlap,
            result.rms_depth_m,
            result.rms_gray,
        )

    def _register_to_neighbours(
        self, pyramid: RgbdPyramid, previous: int, T_map_keyframe: Array, new: int
    ) -> None:
        """Register a new keyframe to the earlier ones that see most of it, the one it was tracked from excepted."""
        limits = self.config.keyframes
        candidates = []
        for keyframe in self.keyframes:
            T_keyframe_new = se3.inverse(keyframe.T_map_keyframe) @ T_map_keyframe
            overlap = predicted_overlap(keyframe.reference, pyramid, T_keyframe_new)
            if keyframe.keyframe_index != previous and overlap >= limits.neighbour_overlap:
                candidates.append((-overlap, -keyframe.keyframe_index, T_keyframe_new))
        candidates.sort(key=lambda candidate: candidate[:2])
        for _, negative_index, guess in candidates[: limits.neighbours]:
            result = register(
                self.keyframes[-negative_index].reference, pyramid, guess, self.config.tracking.registration
            )
            if result.ok and result.overlap >= limits.neighbour_overlap:
                self.pairs.append(
                    KeyframePair(-negative_index, new, result.T_reference_target, result.information)
                )

    def _add_keyframe(
        self,
        frame_index: int,
        stamp_ns: int,
        pyramid: RgbdPyramid,
        previous: int,
        T_map_keyframe: Array,
        result: Registration | None,
    ) -> None:
        gain, offset = 1.0, 0.0
        if result is not None:
            gain_before, offset_before = self.keyframes[previous].exposure
            gain, offset = (
                result.exposure[0] * gain_before,
                result.exposure[0] * offset_before + result.exposure[1],
            )
        self.keyframes.append(
            TrackedKeyframe(
                len(self.keyframes),
                frame_index,
                stamp_ns,
                previous,
                T_map_keyframe,
                Reference.from_pyramid(pyramid, self.config.tracking.strides),
                (gain, offset),
            )
        )


def _tracked(
    frame_index: int, stamp_ns: int, keyframe_index: int, result: Registration, status: Status
) -> TrackedFrame:
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
    )
