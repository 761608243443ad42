"""What a tracker remembers between frames, and what follows from it."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.config.frontend import FrontendConfig, RelocalizationConfig
from duagc.pipeline.frontend.color_only import LastGoodFrame
from duagc.pipeline.frontend.failure import (
    FrameIntervals,
    FrozenImageDetector,
    OcclusionDetector,
    Reason,
    Viewpoint,
)
from duagc.pipeline.frontend.tracked import TrackedKeyframe
from duagc.pipeline.geometry import se3
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import MotionPrior
from duagc.pipeline.registration import Registration, RgbdPyramid
from duagc.pipeline.registration.features import Features, extract_from_pyramid

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CurrentFrame:
    """The frame that is being tracked.

    Attributes:
        frame_index: in the log.
        stamp_ns: its time.
        pyramid: its images.
        relocalization: how its features are extracted.
    """

    frame_index: int
    stamp_ns: int
    pyramid: RgbdPyramid
    relocalization: RelocalizationConfig

    @cached_property
    def features(self) -> Features:
        """Its features; computed when first needed."""
        return features_of(self.pyramid, self.relocalization)


def features_of(pyramid: RgbdPyramid, config: RelocalizationConfig) -> Features:
    """The features by which a frame is relocalized, and to which it is compared as a keyframe.

    Args:
        pyramid: images of the frame.
        config: number of features and size of the image.
    """
    return extract_from_pyramid(pyramid, config.max_width_px, config.features)


@dataclass(frozen=True)
class PoseCandidate:
    """A registration of the current frame to a keyframe that is not accepted yet.

    Attributes:
        keyframe_index: the keyframe.
        result: the registration.
        without: why only its color, or only its depth, was used.
        unlike: whether it looked unlike the keyframe, and color alone confirmed it.
    """

    keyframe_index: int
    result: Registration
    without: Reason = Reason.NONE
    unlike: bool = False


@dataclass(frozen=True)
class Prediction:
    """Where the camera should be.

    Attributes:
        T_keyframe_camera: [4, 4], in the keyframe that frames are tracked against.
        information: [6, 6] of its right tangent, from the motion prior of the log; None: it is no measurement.
    """

    T_keyframe_camera: Array
    information: Array | None


@dataclass
class TrackingState:
    """What a tracker knows of the camera.

    Attributes:
        config: of the front end.
        motion: how the camera moved by other sensors, where the log has any.
        keyframes: all of them.
        pairs: registrations between keyframes.
        keyframe_index: the keyframe that frames are tracked against.
        T_keyframe_camera: [4, 4], of the last frame that was tracked.
        stamp_ns: time of that frame.
        velocity: [6], right tangent per second, of the two frames before; zero after a loss.
        lost: whether the last frame has no pose.
        gray_rms: gray residuals of the last frames that were followed.
        depth_color_inconsistent: whether depth and color disagreed, and nothing has resolved it since.
        frames_without_depth: in a row, up to the current one.
        frames_without_color: the same for color.
        last_good: the last frame with depth and color and nothing in front of it.
        intervals: between frames.
        frozen: detects frozen images.
        occlusion: detects objects in front of the camera.
    """

    config: FrontendConfig
    motion: MotionPrior | None = None
    keyframes: list[TrackedKeyframe] = field(default_factory=list)
    pairs: list[RelativePose] = field(default_factory=list)
    keyframe_index: int = 0
    T_keyframe_camera: Array = field(default_factory=lambda: np.eye(4))
    stamp_ns: int = 0
    velocity: Array = field(default_factory=lambda: np.zeros(6))
    lost: bool = False
    gray_rms: list[float] = field(default_factory=list)
    depth_color_inconsistent: bool = False
    frames_without_depth: int = 0
    frames_without_color: int = 0
    last_good: LastGoodFrame | None = None
    intervals: FrameIntervals = field(init=False)
    frozen: FrozenImageDetector = field(init=False)
    occlusion: OcclusionDetector = field(init=False)

    def __post_init__(self) -> None:
        self.intervals = FrameIntervals(self.config.tracking.failure.interval_frames)
        self.frozen = FrozenImageDetector(self.config.tracking.failure)
        self.occlusion = OcclusionDetector(self.config.tracking.failure)

    def copied(self, config: FrontendConfig | None = None) -> TrackingState:
        """The same state, to go on from independently; what was measured is shared, for it never changes.

        Args:
            config: from now on; None: the same.
        """
        config = config or self.config
        other = replace(
            self,
            config=config,
            keyframes=list(self.keyframes),
            pairs=list(self.pairs),
            gray_rms=list(self.gray_rms),
        )
        other.intervals = copy.copy(self.intervals)
        other.frozen, other.occlusion = copy.copy(self.frozen), copy.copy(self.occlusion)
        other.frozen.config = other.occlusion.config = config.tracking.failure
        return other

    @property
    def keyframe(self) -> TrackedKeyframe:
        """The keyframe that frames are tracked against."""
        return self.keyframes[self.keyframe_index]

    def elapsed_s(self, stamp_ns: int) -> float:
        """Time since the last frame that was tracked, seconds.

        Args:
            stamp_ns: now.
        """
        return (stamp_ns - self.stamp_ns) * 1e-9

    def predict(self, stamp_ns: int) -> Prediction:
        """Where the camera should be at a time.

        By the motion prior of the log, else by the last velocity if that is not too old, which is no measurement,
        else where it was.

        Args:
            stamp_ns: the time.
        """
        last, elapsed_s = self.T_keyframe_camera, self.elapsed_s(stamp_ns)
        fresh = elapsed_s <= self.config.tracking.max_extrapolation_s
        followed = last @ se3.exp(self.velocity * elapsed_s) if fresh else last
        motion = self.motion.between(self.stamp_ns, stamp_ns) if self.motion is not None else None
        if motion is None:
            return Prediction(followed, None)
        config, T = self.config.tracking.prior, motion.T_start_stop
        path_m, angle_rad = se3.distance(np.eye(4), T)
        if motion.knows_translation:
            sigma_m = config.odometry_sigma_m + config.odometry_sigma_of_path * float(path_m)
            sigma_rad = config.odometry_sigma_rad + config.odometry_sigma_of_angle * float(angle_rad)
            return Prediction(last @ T, np.diag([sigma_m**-2.0] * 3 + [sigma_rad**-2.0] * 3))
        sigma_rad = config.gyro_sigma_rad + config.gyro_sigma_rad_per_s * elapsed_s
        predicted = last @ T
        predicted[:3, 3] = followed[:3, 3]
        return Prediction(predicted, np.diag([0.0] * 3 + [sigma_rad**-2.0] * 3))

    def is_long_lost(self, stamp_ns: int) -> bool:
        """Whether the camera is lost for so long that its last velocity means nothing any more.

        Args:
            stamp_ns: now.
        """
        return self.lost and self.elapsed_s(stamp_ns) > self.config.tracking.max_extrapolation_s

    def is_after_gap(self, stamp_ns: int) -> bool:
        """Whether no frame came for so long that the camera can be anywhere near; odometry bridges a gap.

        Args:
            stamp_ns: now.
        """
        failure = self.config.tracking.failure
        longest_s = max(
            self.config.tracking.max_extrapolation_s, failure.gap_intervals * self.intervals.median_s
        )
        if not self.keyframes or self.elapsed_s(stamp_ns) <= longest_s:
            return False
        motion = self.motion.between(self.stamp_ns, stamp_ns) if self.motion is not None else None
        return motion is None or not motion.knows_translation

    @property
    def usual_gray_rms(self) -> float:
        """Median gray residual of the last frames that were followed; 0 before there is one."""
        return float(np.median(self.gray_rms)) if self.gray_rms else 0.0

    @property
    def largest_gray_rms(self) -> float:
        """Gray residual up to which a frame looks like its keyframe."""
        config = self.config.tracking.relocalization
        # depth of another time looks 2.5 times as bad as usual where it is 4 cm off: then nothing is added
        added = 0.0 if self.depth_color_inconsistent else config.max_gray_rms
        return added + config.max_gray_rms_of_usual * self.usual_gray_rms

    def looks_as_usual(self, result: Registration) -> bool:
        """Whether a frame is exposed as what it was registered to, and its gray values fit as usual.

        Args:
            result: of its registration.
        """
        largest = self.config.tracking.max_keyframe_gain
        return 1 / largest < result.exposure[0] < largest and result.rms_gray <= self.largest_gray_rms

    def register_color(self, frame: CurrentFrame) -> Registration:
        """Register the color of a frame to the last good frame, which there must be.

        Args:
            frame: the current frame.
        """
        assert self.last_good is not None
        tracking, predicted = self.config.tracking, self.predict(frame.stamp_ns)
        return self.last_good.register_color(
            frame.pyramid,
            predicted.T_keyframe_camera,
            tracking.registration,
            tracking.failure,
            prior_information=predicted.information,
        )

    def viewpoint(self, candidate: PoseCandidate) -> Viewpoint:
        """The keyframe of a candidate, as occlusion is judged by it.

        Args:
            candidate: where the frame may be.
        """
        keyframe = self.keyframes[candidate.keyframe_index]
        return Viewpoint(keyframe.coarsest, keyframe.T_map_keyframe, candidate.result.T_reference_target)
