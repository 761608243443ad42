"""Configuration of the exchange: links, transport, places, verification, what is sent."""

from typing import Literal

from pydantic import Field, model_validator

from duagc.pipeline.config.base import Config
from duagc.pipeline.config.consensus import MatchingConfig, PoseConsensusConfig, WeightKind
from duagc.pipeline.config.network import LinkConfig, TransportConfig
from duagc.pipeline.config.registration import GeometricVerificationConfig, GicpConfig, RegistrationConfig

EvidenceOrder = Literal["gain", "paper", "random", "reversed"]

_MOST_COUNTED = 2**16 - 1  # by the messages of loop closing
_MOST_SAMPLES = _MOST_COUNTED // 4  # tiles of a whole number of pixels may be up to four times as many


class PlacesConfig(Config):
    """Place descriptors and candidates for loop closures."""

    features_per_place: int = Field(default=80, ge=4, le=_MOST_COUNTED)
    """Descriptors of one keyframe that a neighbor gets to recognize the place (128 bytes each)."""
    features_per_keyframe: int = Field(default=400, ge=4, le=_MOST_COUNTED)
    """Descriptors with 3-D points of one keyframe, for verification."""
    ratio: float = Field(default=0.8, gt=0.0, lt=1.0)
    """Nearest over second-nearest distance below which a match counts."""
    min_score: int = Field(default=8, ge=1)
    """Matches from which a pair of keyframes is a candidate."""
    candidates_per_keyframe: int = Field(default=3, ge=1)
    """Best candidates tried for each keyframe of the neighbor."""
    max_requested_keyframes: int = Field(default=24, ge=1)
    """Most keyframes whose sample is requested from one neighbor."""
    keyframes_per_request: int = Field(default=6, ge=1)
    """Keyframes asked for at once; what came of them decides about the next."""
    worth_nats: float = Field(default=1.0, ge=0.0)
    """Least information about the two robots that a sample must promise, in nats; 0: all that the budget allows."""
    enough_closures: int = Field(default=10, ge=0)
    """Verified loop closures with a neighbor from which on no more are looked for by the overlap of views."""
    rectified_planes: int = Field(default=3, ge=0)
    """Directions of surfaces that a camera sees from the side, in each of which a view is rectified for features if all
    others do not join two robots; 0: none."""
    rectified_keyframes: int = Field(default=48, ge=1)
    """Most own keyframes, evenly spread, that take part in this; of the neighbor's, as many as may be requested."""


class PeerRegistrationConfig(RegistrationConfig):
    """Registration of two robots' views, whose cameras may differ."""

    max_gain: float = 4.0
    """The gain must lie between 1 / max_gain and max_gain. A covered lens, which less would find out, has no features
    that agree on a motion."""
    gray_noise_of_depth: bool = True
    """Count the error of a sample's depth in the noise of its gray value: robots meet at wide baselines, where gray
    values are trusted too much without."""
    min_overlap: float = 0.1
    """Smaller overlap is LOW_OVERLAP: what so few samples say is wrong by more than they state. Above, the limits of
    `verification` decide."""


class VerificationConfig(GeometricVerificationConfig):
    """From a candidate to a loop closure with another robot: RANSAC over 3-D matches, then registration."""

    method: Literal["features", "features_gicp", "gicp"] = "features"
    """How the motion is found. features: as above; to compare with, with GICP in the place of our registration
    (features_gicp), or GICP alone, which begins as if both cameras stood at one place (extra `gicp`)."""
    gicp: GicpConfig = GicpConfig()
    """Settings of GICP."""
    hypotheses: int = Field(default=500, ge=1)
    """Three-point samples of RANSAC."""
    certainty: Literal["measured", "alike"] = "measured"
    """How certain a loop closure is: as its registration found; to compare with, all alike, with `alike_sigma_m` and
    `alike_sigma_rad`."""
    alike_sigma_m: float = Field(default=0.005, gt=0.0)
    """Standard deviation of the translation of a loop closure where all are alike."""
    alike_sigma_rad: float = Field(default=0.003, gt=0.0)
    """The same for its rotation."""
    samples: int = Field(default=2000, ge=50, le=_MOST_SAMPLES)
    """Points with normal and intensity of the neighbor's keyframe used by the registration."""
    min_overlap: float = Field(default=0.2, ge=0.0, le=1.0)
    """Overlap that the registration must find, of what the own camera can see of the neighbor's samples."""
    min_covered: float = Field(default=0.6, gt=0.0)
    """Share of the own image in which the neighbor's samples must be seen for less overlap to be enough; above 1: no
    share is."""
    max_refinement_m: float = Field(default=0.15, gt=0.0)
    """Largest translation by which the registration may change what RANSAC found: of the camera or, if less, of the
    matches that agree."""
    registration: PeerRegistrationConfig = PeerRegistrationConfig()
    """The registration itself."""
    max_refinement_rad: float = Field(default=0.10, gt=0.0)
    """The same for the rotation."""


class InjectionConfig(Config):
    """Faults made on purpose; all off unless asked for."""

    false_closures: float = Field(default=0.0, ge=0.0, lt=1.0)
    """Share of false ones among all loop closures of a pair of robots that found any."""
    false_closure_m: float = Field(default=3.0, gt=0.0)
    """Largest coordinate of the translation of a false loop closure; its rotation is any."""
    false_matches: float = Field(default=0.0, ge=0.0, le=1.0)
    """Share of the matched Gaussians of a pair of robots whose partners are exchanged."""
    pose_dropouts: float = Field(default=0.0, ge=0.0, lt=1.0)
    """Probability that a robot sends no poses to a neighbor in a round."""
    liar: str = ""
    """Name of the robot whose messages are wrong, as the next settings say; what it computes for itself is right."""
    false_poses_m: float = Field(default=0.0, ge=0.0)
    """How far off it sends every keyframe, in a direction that is drawn for each: with solver `admm`, and as final."""
    false_gaussians: float = Field(default=0.0, ge=0.0, le=1.0)
    """Share of its Gaussians that it sends with a wrong mean and as too certain."""
    false_gaussian_m: float = Field(default=0.3, gt=0.0)
    """How far off these means are, in a direction that is drawn for each."""
    false_certainty: float = Field(default=10.0, ge=1.0)
    """What it divides the standard deviation of these means by."""

    @model_validator(mode="after")
    def _consistent(self) -> "InjectionConfig":
        lies = self.false_poses_m > 0 or self.false_gaussians > 0
        if lies != bool(self.liar):
            raise ValueError(
                f"exchange.injection.liar is {self.liar!r} with false_poses_m {self.false_poses_m:g} and "
                f"false_gaussians {self.false_gaussians:g}, expected a name with one of these, or none of all"
            )
        return self


class ExchangeConfig(Config):
    """One session of the team."""

    period_ns: int = Field(default=100_000_000, ge=1)
    """Length of one round."""
    max_rounds: int = Field(default=3000, ge=1)
    """The session ends here, whatever has been agreed."""
    solver: Literal[
        "admm", "elimination", "elected", "block_descent", "algorithm_1", "algorithm_1_printed"
    ] = "admm"
    """Of the poses. admm: relaxed edge-ADMM, a few poses per round and link; elimination: exact steps along a tree of
    robots, matrices in few rounds; to compare with, one elected robot that gets all graphs and solves for all,
    block-coordinate descent, one robot after the other, and Algorithm 1 of the paper, by which matched Gaussians move
    poses: with the corrections that it needs, or as printed."""
    algorithm_1_penalty: float = Field(default=0.01, gt=0.0)
    """rho of Algorithm 1 as printed, as a multiple of the loop closures' information; larger ones diverge sooner."""
    elimination_wire: Literal["float32", "float64"] = "float64"
    """Precision of the matrices of elimination on the wire."""
    coverage: Literal["all", "overlap"] = "all"
    """Send every Gaussian to all robots, or only those in space that the receiver's keyframes saw."""
    evidence_wire: Literal["compact", "float32", "float64"] = "compact"
    """100 bytes per Gaussian, rounded far below its uncertainty, or 188, or 364 bytes and not rounded at all."""
    weights: WeightKind = "block"
    """Weight of a robot's Gaussian: its information, or one of the simpler kinds to compare with
    (`docs/explanation/information.md`)."""
    evidence_order: EvidenceOrder = "gain"
    """Which Gaussians go first: those that promise the receiver most information per byte, or by the paper's (4); to
    compare with, a random order, and the reversed one of `gain`."""
    evidence_share: float = Field(default=1.0, gt=0.0, le=1.0)
    """Share of its Gaussians that a robot sends evidence of, the first of this order; the others stay with it."""
    overlap_voxel_m: float = Field(default=0.25, gt=0.0)
    """Edge of the voxels that say which space a robot saw (coverage = overlap)."""
    link: LinkConfig = LinkConfig()
    transport: TransportConfig = TransportConfig()
    places: PlacesConfig = PlacesConfig()
    verification: VerificationConfig = VerificationConfig()
    consensus: PoseConsensusConfig = PoseConsensusConfig()
    matching: MatchingConfig = MatchingConfig()
    injection: InjectionConfig = InjectionConfig()
