"""Trackers to compare with: what they share is how keyframes are chosen and what is written down.

Such a tracker gives the pose of a frame in the map. Frames become keyframes by the limits of the usual tracking, so
that the map that follows has about as many; keyframes stay where they were tracked, one after the other, unless the
settings of their optimization say otherwise. There are no submaps: a frame without a pose is lost, and the next one is
predicted from the last pose that there is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.config.other_trackers import StatedInformationConfig
from duagc.pipeline.frontend.current_frame import features_of
from duagc.pipeline.frontend.failure import Reason
from duagc.pipeline.frontend.frame_images import RgbdImages
from duagc.pipeline.frontend.keyframe_graph import leaves_keyframe, predicted_overlap
from duagc.pipeline.frontend.submaps import TrackedLog, TrackedSubmap
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import RgbdFrame
from duagc.pipeline.registration import Reference, RgbdPyramid

ReadFrame = Callable[[int], RgbdFrame]
NUMBER = 1  # of the only submap


@dataclass(frozen=True)
class Placed:
    """Where a frame was found.

    Attributes:
        T_map_camera: [4, 4].
        rms_depth_m: depth residual.
        rms_gray: gray residual.
    """

    T_map_camera: Array
    rms_depth_m: float = 0.0
    rms_gray: float = 0.0


class OtherTracker(ABC):
    """Tracks one camera in one map. Feed it the frames in order."""

    def __init__(
        self,
        camera: PinholeCamera,
        config: FrontendConfig,
        read: ReadFrame,
        information: StatedInformationConfig,
    ) -> None:
        """Begin without a keyframe.

        Args:
            camera: of all frames.
            config: of the front end.
            read: gives a frame of the log by its index, to go on from a state.
            information: of the poses of frames in their keyframes.
        """
        self.camera, self.config, self.read = camera, config, read
        self._information = np.diag([information.sigma_m**-2.0] * 3 + [information.sigma_rad**-2.0] * 3)
        self._frames: list[TrackedFrame] = []
        self._keyframes: list[TrackedKeyframe] = []
        self._pairs: list[RelativePose] = []
        # time and T_map_camera of the last two frames, if none was lost between them
        self._last: list[tuple[int, Array]] = []

    @abstractmethod
    def place(self, images: RgbdImages, T_map_predicted: Array) -> Placed | Reason:
        """Where a frame is, or why that is not known.

        Args:
            images: of the frame.
            T_map_predicted: [4, 4], by constant velocity.
        """

    @abstractmethod
    def take(self, images: RgbdImages, T_map_camera: Array, keyframe: int | None) -> None:
        """Take a frame that has a pose into the map; never called with a frame that is held out.

        Args:
            images: of the frame.
            T_map_camera: [4, 4].
            keyframe: its index if it became one.
        """

    @abstractmethod
    def map_state(self) -> Any:
        """The map, for `go_on_with`; what follows from frames and keyframes need not be in it."""

    @abstractmethod
    def go_on_with(self, state: Any) -> None:
        """Go on from the map of another one; frames and keyframes are here already.

        Args:
            state: of that map.
        """

    def state(self) -> tuple[Any, ...]:
        """All that it knows; `go_on` takes it."""
        return self._frames, self._keyframes, self._pairs, self._last, self.map_state()

    def go_on(self, state: tuple[Any, ...]) -> None:
        """Go on from where another one was.

        Args:
            state: of that one.
        """
        self._frames, self._keyframes, self._pairs, self._last, of_map = state
        self.go_on_with(of_map)

    def path(self) -> Trajectory:
        """T_submap_camera of the frames so far."""
        placed = [frame for frame in self._frames if frame.status is not Status.LOST]
        stamps = np.array([frame.stamp_ns for frame in placed], dtype=np.int64)
        return Trajectory(stamps, np.array([self.pose_of(frame) for frame in placed]).reshape(-1, 4, 4))

    def pose_of(self, frame: TrackedFrame) -> Array:
        """T_map_camera [4, 4] of a frame that has a pose.

        Args:
            frame: as it was tracked.
        """
        return self._keyframes[frame.keyframe_index].T_map_keyframe @ frame.T_keyframe_camera

    def track(self, images: RgbdImages) -> None:
        """Track one frame; the first that can be used becomes keyframe 0 and the origin of the map.

        Args:
            images: of the frame; its time increases.
        """
        tracking = self.config.tracking
        pyramid = RgbdPyramid.build(
            images.image,
            images.depth_m,
            self.camera,
            len(tracking.strides),
            depth_sigma_m=images.depth_sigma_m,
            mask=images.mask,
        )
        if self._keyframes:
            placed = self.place(images, self._predicted(images.stamp_ns))
        else:
            placed = self._first(images, pyramid)
        if isinstance(placed, Reason):
            self._lose(images, placed)
            return
        self._add(images, pyramid, placed)

    def finish(self) -> TrackedLog:
        """All frames and the only submap."""
        submap = TrackedSubmap(NUMBER, self._keyframes, self._pairs)
        return TrackedLog(self._frames, [NUMBER] * len(self._frames), [submap])

    def _predicted(self, stamp_ns: int) -> Array:
        """T_map_camera [4, 4] by constant velocity; where it was if that is unknown."""
        last_ns, T_map_last = self._last[-1]
        if len(self._last) < 2:
            return T_map_last
        before_ns, T_map_before = self._last[-2]
        share = (stamp_ns - last_ns) / max(last_ns - before_ns, 1)
        if not 0 < share <= self.config.tracking.failure.gap_intervals:
            return T_map_last
        return np.asarray(T_map_last @ se3.exp(share * se3.log(se3.inverse(T_map_before) @ T_map_last)))

    def _first(self, images: RgbdImages, pyramid: RgbdPyramid) -> Placed | Reason:
        """The first keyframe, where the frame is none that is held out and has depth enough."""
        least = self.config.tracking.registration.min_samples
        reference = Reference.from_pyramid(pyramid, self.config.tracking.strides)
        usable = self._may_be_keyframe(images) and len(reference.levels[0]) >= least
        return Placed(np.eye(4)) if usable else Reason.NO_DEPTH

    def _may_be_keyframe(self, images: RgbdImages) -> bool:
        near = abs(images.depth_offset_ns) * 1e-9 <= self.config.keyframes.max_depth_offset_s
        return near and not is_held_out(images.frame_index)

    def _lose(self, images: RgbdImages, reason: Reason) -> None:
        """A frame without a pose: it keeps the last known one, with zero information."""
        del self._last[:-1]
        last = self._keyframes[-1] if self._keyframes else None
        at = se3.inverse(last.T_map_keyframe) @ self._last[-1][1] if last is not None else np.eye(4)
        self._frames.append(
            self._frame(images, len(self._keyframes) - 1 if last is not None else 0, at, reason=reason)
        )

    def _add(self, images: RgbdImages, pyramid: RgbdPyramid, placed: Placed) -> None:
        """A frame with a pose, which becomes a keyframe if it leaves the last one."""
        T_map_camera, overlap, new = placed.T_map_camera, 1.0, not self._keyframes
        if not new:
            keyframe = self._keyframes[-1]
            T_keyframe_camera = se3.inverse(keyframe.T_map_keyframe) @ T_map_camera
            overlap = predicted_overlap(keyframe.reference, pyramid, T_keyframe_camera)
            new = self._may_be_keyframe(images) and leaves_keyframe(
                overlap, T_keyframe_camera, pyramid, self.config.keyframes
            )
        if new:
            self._insert(images, pyramid, T_map_camera)
            T_keyframe_camera = np.eye(4)
        index = len(self._keyframes) - 1
        self._frames.append(self._frame(images, index, T_keyframe_camera, placed=placed, overlap=overlap))
        self._last = [*self._last[-1:], (images.stamp_ns, T_map_camera)]
        if not is_held_out(images.frame_index):
            self.take(images, T_map_camera, index if new else None)

    def _frame(
        self,
        images: RgbdImages,
        keyframe: int,
        T_keyframe_camera: Array,
        *,
        placed: Placed | None = None,
        overlap: float = 0.0,
        reason: Reason = Reason.NONE,
    ) -> TrackedFrame:
        return TrackedFrame(
            frame_index=images.frame_index,
            stamp_ns=images.stamp_ns,
            keyframe_index=keyframe,
            T_keyframe_camera=T_keyframe_camera,
            information=np.zeros((6, 6)) if placed is None else self._information,
            status=Status.LOST if placed is None else Status.OK,
            overlap=overlap,
            rms_depth_m=0.0 if placed is None else placed.rms_depth_m,
            rms_gray=0.0 if placed is None else placed.rms_gray,
            reason=reason,
        )

    def _insert(self, images: RgbdImages, pyramid: RgbdPyramid, T_map_keyframe: Array) -> None:
        """Make a frame the next keyframe, tied to the one before."""
        new = len(self._keyframes)
        if new:
            T_previous_new = se3.inverse(self._keyframes[-1].T_map_keyframe) @ T_map_keyframe
            self._pairs.append(RelativePose(new - 1, new, T_previous_new, self._information))
        tracking = self.config.tracking
        reference, features, coarsest = SHELF.put(
            (
                Reference.from_pyramid(pyramid, tracking.strides),
                features_of(pyramid, tracking.relocalization),
                pyramid.levels[-1],
            )
        )
        self._keyframes.append(
            TrackedKeyframe(
                keyframe_index=new,
                frame_index=images.frame_index,
                stamp_ns=images.stamp_ns,
                previous_index=new - 1,
                T_map_keyframe=T_map_keyframe,
                reference=reference,
                features=features,
                coarsest=coarsest,
                seen=coarsest,
            )
        )
