"""What a tracker remembers between frames, and what follows from it."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field, replace

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend.color_only import LastGoodFrame
from duagc.pipeline.frontend.current_frame import CurrentFrame, PoseCandidate
from duagc.pipeline.frontend.failure import (
    FrameIntervals,
    FrozenImageDetector,
    OcclusionDetector,
    RecentMedian,
    Viewpoint,
)
from duagc.pipeline.frontend.prediction import LastPrediction, Prediction
from duagc.pipeline.frontend.tracked import TrackedKeyframe
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.posegraph.relative_poses import RelativePose
from duagc.pipeline.recording import Motion, MotionPrior
from duagc.pipeline.recording.gyro_calibration import FEWEST, MOST, GyroCorrection, Turn
from duagc.pipeline.registration import Registration

EXTRAPOLATED_INTERVALS = 1.5
"""Usual intervals between frames over which a velocity predicts in any case."""
MOST_INTERVALS = 8
"""That a velocity predicts, which was measured over one: images that waited in a driver come in bursts."""
RECENT_FRAMES = 7  # whose mean velocity moves depth of another time


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
        gain: how much brighter than its keyframe the last frame is.
        gain_step: how much brighter than the frame before, if both were followed by one keyframe; else infinite.
        depth_color_inconsistent: whether depth and color disagreed, and nothing has resolved it since.
        frames_without_depth: in a row, up to the current one.
        frames_without_color: the same for color.
        last_good: the last frame with depth and color and nothing in front of it.
        recent: time and T_map_camera of the last frames that were tracked without a loss between them.
        followed_m_s: by how much those that were tracked last came forward in a second, before a loss too.
        turns: by a gyroscope and by the images, of the last frames that the images determine.
        gyro: what these say of the gyroscope.
        max_depth_offset_s: by which depth may be earlier or later than its color, of a frame that others are
            registered to; None: as configured.
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
    gain: float = 1.0
    gain_step: float = math.inf
    depth_color_inconsistent: bool = False
    frames_without_depth: int = 0
    frames_without_color: int = 0
    last_good: LastGoodFrame | None = None
    recent: list[tuple[int, Array]] = field(default_factory=list)
    followed_m_s: float = 0.0
    turns: list[Turn] = field(default_factory=list)
    gyro: GyroCorrection = field(default_factory=GyroCorrection)
    max_depth_offset_s: float | None = None
    gray_rms: RecentMedian = field(init=False)
    intervals: FrameIntervals = field(init=False)
    frozen: FrozenImageDetector = field(init=False)
    occlusion: OcclusionDetector = field(init=False)
    _prediction: LastPrediction = field(init=False)

    def __post_init__(self) -> None:
        self.gray_rms = RecentMedian(self.config.tracking.failure.usual_frames)
        self.intervals = FrameIntervals(self.config.tracking.failure.interval_frames)
        self.frozen = FrozenImageDetector(self.config.tracking.failure)
        self.occlusion = OcclusionDetector(self.config.tracking.failure)
        self._prediction = LastPrediction()

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
            recent=list(self.recent),
            turns=list(self.turns),
        )
        other.gray_rms, other.intervals = copy.copy(self.gray_rms), copy.deepcopy(self.intervals)
        other.frozen, other.occlusion = copy.copy(self.frozen), copy.copy(self.occlusion)
        other.frozen.config = other.occlusion.config = config.tracking.failure
        return other

    @property
    def keyframe(self) -> TrackedKeyframe:
        """The keyframe that frames are tracked against."""
        return self.keyframes[self.keyframe_index]

    def in_keyframe(self, candidate: PoseCandidate) -> Array:
        """T_keyframe_camera [4, 4] of a pose that may be by another keyframe, in the current one.

        Args:
            candidate: the pose.
        """
        T = candidate.result.T_reference_target
        if candidate.keyframe_index == self.keyframe_index:
            return T
        other = self.keyframes[candidate.keyframe_index].T_map_keyframe
        return se3.inverse(self.keyframe.T_map_keyframe) @ other @ T

    def in_map(self, candidate: PoseCandidate) -> Array:
        """T_map_camera [4, 4] of a pose that may be by another keyframe, as tracked.

        Args:
            candidate: the pose.
        """
        return self.keyframes[candidate.keyframe_index].T_map_keyframe @ candidate.result.T_reference_target

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
        last = self.stamp_ns, self.T_keyframe_camera, self.velocity, self.keyframe
        basis = (stamp_ns, *last, self.gyro, self.intervals.median_s)
        return self._prediction.of(basis, lambda: self._predicted(stamp_ns))

    def _predicted(self, stamp_ns: int) -> Prediction:
        last, elapsed_s = self.T_keyframe_camera, self.elapsed_s(stamp_ns)
        followed = last @ se3.exp(self.velocity * elapsed_s) if self._is_fresh(elapsed_s) else last
        motion = self._moved(self.stamp_ns, stamp_ns)
        if motion is None:
            turned_rad_s2 = self.config.tracking.prior.angular_acceleration_rad_s2
            return Prediction(followed, None, self._deviation_px(elapsed_s, turned_rad_s2))
        config, T = self.config.tracking.prior, motion.T_start_stop
        path_m, angle_rad = se3.distance(np.eye(4), T)
        if motion.knows_translation:
            sigma_m = config.odometry_sigma_m + config.odometry_sigma_of_path * float(path_m)
            sigma_rad = config.odometry_sigma_rad + config.odometry_sigma_of_angle * float(angle_rad)
            return Prediction(last @ T, np.diag([sigma_m**-2.0] * 3 + [sigma_rad**-2.0] * 3))
        sigma_rad = max(self._stated_gyro_sigma_rad(elapsed_s), self.gyro.sigma_rad_s * elapsed_s)
        predicted = last @ T
        predicted[:3, 3] = followed[:3, 3]
        information = np.diag([0.0] * 3 + [sigma_rad**-2.0] * 3)
        return Prediction(predicted, information, self._deviation_px(elapsed_s, 0.0))

    def _moved(self, start_ns: int, stop_ns: int) -> Motion | None:
        """The motion by other sensors, a gyroscope corrected by the images; None where that says nothing."""
        motion = None if self.motion is None else self.motion.between(start_ns, stop_ns)
        if motion is None or motion.knows_translation:
            return motion
        if not self.gyro.helps:
            return None
        R = self.gyro.corrected(motion.T_start_stop[:3, :3], 1e-9 * (stop_ns - start_ns))
        return Motion(se3.from_rotation_translation(R, np.zeros(3)), knows_translation=False)

    def _stated_gyro_sigma_rad(self, elapsed_s: float) -> float:
        config = self.config.tracking.prior
        return config.gyro_sigma_rad + config.gyro_sigma_rad_per_s * elapsed_s

    def compare_gyro(self, stamp_ns: int, R_last_camera: Array) -> None:
        """Take in how the camera turned since the last frame, by images that determine it.

        Args:
            stamp_ns: now.
            R_last_camera: [3, 3].
        """
        motion = None if self.motion is None else self.motion.between(self.stamp_ns, stamp_ns)
        elapsed_s = self.elapsed_s(stamp_ns)
        if motion is None or motion.knows_translation or elapsed_s <= 0:
            return
        turn = Turn(so3.log(motion.T_start_stop[:3, :3]) / elapsed_s, so3.log(R_last_camera) / elapsed_s)
        stated_sigma_rad_s = self._stated_gyro_sigma_rad(elapsed_s) / elapsed_s
        if len(self.turns) >= FEWEST and self.gyro.is_still(turn, stated_sigma_rad_s):
            return  # a pause would push out the turns that tell how it is mounted
        self.turns = [*self.turns[1 - MOST :], turn]
        self.gyro = GyroCorrection.of(self.turns, stated_sigma_rad_s)

    def _deviation_px(self, elapsed_s: float, turned_rad_s2: float) -> float:
        """By how much acceleration moves a view off its prediction, pixels of the coarsest image of a registration."""
        moved_rad_s2 = self.config.tracking.prior.acceleration_m_s2 / self.keyframe.median_depth_m
        return self._coarsest_focal_px * (turned_rad_s2 + moved_rad_s2) * 0.5 * elapsed_s**2

    def distance_px(self, T_keyframe_camera: Array, T_keyframe_other: Array) -> float:
        """How far two views are apart, pixels of the coarsest image of a registration.

        Args:
            T_keyframe_camera: [4, 4].
            T_keyframe_other: [4, 4].
        """
        moved_m, turned_rad = se3.distance(T_keyframe_camera, T_keyframe_other)
        return self._coarsest_focal_px * float(turned_rad + moved_m / self.keyframe.median_depth_m)

    def weakly_predicted(self, predicted: Prediction) -> bool:
        """Whether a camera that is not lost may be farther from the prediction than a registration reaches.

        So may one whose velocity is not known yet, unless sensors measure its whole motion: a log may begin in motion.

        Args:
            predicted: of the frame.
        """
        is_guess = len(self.recent) < 2 and predicted.sigma_px > 0
        is_far = predicted.sigma_px > self.config.tracking.prior.max_deviation_px
        return (is_guess or is_far) and not self.lost

    def deviation_rad(self, deviation_px: float) -> float:
        """The angle, radians, of a distance in the coarsest image that a registration begins with.

        Args:
            deviation_px: the distance, pixels.
        """
        return deviation_px / self._coarsest_focal_px

    @property
    def _coarsest_focal_px(self) -> float:
        """Focal length of the coarsest image that a registration begins with."""
        tracking = self.config.tracking
        halvings = len(tracking.strides) - len(tracking.registration.iterations)
        return float(self.keyframe.coarsest.camera.fx * 2.0**halvings)

    def depth_motion(self, stamp_ns: int, depth_offset_ns: int) -> Array | None:
        """T_color_depth [4, 4], how the camera moves from the time of color to that of depth; None if unknown.

        By the motion prior of the log, else by the mean velocity of the last frames: their poses followed the depth
        that was moved by it, and with the last velocity alone an error would grow from frame to frame.

        Args:
            stamp_ns: time of the color.
            depth_offset_ns: how much later the depth was taken; negative: earlier.
        """
        moved = self._mean_motion(stamp_ns, depth_offset_ns)
        if moved is None or self.motion is None:
            return moved
        motion = self._moved(*sorted((stamp_ns, stamp_ns + depth_offset_ns)))
        if motion is None:
            return moved
        T = motion.T_start_stop if depth_offset_ns > 0 else se3.inverse(motion.T_start_stop)
        if not motion.knows_translation:
            T = T.copy()
            T[:3, 3] = moved[:3, 3]
        return T

    def remember_pose(self) -> None:
        """Take the pose of the last frame that was tracked; none before a loss counts."""
        T_map_camera = self.keyframe.T_map_keyframe @ self.T_keyframe_camera
        self.recent = [*self.recent[1 - RECENT_FRAMES :], (self.stamp_ns, T_map_camera)]
        first_ns, T_map_first = self.recent[0]
        if self.stamp_ns > first_ns:
            moved_m, _ = se3.distance(T_map_first, T_map_camera)
            self.followed_m_s = 1e9 * float(moved_m) / (self.stamp_ns - first_ns)

    def _mean_motion(self, stamp_ns: int, duration_ns: int) -> Array | None:
        """Motion [4, 4] of the camera in some time at the mean velocity of the last frames; None if unknown."""
        if self.lost or not self._is_fresh(self.elapsed_s(stamp_ns)) or len(self.recent) < 2:
            return None
        (first_ns, T_map_first), (last_ns, T_map_last) = self.recent[0], self.recent[-1]
        share = duration_ns / max(last_ns - first_ns, 1)
        return np.asarray(se3.exp(share * se3.log(se3.inverse(T_map_first) @ T_map_last)))

    def _is_fresh(self, elapsed_s: float) -> bool:
        """Whether the last velocity still predicts; from one frame to the next it does, however slow the camera."""
        usual_s = self.intervals.median_s
        longest_s = self.config.tracking.max_extrapolation_s
        if usual_s > 0:
            longest_s = min(longest_s, MOST_INTERVALS * usual_s)
        return elapsed_s <= max(longest_s, EXTRAPOLATED_INTERVALS * usual_s)

    def is_long_lost(self, stamp_ns: int) -> bool:
        """Whether the camera is lost for so long that its last velocity means nothing any more.

        Args:
            stamp_ns: now.
        """
        return self.lost and self.elapsed_s(stamp_ns) > self._longest_gap_s

    def is_after_gap(self, stamp_ns: int) -> bool:
        """Whether no frame came for so long that the camera can be anywhere near; odometry bridges a gap.

        Args:
            stamp_ns: now.
        """
        if not self.keyframes or self.elapsed_s(stamp_ns) <= self._longest_gap_s:
            return False
        motion = self.motion.between(self.stamp_ns, stamp_ns) if self.motion is not None else None
        return motion is None or not motion.knows_translation

    @property
    def _longest_gap_s(self) -> float:
        """Time without a pose after which the camera can be anywhere near, by the usual interval between frames."""
        usual_s = self.config.tracking.failure.gap_intervals * self.intervals.median_s
        return max(self.config.tracking.max_extrapolation_s, usual_s)

    @property
    def usual_gray_rms(self) -> float:
        """Median gray residual of the last frames that were followed; 0 before there is one."""
        return self.gray_rms.median

    def looks_worse_than_usual(self, result: Registration) -> bool:
        """Whether gray values fit much less well than those of other frames; False before there are others.

        Args:
            result: of a registration with color.
        """
        largest = self.config.tracking.failure.color_check_gray_of_usual * self.usual_gray_rms
        return bool(self.gray_rms.values) and result.rms_gray > largest

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

    def drifts(self, result: Registration) -> bool:
        """Whether the last frame is exposed as the one before, and its gray values fit as usual.

        Args:
            result: of its registration.
        """
        largest = self.config.tracking.max_gain_step
        return 1 / largest < self.gain_step < largest and result.rms_gray <= self.largest_gray_rms

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
