"""Settings of loop closures, pose consensus and matching."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import Field, model_validator

from duagc.pipeline.config.base import Config
from duagc.pipeline.config.mapping import THICKNESS_FLOOR_M

WeightKind = Literal["uniform", "observation_count", "residual_magnitude", "scalar", "diagonal", "block"]


class LoopClosureConfig(Config):
    """Noise of loop closures and tests of their mutual consistency."""

    sigma_floor_m: float = Field(default=0.005, gt=0.0)
    """Added to every loop closure's covariance: registration reports only the noise of its pixels, not its bias (m)."""
    sigma_floor_rad: float = Field(default=0.003, gt=0.0)
    """The same for its rotation (rad)."""
    drift_floor_m: float = Field(default=0.005, ge=0.0)
    """Least assumed drift of the odometry from one keyframe to the next (m)."""
    drift_floor_rad: float = Field(default=0.003, ge=0.0)
    """The same for its rotation (rad)."""
    margin: float = Field(default=4.0, gt=0.0)
    """Factor on the variances of the pairwise test; fitted on two public data sets
    (`docs/explanation/pose-consensus.md`)."""
    min_support: int = Field(default=2, ge=1)
    """Loop closures that must agree before two robots are put into one frame: one alone cannot be checked."""
    min_alike: float = Field(default=0.65, ge=0.0, le=1.0)
    """Share of the texture seen by both views that must look alike in one of them at least: a thing that stands in two
    rooms has features enough to be taken for one place, and only what is around it distinguishes the rooms."""
    frame_sigma_m: float = Field(default=0.1, gt=0.0)
    """Scale of the Cauchy weights of the relative frame, translation."""
    frame_sigma_rad: float = Field(default=0.05, gt=0.0)
    """Scale of the Cauchy weights of the relative frame, rotation."""


@dataclass(frozen=True)
class TeamSchedule:
    """What large teams with many false loop closures add to the schedule of robust weights; by default nothing.

    Attributes:
        first_mu: least first mu between robots.
        checks: after the schedule, truncate anew at most so often, until nothing changes and the link is steady.
        check_packets: packets received between two of these.
        drop_idle: after the schedule, share only keyframes that a loop closure with weight names.
    """

    first_mu: float = 0.0
    checks: int = 0
    check_packets: int = 10
    drop_idle: bool = False


class PoseConsensusConfig(Config):
    """The decentralized solver of the team's keyframe poses."""

    relaxation: float = Field(default=0.9, gt=0.0, lt=1.0)
    """Share by which an edge variable moves to an arrived value (0.5 is the textbook's, slower)."""
    penalty_start: float = Field(default=0.3, gt=0.0)
    """First penalty, as a multiple of the metric (the information of the pair's loop closures)."""
    penalty_min: float = Field(default=0.015, gt=0.0)
    """Least penalty; below it one Gauss-Newton step per round can diverge."""
    penalty_max: float = Field(default=3.0, gt=0.0)
    """Greatest penalty."""
    penalty_period: int = Field(default=5, ge=1)
    """Packets that both ends must have received between two changes of the penalty."""
    penalty_decay: float = Field(default=20.0, gt=0.0)
    """Packets after which the allowed change shrinks: factor 1 + 2 / max(1, received / penalty_decay)."""
    adaptive: bool = True
    """Adapt the penalties; if not, the first ones stay."""
    relinearize_rad: float = Field(default=1e-2, ge=0.0)
    """The factorization is kept until rotations moved this much in sum."""
    step_limit_rad: float = Field(default=0.3, gt=0.0)
    """A step that turns some keyframe more than this is shortened; nonlinearity makes longer ones worthless."""
    tolerance: float = Field(default=2e-6, gt=0.0)
    """An end has converged when its steps and edge variables change less than this (m, rad)."""
    wire: Literal["fixed", "float32", "float64"] = "fixed"
    """Poses in a packet: rotations in float32 and translations in steps of 7.5 nm, wherever the world has its origin;
    all in float32, which is 15 um a kilometer from there; or not rounded at all."""
    robust: bool = True
    """Weight loop closures by graduated non-convexity, truncated least squares; if not, `keep` decides alone."""
    truncation: float = Field(default=7.5, gt=0.0)
    """A loop closure whose whitened residual is longer than this counts as an outlier."""
    robust_warm_up: int = Field(default=40, ge=0)
    """Packets received with the start weights before the graduated weights begin (fewer if the link is steady)."""
    robust_skip: bool = True
    """A link without ambiguous loop closures after the warm-up skips the graduated weights. That saves rounds; in a
    larger team a false loop closure may fit until others' weights have changed."""
    robust_packets: int = Field(default=5, ge=1)
    """Most packets received per step of the graduated weights; a link that is steady takes two."""
    robust_growth: float = Field(default=1.4, gt=1.0)
    """Factor on the control parameter mu per step; 1.6 freezes robots on wrong weights."""
    robust_mu: tuple[float, float] = (1e-5, 300.0)
    """Least first and greatest last mu. The schedule ends when all weights of a link are zero or one."""
    robust_convexity: float = Field(default=0.1, ge=0.0)
    """It begins at this share of the mu at which the worst loop closure is just convex; 0: always at the least."""
    odometry_floor_m: float = Field(default=0.002, ge=0.0)
    """Added to the covariance of every odometry factor: registration does not report its bias (m)."""
    odometry_floor_rad: float = Field(default=0.001, ge=0.0)
    """The same for rotations (rad)."""
    closures: LoopClosureConfig = LoopClosureConfig()
    """Noise and consistency of loop closures."""

    @model_validator(mode="after")
    def _consistent(self) -> PoseConsensusConfig:
        first, last = self.robust_mu
        if not 0 < first <= last:
            raise ValueError(
                f"exchange.consensus.robust_mu is [{first:g}, {last:g}], expected 0 < first <= last"
            )
        return self

    def team_schedule(self) -> TeamSchedule:
        """What is added to the schedule of robust weights."""
        return TeamSchedule()


class ColorConfig(Config):
    """How differently the cameras of a team see colors."""

    enabled: bool = True
    """Find gain and offset of each channel between robots and read neighbors' colors by them; if not, all cameras
    count as alike."""
    min_matches: int = Field(default=100, ge=3)
    """Two robots with fewer matched Gaussians say nothing of each other's colors."""
    splats_per_sample: float = Field(default=30.0, ge=1.0)
    """Matched Gaussians that say together what one would say alone: those that share a pixel make up for each other."""
    sigma_floor: float = Field(default=0.003, gt=0.0)
    """Least standard deviation of what two robots find: of the log of the gain, and of colors."""
    prior_gain: float = Field(default=0.5, gt=0.0)
    """Standard deviation of a camera's gain (its log) before anything was compared."""
    prior_offset: float = Field(default=0.2, gt=0.0)
    """The same of its offset; colors are 0..1."""


class MatchingConfig(Config):
    """Matching of Gaussians between two robots."""

    colors: ColorConfig = ColorConfig()
    """Of cameras that differ."""

    radius_m: float = Field(default=0.05, gt=0.0)
    """Delta of (6): matches are searched within this distance."""
    position_scale_m: float = Field(default=0.05, gt=0.0)
    """l: the distance that counts as one."""
    beta_log_covariance: float = Field(default=0.1, ge=0.0)
    """Weight of the squared Log-Euclidean distance of the covariances."""
    beta_color: float = Field(default=1.0, ge=0.0)
    """Weight of the squared distance of the color coefficients."""
    beta_opacity: float = Field(default=0.5, ge=0.0)
    """Weight of the squared difference of the opacity logits."""
    percentile: float = Field(default=90.0, ge=0.0, le=100.0)
    """tau_G is this percentile, over the own map, of d_G to the nearest neighbor within the radius."""
    candidates: int = Field(default=16, ge=1)
    """Nearest Gaussians within the radius that are compared, from either side."""

    def of_maps(self, thickness_floor_m: float) -> MapMatching:
        """The same, of maps that were made with this floor.

        Args:
            thickness_floor_m: least standard deviation that the mapper lets a Gaussian have.
        """
        return MapMatching(**dict(self), thickness_floor_m=thickness_floor_m)


class MapMatching(MatchingConfig):
    """Matching of maps with what they were made with. No section of a run: `RunConfig.matching` puts it together."""

    thickness_floor_m: float = Field(default=THICKNESS_FLOOR_M, gt=0.0)
    """Standard deviation below which the mapper lets no Gaussian go."""
