"""Tracking of one RGB-D camera, frame to keyframe, without rendering.

Every frame is registered to the latest keyframe from a constant-velocity guess, and the result is checked. If that
fails, it is tried again from other starts and with wider gates. If all fail the frame is `lost`, with the reason in the
log. A lost camera is searched for where it was last, and among all keyframes by features; such a place counts
only when the next frame agrees.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np

from duagc.pipeline.base.held_out import is_held_out
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend.color_only import LastGoodFrame
from duagc.pipeline.frontend.current_frame import CurrentFrame, PoseCandidate
from duagc.pipeline.frontend.failure import Reason, saturated_share, saturated_share_of
from duagc.pipeline.frontend.frame_images import RgbdImages
from duagc.pipeline.frontend.keyframe_graph import becomes_keyframe
from duagc.pipeline.frontend.keyframe_insertion import insert_first_keyframe, insert_keyframe
from duagc.pipeline.frontend.missing_images import count_missing_image, follow_by_color, follow_by_depth
from duagc.pipeline.frontend.occluded_frames import register_visible
from duagc.pipeline.frontend.relocalization import Relocalizer
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe
from duagc.pipeline.frontend.tracking_state import TrackingState
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import MotionPrior
from duagc.pipeline.recording.depth_sources import DepthImage
from duagc.pipeline.recording.moved_depth import move_depth
from duagc.pipeline.registration import Reference, Registration, RgbdPyramid

MOST_REPEATS = 3
"""Frames in a row that come again because a driver lost some; with more of them the camera stands still."""


class Tracker:
    """Tracks one camera. Feed it the frames in order."""

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
            max_depth_offset_s: by which depth may be earlier or later than its color, of a frame that others are
                registered to; None: as configured.
        """
        self.camera = camera
        self.state = TrackingState(config, motion, max_depth_offset_s=max_depth_offset_s)
        self._relocalizer = Relocalizer()

    @property
    def keyframes(self) -> list[TrackedKeyframe]:
        """All keyframes so far."""
        return self.state.keyframes

    @property
    def pairs(self) -> list[RelativePose]:
        """Registrations between keyframes, for `keyframe_graph.solve_pose_graph`."""
        return self.state.pairs

    def alike(self, frame: CurrentFrame) -> list[TrackedKeyframe]:
        """Keyframes that may show what a frame shows: all of few, else those that share most rare words with it.

        Args:
            frame: the frame.
        """
        return [self.keyframes[k] for k in self._relocalizer.alike(self.state, frame)]

    def copied(self, config: FrontendConfig | None = None) -> Tracker:
        """A tracker that goes on from the same state, independently of this one.

        Args:
            config: of the copy; None: the same.
        """
        other = copy.copy(self)
        other.state, other._relocalizer = self.state.copied(config), copy.copy(self._relocalizer)
        return other

    def track(self, images: RgbdImages) -> TrackedFrame:
        """Track one frame; the first that can be used becomes keyframe 0 and the origin of the map.

        Args:
            images: of the frame; stamps increase.
        """
        return self.track_frame(self.prepared(images))

    def prepared(self, images: RgbdImages) -> CurrentFrame:
        """A frame with all that tracking needs; the state does not change.

        Args:
            images: of the frame.
        """
        tracking, offset_ns = self.state.config.tracking, images.depth_offset_ns
        depth = DepthImage(images.depth_m, images.depth_sigma_m)
        if not images.depth_moved and abs(offset_ns) * 1e-9 > self.state.config.keyframes.max_depth_offset_s:
            T_color_depth = self.state.depth_motion(images.stamp_ns, offset_ns)
            if T_color_depth is not None:
                depth = move_depth(depth, self.camera, T_color_depth)
            elif not self._is_near(offset_ns):
                depth = DepthImage(np.zeros_like(images.depth_m), images.depth_sigma_m)
        pyramid = RgbdPyramid.build(
            images.image,
            depth.depth_m,
            self.camera,
            len(tracking.strides),
            depth_sigma_m=depth.sigma_m,
            mask=images.mask,
        )
        return CurrentFrame(images.frame_index, images.stamp_ns, pyramid, tracking.relocalization, offset_ns)

    def track_frame(self, frame: CurrentFrame) -> TrackedFrame:
        """Track one frame; several trackers of the same settings may take it.

        Args:
            frame: of `prepared`.
        """
        state = self.state
        state.intervals.update(frame.stamp_ns)
        state.lost = state.lost or state.is_after_gap(frame.stamp_ns)
        missing = count_missing_image(state, frame)
        if missing is Reason.NONE and not state.keyframes:
            return self._initialize(frame)
        frame, found = self._locate(frame, missing)
        tracked = self._mark_lost(frame, found) if isinstance(found, Reason) else self._accept(frame, found)
        return replace(tracked, repeats=True) if state.frozen.repeats else tracked

    def _locate(self, frame: CurrentFrame, missing: Reason) -> tuple[CurrentFrame, PoseCandidate | Reason]:
        """A frame, without what an object hides of it, and where it is, or why that is not known.

        Args:
            frame: the current frame.
            missing: which of its images cannot be used, if any.
        """
        state = self.state
        if missing is Reason.NONE and not state.is_long_lost(frame.stamp_ns):
            return register_visible(state, frame)
        return frame, self._locate_whole(frame, missing)

    def _locate_whole(self, frame: CurrentFrame, missing: Reason) -> PoseCandidate | Reason:
        """Where a frame is that is not registered near the last pose, or why that is not known."""
        if missing is Reason.NO_PIXEL:
            return missing
        if missing is Reason.FROZEN_COLOR:
            return follow_by_depth(self.state, frame)
        if missing is not Reason.NONE:
            return follow_by_color(self.state, frame, missing)
        return self._relocalizer.locate(self.state, frame)

    def _initialize(self, frame: CurrentFrame) -> TrackedFrame:
        """Make the first keyframe, unless the frame is held out or shows too little surface."""
        state, tracking = self.state, self.state.config.tracking
        reference = Reference.from_pyramid(frame.pyramid, tracking.strides)
        # a registration passes over coarser levels that show too little
        too_little = len(reference.levels[0]) < tracking.registration.min_samples
        if is_held_out(frame.frame_index) or too_little or not self._is_near(frame.depth_offset_ns):
            return self._mark_lost(frame, Reason.NO_DEPTH)
        insert_first_keyframe(state, frame, reference)
        state.stamp_ns, state.lost = frame.stamp_ns, False
        state.remember_pose()
        state.last_good = LastGoodFrame(frame.pyramid, tracking.strides, np.eye(4), None)
        return TrackedFrame(
            frame_index=frame.frame_index,
            stamp_ns=frame.stamp_ns,
            keyframe_index=0,
            T_keyframe_camera=np.eye(4),
            information=np.zeros((6, 6)),
            status=Status.OK,
            overlap=1.0,
            rms_depth_m=0.0,
            rms_gray=0.0,
        )

    def _mark_lost(self, frame: CurrentFrame, reason: Reason) -> TrackedFrame:
        """A frame without a pose: it keeps the last known one, with zero information."""
        self.state.lost = True
        self.state.recent = []
        self.state.occlusion.carry(
            frame.whole or frame.pyramid.levels[-1], self.state.config.moving.min_region
        )
        return TrackedFrame(
            frame_index=frame.frame_index,
            stamp_ns=frame.stamp_ns,
            keyframe_index=self.state.keyframe_index,
            T_keyframe_camera=self.state.T_keyframe_camera,
            information=np.zeros((6, 6)),
            status=Status.LOST,
            overlap=0.0,
            rms_depth_m=0.0,
            rms_gray=0.0,
            reason=reason,
        )

    def _accept(self, frame: CurrentFrame, found: PoseCandidate) -> TrackedFrame:
        """Update the state by the pose of a frame; it becomes a keyframe if it sees much that is new."""
        status = Status.RELOCALIZED if self.state.lost else Status.OK
        self._update_motion(frame, found)
        if found.without is Reason.NONE:
            self._update_view(frame, found)
        if self._becomes_keyframe(frame, found):
            return self._promote(frame, found, status)
        return TrackedFrame.by(
            frame.frame_index,
            frame.stamp_ns,
            keyframe_index=found.keyframe_index,
            result=found.result,
            status=status,
            reason=found.without,
        )

    def _update_motion(self, frame: CurrentFrame, found: PoseCandidate) -> None:
        """Pose and velocity, and the usual gray residual. A frame that comes again was taken when it came first."""
        state, result = self.state, found.result
        same_keyframe = found.keyframe_index == state.keyframe_index
        followed = same_keyframe and not state.lost and state.elapsed_s(frame.stamp_ns) > 0
        if followed and 0 < state.frozen.repeats <= MOST_REPEATS and not len(result.weak):
            state.T_keyframe_camera = result.T_reference_target
            return
        # a stamp that came late makes the next interval too short
        elapsed_s = max(state.elapsed_s(frame.stamp_ns), 0.5 * state.intervals.median_s)
        step = se3.inverse(state.T_keyframe_camera) @ result.T_reference_target
        state.velocity = se3.log(step) / elapsed_s if followed else np.zeros(6)
        if followed and found.without is Reason.NONE and not len(result.weak):
            state.compare_gyro(frame.stamp_ns, step[:3, :3])
        if not same_keyframe:
            state.last_good = None
        if found.without is Reason.NONE:  # by color alone, it is relative to the last good frame
            gain = float(result.exposure[0])
            state.gain_step, state.gain = gain / state.gain if followed else math.inf, gain
        state.keyframe_index, state.T_keyframe_camera = found.keyframe_index, result.T_reference_target
        state.stamp_ns, state.lost = frame.stamp_ns, False
        state.remember_pose()
        self._relocalizer.reset()
        if followed and found.without is Reason.NONE:
            state.gray_rms.add(result.rms_gray)

    def _update_view(self, frame: CurrentFrame, found: PoseCandidate) -> None:
        """What is in front of the camera, by a frame with depth and color; and the last good frame."""
        state = self.state
        state.depth_color_inconsistent = False
        view, viewpoint = frame.pyramid.levels[-1], state.viewpoint(found)
        if frame.hidden is None or frame.whole is None:
            state.occlusion.carry(view, state.config.moving.min_region)
            state.occlusion.update(view, viewpoint, frame.seen)
        else:
            state.occlusion.update_by(frame.hidden, view, viewpoint, frame.whole)
        if not (found.unlike or (state.occlusion.active and frame.hidden is None)):
            state.last_good = LastGoodFrame(
                frame.pyramid,
                state.config.tracking.strides,
                found.result.T_reference_target,
                found.result.information,
            )

    def _becomes_keyframe(self, frame: CurrentFrame, found: PoseCandidate) -> bool:
        return (
            not is_held_out(frame.frame_index)
            and found.without is Reason.NONE
            and self._is_near(frame.depth_offset_ns)
            and becomes_keyframe(found.result, frame.pyramid, self.state.config.keyframes)
            and self._is_well_exposed(frame.pyramid, found.result)
            and (frame.hidden is not None or self._is_unoccluded(found.result))
        )

    def _is_unoccluded(self, result: Registration) -> bool:
        """Whether no object is in front of the camera.

        Where a camera goes on, most of its view can no more be judged, and an object never be seen to be gone. A frame
        that leaves its keyframe then becomes one if nothing in it is in free space: else the camera would be lost.
        """
        occlusion = self.state.occlusion
        leaving = min(result.overlap, result.view) < self.state.config.tracking.relocalization.min_overlap
        return not occlusion.active or (leaving and not occlusion.occluded)

    def _is_near(self, depth_offset_ns: int) -> bool:
        """Whether depth was taken so near in time to its color that others may be registered to it."""
        limit_s = self.state.max_depth_offset_s
        if limit_s is None:
            limit_s = self.state.config.keyframes.max_depth_offset_s
        return abs(depth_offset_ns) * 1e-9 <= limit_s

    def _is_well_exposed(self, pyramid: RgbdPyramid, result: Registration) -> bool:
        """Whether a frame looks as its keyframe does; or, hardly more saturated, leaves it or drifts from its exposure.

        Where the exposure jumps, too dark and too bright images pass. They make poor keyframes. In a dark place all
        images are partly black.
        """
        if self.state.looks_as_usual(result):
            return True
        tracking, samples = self.state.config.tracking, self.state.keyframe.reference.levels[0]
        leaving = min(result.overlap, result.view) < tracking.relocalization.min_overlap
        if not (leaving or self.state.drifts(result)):
            return False
        before = saturated_share_of(samples.intensities)
        return saturated_share(pyramid.levels[0]) - before <= tracking.max_saturated

    def _promote(self, frame: CurrentFrame, found: PoseCandidate, status: Status) -> TrackedFrame:
        """Make a tracked frame the next keyframe; then anchored to itself, with the information of its tracking."""
        state = self.state
        new = insert_keyframe(state, frame, found)
        state.keyframe_index, state.T_keyframe_camera, state.gain = new, np.eye(4), 1.0
        state.last_good = LastGoodFrame(frame.pyramid, state.config.tracking.strides, np.eye(4), None)
        tracked = TrackedFrame.by(
            frame.frame_index, frame.stamp_ns, keyframe_index=new, result=found.result, status=status
        )
        return replace(tracked, T_keyframe_camera=np.eye(4))
