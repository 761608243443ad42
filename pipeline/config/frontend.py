"""Configuration of the front end: tracking, keyframes, mapping."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, PositiveInt

from duagc.pipeline.config.base import Config
from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.config.exposure import ExposureConfig
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.motion_times import DelayConfig, ReadoutConfig
from duagc.pipeline.config.other_trackers import Open3dTrackerConfig, RenderingTrackerConfig
from duagc.pipeline.config.registration import GeometricVerificationConfig, MovingConfig, RegistrationConfig


class LoopConfig(GeometricVerificationConfig):
    """Loop closures within the robot's own path."""

    enabled: bool = True
    """Look for loop closures within the robot's own path."""
    min_gap: int = 3
    """Least difference between the indices of the two keyframes."""
    known_overlap: float = 0.3
    """Overlap by the tracked poses from which a pair is compared anyway."""
    compared: int = 32
    """Earlier keyframes, those that share most visual words, whose features are compared."""
    features_compared: int = 120
    """The strongest features, by which earlier keyframes are ranked."""
    min_matches: int = 10
    """Matches among them from which a pair is a candidate."""
    candidates: int = 2
    """Earlier keyframes tried per keyframe, those with most matches."""
    min_inliers: int = Field(default=15, ge=4)
    """Matches that must agree on one motion."""
    min_inlier_share: float = Field(default=0.3, ge=0.0, le=1.0)
    """The same as a share of the matches; the larger number holds."""
    min_overlap: float = Field(default=0.4, ge=0.0, le=1.0)
    """Overlap that the registrations in both directions must find."""
    robust: bool = True
    """Leave out loop closures that contradict the path and the other ones, by graduated truncated least squares."""
    odometry_floor_m: float = 0.005
    """Standard deviation of the drift between two keyframes that were registered to each other, added to what their
    information says: errors that the frames share are not in it."""
    odometry_floor_rad: float = 0.005
    """The same for the rotation."""
    closure_floor_m: float = 0.02
    """The same of a loop closure."""
    closure_floor_rad: float = 0.02
    """The same for its rotation."""


class JudgmentConfig(GeometricVerificationConfig):
    """Whether optimized keyframe poses can be true."""

    enabled: bool = True
    """Judge them, and call lost what was tracked from keyframes that features or depth contradict."""
    neighbors: int = 2
    """Earlier keyframes that each is judged with, besides the two before it."""
    min_inliers: int = Field(default=15, ge=4)
    """Matches that must agree on one motion; fewer say nothing."""
    min_inlier_share: float = Field(default=0.5, ge=0.0, le=1.0)
    """The same as a share of the matches; the larger number holds."""
    max_angle_rad: float = 0.02
    """Median angle between a feature and its partner from which features contradict the poses of two keyframes."""
    max_angle_of_own: float = 2.0
    """The same as a multiple of that by the motion that the features agree on; the larger limit holds."""
    min_visible: float = 0.2
    """Share of a view that the other must be able to judge; less says nothing."""
    max_free_space_violations: float = 0.25
    """Share of that in space which the other saw to be free, from which depth contradicts the poses."""


class KeyframeConfig(Config):
    """When a frame becomes a keyframe, and how keyframe poses are optimized together."""

    min_overlap: float = 0.8
    """A frame becomes a keyframe when one sees less of the other than this share."""
    max_translation_of_depth: float = 0.3
    """A frame that moved by more than this fraction of the median depth becomes a keyframe."""
    max_rotation_rad: float = 0.5
    """A frame that turned by more than this becomes a keyframe."""
    max_depth_offset_s: float = 0.03
    """A frame whose depth was taken earlier or later by more than this becomes none: depth that is moved to the time of
    its image is as good as the motion that is known. In a log where hardly any depth is as near, those that are nearest
    count."""
    neighbors: int = 4
    """Earlier keyframes that a new one is registered to, besides the one it was tracked against."""
    neighbor_overlap: float = 0.5
    """Least overlap, predicted and found, of such a registration."""
    huber_sigmas: float = 3.0
    """Registrations that disagree by more than this with the optimized poses count linearly."""
    local_optimization: bool = True
    """Optimize all keyframe poses jointly on the images; without, only the registrations made in tracking count."""
    optimization_rounds: int = 10
    """Rounds over all keyframes at most; they end when no pose moves by more than 0.1 mm and 0.1 mrad, and look again
    only at pairs that moved by as much."""
    coarse_rounds: int = 2
    """Rounds on smaller images before those at full size, if some registration contradicts the start: far from the
    minimum small images converge faster."""
    coarse_from: float = 0.02
    """Distance (m) or angle (rad) between a registration and the start from which that is so."""
    optimization_overlap: float = 0.3
    """Least overlap, at the present poses, of two keyframes that are compared."""
    optimization_candidates: int = 24
    """Earlier keyframes, those that look at the nearest places, whose overlap with one is computed."""
    optimization_neighbors: int = 8
    """Earlier keyframes that a keyframe is compared with at most, those with most overlap."""
    loops: LoopConfig = LoopConfig()
    judgment: JudgmentConfig = JudgmentConfig()


class FailureConfig(Config):
    """Tests of whether the images of a camera can be used and a pose can be true."""

    min_contrast: float = 0.02
    """Difference between the brightest and the darkest gray value (0..1) of the coarsest image below which a frame
    without depth shows nothing, as with a covered lens: it is left out."""
    max_saturated: float = 0.95
    """Share of black and white pixels above which a frame shows nothing."""
    max_frames_without_depth: int = 15
    """Frames in a row that are tracked by color alone, because their depth is missing or frozen."""
    min_view_without_depth: float = 0.6
    """Share of the samples of the last frame with depth that must be in view: color alone is poor where little is
    shared."""
    max_translation_without_depth_m: float = 0.12
    """Distance from the last frame with depth up to which color alone is followed: its error is up to a quarter of
    that distance."""
    sigma_of_translation_without_depth: float = 0.07
    """Standard deviation of that error per axis, as a share of the distance; part of the information."""
    color_check_gray_of_usual: float = 1.75
    """A frame whose gray residual is larger than this many times the usual one is also registered by color alone, and
    from features."""
    max_depth_color_m: float = 0.01
    """Largest distance between that pose and the one by depth and color."""
    max_depth_color_of_translation: float = 0.5
    """The same as a share of the distance from the last good frame; the larger limit holds."""
    share_after_contradiction: float = 0.5
    """Factor on that share once depth and color have contradicted each other: late depth is a smaller share of a longer
    translation."""
    max_frames_without_color: int = 3
    """Frames in a row that are tracked by depth alone, because their color is frozen: on walls depth drifts soon."""
    frozen_share: float = 0.99
    """An image is frozen if this share of its measured pixels has the very values of the image before."""
    frozen_gray_change: float = 0.08
    """Change of a gray value of the coarsest image, in standard deviations of that image, that counts as one."""
    frozen_gray_share: float = 0.02
    """Share of changed gray values from which a frozen depth image no longer belongs to the color."""
    frozen_depth_change: float = 0.01
    """Relative change of a depth of the coarsest image that counts as one."""
    frozen_depth_share: float = 0.1
    """Share of changed depths from which a frozen color image no longer belongs to the depth."""
    free_space_gate_m: float = 0.15
    """A point nearer by this than what a keyframe measured there is in space that was free."""
    free_space_gate_relative: float = 0.1
    """The same as a fraction of the depth; the larger limit holds."""
    max_free_space_violations: float = 0.1
    """Largest share of such points in a frame that becomes a keyframe, or by which a lost camera is relocalized."""
    max_sigma_occluded_m: float = 0.01
    """Largest standard deviation of the position of a frame with a larger share: what an object in front of the camera
    leaves visible may determine little, and its errors are several of these."""
    min_visible: float = 0.65
    """Share of a frame's points that its keyframe must be able to judge before an object counts as gone."""
    min_overlap_unlike: float = 0.7
    """Least overlap by which a frame is followed that looks unlike its keyframe, as where the exposure jumps."""
    max_speed_m_s: float = 3.0
    """Greatest speed of the camera: a lost one is not found farther away than it can have come."""
    slack_m: float = 0.1
    """Added to that distance."""
    slack_rad: float = 0.1
    """With `slack_m`, how far from where it was predicted a camera may be found on a surface without features."""
    min_features_of_inliers: int = 3
    """Times `relocalization.min_inliers`: a keyframe with fewer features cannot decide where a view is."""
    usual_frames: PositiveInt = 50
    """Last frames that were followed, whose median gray residual is the usual one."""
    interval_frames: PositiveInt = 50
    """Last frames whose median interval is the usual one."""
    gap_intervals: float = 3
    """Median times between frames without any that count as a gap."""


class MotionPriorConfig(Config):
    """Uncertainty of a prediction: by the motion prior of the log, standard deviations of a motion between two frames;
    by the last velocity, the accelerations of a camera that is carried."""

    odometry_sigma_m: float = 0.005
    """Translation by another odometry."""
    odometry_sigma_of_path: float = 0.05
    """Plus this share of the path."""
    odometry_sigma_rad: float = 0.005
    """Rotation by another odometry."""
    odometry_sigma_of_angle: float = 0.05
    """Plus this share of the angle."""
    gyro_sigma_rad: float = 0.002
    """Rotation by the integrated rates of a gyroscope."""
    gyro_sigma_rad_per_s: float = 0.01
    """Plus this for every second: the bias."""
    acceleration_m_s2: float = 1.5
    """Acceleration that the last velocity does not know of."""
    angular_acceleration_rad_s2: float = 4.0
    """The same of the rotation."""
    max_deviation_px: float = 4.0
    """Distance of a view from its prediction by these accelerations, pixels of the coarsest image of the registration,
    from which matched features give the start: dense registration converges from a few pixels off."""


class RelocalizationConfig(GeometricVerificationConfig):
    """Finding a lost camera by the features of its image."""

    features: int = 400
    """Features kept per keyframe."""
    features_compared: int = 120
    """The strongest of them, by which keyframes are ranked."""
    max_width_px: int = 400
    """Features come from the finest image of the pyramid that is not wider."""
    candidates: int = 3
    """Keyframes tried per frame, those with most matches."""
    min_matches: int = 6
    """Matches among the strongest features from which a keyframe is tried."""
    min_inliers: int = Field(default=10, ge=4)
    """Matches that must agree on one motion."""
    max_angle_rad: float = 0.02
    """Angle between a feature and its partner up to which they can be the same, where two poses are compared."""
    min_overlap: float = Field(default=0.5, ge=0.0, le=1.0)
    """Overlap with its keyframe that a plausible pose must have."""
    max_keyframe_disagreement_m: float = 0.03
    """Largest distance between a place that was found and the registration to a later keyframe that is not plausible
    itself."""
    max_conflict: float = 0.1
    """Largest fraction of a keyframe's visible samples in space that the frame saw to be free."""
    max_gray_rms: float = 0.03
    """Largest gray residual, plus `max_gray_rms_of_usual` times the usual one: that of the frames tracked before. Rooms
    built alike agree in shape, not in their pictures."""
    max_gray_rms_of_usual: float = 2.0
    """Factor on the usual gray residual that is added to `max_gray_rms`."""
    confirmations: int = 1
    """Later frames that must be tracked from there before the camera counts as found."""
    look_again: bool = True
    """Look for lost frames again after the optimization of the poses, among the keyframes around them in time."""
    look_again_keyframes: int = Field(default=2, ge=1)
    """Keyframes before and after a lost frame, each, that it is then registered to."""


class TrackingConfig(Config):
    """Tracking of frames against the latest keyframe."""

    method: Literal["registration", "rendering", "open3d"] = "registration"
    """How poses are found: by registration, which all settings but the two sections below are of, or, to compare with,
    by gradient steps on a rendered map, or by Open3D's dense SLAM. The latter two lose and relocalize nothing."""
    rendering: RenderingTrackerConfig = RenderingTrackerConfig()
    open3d: Open3dTrackerConfig = Open3dTrackerConfig()
    registration: RegistrationConfig = RegistrationConfig()
    """The usual registration, from the motion of the two frames before."""
    recovery: RegistrationConfig = RegistrationConfig(
        iterations=(5, 8, 12, 15),
        depth_gate_m=0.3,
        depth_gate_relative=0.1,
        max_translation_m=0.6,
        max_rotation_rad=0.6,
    )
    """The second attempt: one more pyramid level, wider gates; its result is checked by the usual registration."""
    max_gray_rms_with_features: float = 0.25
    """Largest gray residual of a registration that matched features confirm, in place of `registration.max_gray_rms`:
    blur and another point of view make a frame look unlike its keyframe."""
    min_overlap_with_features: float = 0.15
    """Least overlap of such a registration, in place of `registration.min_overlap`."""
    stable_rounds: int = 3
    """Usual registrations at most, after one with wide gates or from a far guess, until one stays where it began."""
    stable_m: float = 0.01
    """A registration that moves less than this from its start stays there."""
    stable_rad: float = 0.01
    """The same for the rotation."""
    strides: tuple[PositiveInt, ...] = (4, 2, 1, 1)
    """Pixels between samples of a keyframe, per pyramid level, finest first."""
    max_extrapolation_s: float = 0.2
    """Longest gap in time over which the last velocity predicts; one and a half usual intervals if they are longer."""
    equalize_from_gain: float = Field(default=1.2, ge=1.0)
    """A frame that failed is tried again with brightness and contrast brought to those of the keyframe if the contrast
    differs by more than this factor."""
    max_keyframe_gain: float = Field(default=1.5, ge=1.0)
    """A frame brighter or darker than its keyframe by more than this factor, or with a gray residual that would be too
    large for relocalization, becomes a keyframe only below `relocalization.min_overlap`, or where the exposure drifts,
    and only if little of it is saturated."""
    max_gain_step: float = Field(default=1.15, ge=1.0)
    """Factor up to which two frames in a row are exposed alike: an exposure that drifts does not jump."""
    max_saturated: float = 0.1
    """Share of black and white pixels, beyond that of the keyframe, up to which that is so."""
    failure: FailureConfig = FailureConfig()
    relocalization: RelocalizationConfig = RelocalizationConfig()
    prior: MotionPriorConfig = MotionPriorConfig()

    def verified_by_features(self) -> TrackingConfig:
        """The same for registrations that features verify besides."""
        limits = {
            "max_gray_rms": self.max_gray_rms_with_features,
            "min_overlap": self.min_overlap_with_features,
        }
        changed = self.registration.model_copy(update=limits)
        return self.model_copy(update={"registration": changed})


class ModelConfig(Config):
    """Registering the color of frames to the finished map."""

    enabled: bool = True
    """Where depth is not exact, frames that did not make the map are registered to it; so are those without depth."""
    max_pixels: int = Field(default=160_000, ge=1)
    """The map is drawn at the image size halved until it has no more pixels: half of 640 x 480, but 320 x 240 whole."""
    min_alpha: float = 0.9
    """Opacity of the drawn map below which a pixel is not used."""
    strides: tuple[PositiveInt, ...] = (2, 2, 1)
    """Pixels between samples of the drawn map, finest level first."""
    shared_view: float = Field(default=0.01, ge=0.0)
    """The map is drawn once for frames whose images are this far apart at most, as a share of their width; 0: for
    each of them."""


class SubmapConfig(GeometricVerificationConfig):
    """New submaps where the camera is lost, and the loop closures that join them, found as those between robots."""

    enabled: bool = True
    """Begin a new submap where the camera is lost and relocalization fails; if not, such frames have no pose."""
    min_frames: int = Field(default=10, ge=1)
    """Frames in a row that must be tracked from a first one before they are a submap; until then only the submaps that
    are there are searched."""
    min_keyframes: int = Field(default=2, ge=1)
    """Keyframes that a submap must have by then: what moves with the camera gives one."""
    compared: int = Field(default=32, ge=1)
    """Keyframes of another submap, those that share most visual words, whose features are compared with one."""
    features_compared: int = Field(default=120, ge=4)
    """The strongest features, by which they are ranked."""
    min_matches: int = Field(default=8, ge=1)
    """Matches among them from which a pair of keyframes is a candidate."""
    candidates: int = Field(default=3, ge=1)
    """Keyframes of another submap tried per keyframe, those with most matches."""
    max_verified: int = Field(default=64, ge=1)
    """Candidates of a pair of submaps that are verified, the best of every keyframe first."""
    hypotheses: int = Field(default=500, ge=1)
    """Three-point samples of RANSAC."""
    max_refinement_m: float = Field(default=0.15, gt=0.0)
    """Largest translation by which the registration may change what RANSAC found."""
    max_refinement_rad: float = Field(default=0.10, gt=0.0)
    """The same for the rotation."""
    min_surface_agreement: float = Field(default=0.5, ge=0.0, le=1.0)
    """Share of the surfaces seen from both submaps that must lie at the same place when one is laid into the other."""
    closures: LoopClosureConfig = LoopClosureConfig()
    """Noise and consistency of these loop closures."""


class FrontendConfig(Config):
    """Front end of one robot."""

    tracking: TrackingConfig = TrackingConfig()
    keyframes: KeyframeConfig = KeyframeConfig()
    delay: DelayConfig = DelayConfig()
    readout: ReadoutConfig = ReadoutConfig()
    mapping_enabled: bool = True
    """Grow a map; without, the log holds odometry and keyframes and an empty map."""
    exposure: ExposureConfig = ExposureConfig()
    """Exposures of single frames."""
    mapping: MappingConfig = MappingConfig()
    model: ModelConfig = ModelConfig()
    submaps: SubmapConfig = SubmapConfig()
    moving: MovingConfig = MovingConfig()
    """Moving objects, by depth: not mapped, in no Fisher sum, not in the fine-tuning after fusion."""
