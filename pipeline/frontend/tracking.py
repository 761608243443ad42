"""Tracking of one RGB-D camera, frame to keyframe, without rendering.

Every frame is registered to the latest keyframe from a constant-velocity guess, and the result is checked. If that
fails, it is tried again from other starts and with wider gates. If all fail the frame is `lost`, with the reason in the
log. A lost camera is searched for where it was last, and among all keyframes by features; such a place counts
only when the next frame agrees.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.frontend import FrontendConfig, is_held_out
from duagc.pipeline.frontend.color_only import LastGoodFrame
from duagc.pipeline.frontend.failure import (
    Reason,
    has_enough_depth,
    saturated_share,
    shows_anything,
)
from duagc.pipeline.frontend.feature_initialization import initial_motions
from duagc.pipeline.frontend.frame_images import Image, RgbdImages
from duagc.pipeline.frontend.keyframe_graph import becomes_keyframe
from duagc.pipeline.frontend.keyframe_insertion import insert_first_keyframe, insert_keyframe
from duagc.pipeline.frontend.pose_checks import (
    FOLLOWED,
    FOUND_BY_FEATURES,
    FOUND_NEARBY,
    PLAUSIBLE,
    PoseCheck,
    verify,
)
from duagc.pipeline.frontend.relocalization import Relocalizer
from duagc.pipeline.frontend.stable_registration import register_until_stable
from duagc.pipeline.frontend.tracked import Status, TrackedFrame, TrackedKeyframe
from duagc.pipeline.frontend.tracking_state import CurrentFrame, PoseCandidate, TrackingState
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import MotionPrior
from duagc.pipeline.recording.depth_sources import DepthImage
from duagc.pipeline.recording.moved_depth import move_depth
from duagc.pipeline.registration import Reference, Registration, RgbdPyramid, register


class Tracker:
    """Tracks one camera. Feed it the frames in order."""

    def __init__(
        self, camera: PinholeCamera, config: FrontendConfig, motion: MotionPrior | None = None
    ) -> None:
        """Begin without a keyframe.

        Args:
            camera: of all frames.
            config: of the front end.
            motion: how the camera moved by other sensors, where the log has any.
        """
        self.camera = camera
        self.state = TrackingState(config, motion)
        self._relocalizer = Relocalizer()

    @property
    def keyframes(self) -> list[TrackedKeyframe]:
        """All keyframes so far."""
        return self.state.keyframes

    @property
    def pairs(self) -> list[RelativePose]:
        """Registrations between keyframes, for `keyframe_graph.solve_pose_graph`."""
        return self.state.pairs

    def copied(self, config: FrontendConfig | None = None) -> Tracker:
        """A tracker that goes on from the same state, independently of this one.

        Args:
            config: of the copy; None: the same.
        """
        other = copy.copy(self)
        other.state, other._relocalizer = self.state.copied(config), copy.copy(self._relocalizer)
        return other

    def track(
        self,
        frame_index: int,
        stamp_ns: int,
        image: Image,
        depth_m: Image,
        *,
        mask: NDArray[np.bool_] | None = None,
        depth_sigma_m: Image | None = None,
        depth_offset_ns: int = 0,
        depth_moved: bool = False,
    ) -> TrackedFrame:
        """Track one frame; the first that can be used becomes keyframe 0 and the origin of the map.

        Args:
            frame_index: in the log.
            stamp_ns: time of the frame, increasing.
            image: color [h, w, 3] or gray [h, w], 0..1.
            depth_m: [h, w], meters, 0 = unknown.
            mask: as of `RgbdImages`.
            depth_sigma_m: as of `RgbdImages`.
            depth_offset_ns: how much later the depth was taken.
            depth_moved: as of `RgbdImages`.
        """
        return self.track_frame(
            self.prepared(
                RgbdImages(
                    frame_index=frame_index,
                    stamp_ns=stamp_ns,
                    image=image,
                    depth_m=depth_m,
                    mask=mask,
                    depth_sigma_m=depth_sigma_m,
                    depth_offset_ns=depth_offset_ns,
                    depth_moved=depth_moved,
                )
            )
        )

    def prepared(self, images: RgbdImages) -> CurrentFrame:
        """A frame with all that tracking needs; the state does not change.

        Args:
            images: of the frame.
        """
        tracking, offset_ns = self.state.config.tracking, images.depth_offset_ns
        depth = DepthImage(images.depth_m, images.depth_sigma_m)
        if not images.depth_moved and not self._is_near(offset_ns):
            T_color_depth = self.state.depth_motion(images.stamp_ns, offset_ns)
            if T_color_depth is None:
                depth = DepthImage(np.zeros_like(images.depth_m), images.depth_sigma_m)
            else:
                depth = move_depth(depth, self.camera, T_color_depth)
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
        missing = self._missing_image(frame)
        if missing is Reason.NONE and not state.keyframes:
            return self._initialize(frame)
        found = self._locate(frame, missing)
        return self._mark_lost(frame, found) if isinstance(found, Reason) else self._accept(frame, found)

    def _locate(self, frame: CurrentFrame, missing: Reason) -> PoseCandidate | Reason:
        """Where a frame is, or why that is not known.

        Args:
            frame: the current frame.
            missing: which of its images cannot be used, if any.
        """
        if missing is Reason.NO_PIXEL:
            return missing
        if missing is Reason.FROZEN_COLOR:
            return self._follow_by_depth(frame)
        if missing is not Reason.NONE:
            return self._follow_by_color(frame, missing)
        if not self.state.is_long_lost(frame.stamp_ns):
            return self._register_nearby(frame)
        return self._relocalizer.locate(self.state, frame, lambda: self._register_nearby(frame))

    # --- which images can be used ---------------------------------------------------------------------------------

    def _missing_image(self, frame: CurrentFrame) -> Reason:
        """NO_PIXEL, FROZEN_COLOR, FROZEN_DEPTH, NO_DEPTH or NONE; counts the frames in a row."""
        state = self.state
        if not shows_anything(frame.pyramid, state.config.tracking.failure):
            return Reason.NO_PIXEL
        frozen = state.frozen.update(frame.pyramid)
        if frozen is Reason.FROZEN_COLOR:
            state.frames_without_color += 1
            return frozen
        state.frames_without_color = 0
        enough = has_enough_depth(frame.pyramid, state.config.tracking.registration)
        missing = frozen if enough else Reason.NO_DEPTH
        state.frames_without_depth = 0 if missing is Reason.NONE else state.frames_without_depth + 1
        return missing

    def _follow_by_color(self, frame: CurrentFrame, missing: Reason) -> PoseCandidate | Reason:
        """Follow a frame without depth by its color alone, for a while, if it looks as frames did before."""
        state, failure = self.state, self.state.config.tracking.failure
        too_many = state.frames_without_depth > failure.max_frames_without_depth
        if too_many or state.lost or state.occlusion.active or state.last_good is None:
            return missing
        result = state.register_color(frame)
        followed = result.ok and state.looks_as_usual(result)
        return PoseCandidate(state.keyframe_index, result, missing) if followed else missing

    def _follow_by_depth(self, frame: CurrentFrame) -> PoseCandidate | Reason:
        """Follow a frame with frozen color by its depth alone, for a few frames: on walls it drifts soon."""
        state, tracking = self.state, self.state.config.tracking
        too_many = state.frames_without_color > tracking.failure.max_frames_without_color
        if too_many or state.lost or not state.keyframes:
            return Reason.FROZEN_COLOR
        predicted = state.predict(frame.stamp_ns)
        depth_only = tracking.registration.model_copy(update={"residuals": "depth"})
        result = register(
            state.keyframe.reference,
            frame.pyramid,
            predicted.T_keyframe_camera,
            depth_only,
            prior_information=predicted.information,
        )
        return (
            PoseCandidate(state.keyframe_index, result, Reason.FROZEN_COLOR)
            if result.ok
            else Reason.FROZEN_COLOR
        )

    # --- predict, register, verify --------------------------------------------------------------------------------

    def _register_nearby(self, frame: CurrentFrame) -> PoseCandidate | Reason:
        """The first registration near the last pose that passes its checks, or why the first one failed."""
        reason = Reason.NONE
        for candidate, checks in self._attempts(frame):
            found = verify(checks, self.state, frame, candidate)
            if isinstance(found, PoseCandidate):
                return found
            reason = reason if reason is not Reason.NONE else found
        return reason

    def _attempts(self, frame: CurrentFrame) -> Iterator[tuple[PoseCandidate, Sequence[PoseCheck]]]:
        """Registrations near the last pose, each with its checks.

        From the prediction, from the motion that features agree on, then with wider gates. Where the prediction is
        weak, features come first and may outweigh what looks unlike, and color alone, which starts from it, is no
        check. Where it is not, what looks unlike is another place.
        """
        state, tracking, index = self.state, self.state.config.tracking, self.state.keyframe_index
        last, predicted = state.T_keyframe_camera, state.predict(frame.stamp_ns)
        weak = predicted.sigma_px > tracking.prior.max_deviation_px and not state.lost
        starts = [predicted.T_keyframe_camera]
        if predicted.T_keyframe_camera is not last:
            starts.append(last)
        if weak:
            yield from self._from_features(frame)
        if not state.lost:
            for start in starts:
                information = predicted.information if start is predicted.T_keyframe_camera else None
                result = register(
                    state.keyframe.reference,
                    frame.pyramid,
                    start,
                    tracking.registration,
                    prior_information=information,
                )
                yield PoseCandidate(index, result), PLAUSIBLE if weak else FOLLOWED
        if not weak:
            for index, guess in initial_motions(state, frame):
                result = register_until_stable(
                    state.keyframes[index], frame.pyramid, guess, tracking, first=tracking.registration
                )
                yield PoseCandidate(index, result), FOUND_NEARBY
        for start in starts:
            result = register_until_stable(
                state.keyframe, frame.pyramid, start, tracking, first=tracking.recovery
            )
            yield PoseCandidate(index, result), PLAUSIBLE if weak else FOUND_NEARBY

    def _from_features(self, frame: CurrentFrame) -> Iterator[tuple[PoseCandidate, Sequence[PoseCheck]]]:
        """Registrations from the motion that features agree on, each with its checks."""
        state, tracking = self.state, self.state.config.tracking.verified_by_features()
        for index, guess in initial_motions(state, frame):
            result = register_until_stable(
                state.keyframes[index], frame.pyramid, guess, tracking, first=tracking.registration
            )
            yield PoseCandidate(index, result), FOUND_BY_FEATURES

    # --- update ---------------------------------------------------------------------------------------------------

    def _initialize(self, frame: CurrentFrame) -> TrackedFrame:
        """Make the first keyframe, unless the frame is held out or shows too little surface."""
        state, tracking = self.state, self.state.config.tracking
        reference = Reference.from_pyramid(frame.pyramid, tracking.strides)
        used = reference.levels[: len(tracking.registration.iterations)]
        too_little = any(len(level) < tracking.registration.min_samples for level in used)
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
        """Pose and velocity, and the usual gray residual."""
        state, result = self.state, found.result
        same_keyframe = found.keyframe_index == state.keyframe_index
        followed = same_keyframe and not state.lost and state.elapsed_s(frame.stamp_ns) > 0
        # a stamp that came late makes the next interval too short
        elapsed_s = max(state.elapsed_s(frame.stamp_ns), 0.5 * state.intervals.median_s)
        step = se3.inverse(state.T_keyframe_camera) @ result.T_reference_target
        state.velocity = se3.log(step) / elapsed_s if followed else np.zeros(6)
        if followed and found.without is Reason.NONE and not len(result.weak):
            state.compare_gyro(frame.stamp_ns, step[:3, :3])
        if not same_keyframe:
            state.last_good = None
        gain = float(result.exposure[0])
        state.gain_step, state.gain = gain / state.gain if followed else math.inf, gain
        state.keyframe_index, state.T_keyframe_camera = found.keyframe_index, result.T_reference_target
        state.stamp_ns, state.lost = frame.stamp_ns, False
        state.remember_pose()
        self._relocalizer.reset()
        if followed and found.without is Reason.NONE:
            frames = state.config.tracking.failure.usual_frames
            state.gray_rms = [*state.gray_rms[1 - frames :], result.rms_gray]

    def _update_view(self, frame: CurrentFrame, found: PoseCandidate) -> None:
        """What is in front of the camera, by a frame with depth and color; and the last good frame."""
        state = self.state
        state.depth_color_inconsistent = False
        state.occlusion.update(frame.pyramid.levels[-1], state.viewpoint(found))
        if not (found.unlike or state.occlusion.active):
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
            and not self.state.occlusion.active
        )

    def _is_near(self, depth_offset_ns: int) -> bool:
        """Whether depth was taken so near in time to its color that others may be registered to it."""
        return abs(depth_offset_ns) * 1e-9 <= self.state.config.keyframes.max_depth_offset_s

    def _is_well_exposed(self, pyramid: RgbdPyramid, result: Registration) -> bool:
        """Whether a frame looks as its keyframe does; or, hardly saturated, leaves it or drifts from its exposure.

        Where the exposure jumps, too dark and too bright images pass. They make poor keyframes.
        """
        if self.state.looks_as_usual(result):
            return True
        tracking = self.state.config.tracking
        leaving = min(result.overlap, result.view) < tracking.relocalization.min_overlap
        return (leaving or self.state.drifts(result)) and saturated_share(
            pyramid.levels[0]
        ) <= tracking.max_saturated

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
