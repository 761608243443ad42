"""Settings of fusion."""

from typing import Literal

from pydantic import Field

from pipeline.config import Config
from pipeline.splat.losses import LossConfig
from pipeline.splat.optimiser import LearningRates


class RefineConfig(Config):
    """Training of the fused map on the robot's own images."""

    steps_per_view: int = Field(default=6, ge=0)
    """Steps for each view; 0: the fused map stays as fusion left it."""
    steps_max: int = Field(default=400, ge=0)
    """Most steps in all."""
    support_views: int = Field(default=40, ge=0)
    """Most tracked frames between keyframes that take part."""
    rate: float = Field(default=0.1, gt=0.0)
    """First learning rates as a share of the mapper's."""
    rate_decay: float = Field(default=0.1, gt=0.0, le=1.0)
    """They fall exponentially to this share."""
    rates: LearningRates = LearningRates()
    loss: LossConfig = LossConfig()


class FusionConfig(Config):
    """From evidence to a robot's fused map."""

    coverage: Literal["all", "overlap"] = "all"
    """Take over what only neighbours saw (all), or only fuse what is matched (overlap)."""
    association: Literal["neighbours", "members"] = "neighbours"
    """Whose values carry the variance of where a robot happened to put its splats: only the neighbours', so that a
    robot estimates its own splat at its own place, or every member's alike, so that all robots end with one and the
    same Gaussian, as method and paper have it (see `docs/consensus.md` for what that costs)."""
    spacing_per_sigma: float = Field(default=1.8, ge=0.0)
    """Local spacing of splats, in units of their standard deviation along the surface: the mapper seeds discs with a
    standard deviation of 0.55 cells."""
    position_floor_m: float = Field(default=0.003, ge=0.0)
    """Standard deviation added to every position, in all directions. Fisher information knows the noise of pixels but
    not the bias of a map: two discs a few millimetres apart, slightly tilted and each sure to a tenth of a millimetre,
    would meet centimetres away, where their planes cross. 0 is the method as printed."""
    slope: float = Field(default=0.2, ge=0.0)
    """Two splats some distance apart lie on one plane only up to this slope: (slope * distance)^2 is added to the
    position's covariance in all directions. 0 is the method as printed."""
    shape_floor: float = Field(default=0.1, ge=0.0)
    """The same for every coordinate of vec log Sigma; 0.1 is 5 % of a scale."""
    sampling_log_covariance: float = Field(default=0.5, ge=0.0)
    """Standard deviation by which two robots' splats of one place differ in a coordinate of vec log Sigma because they
    are cut differently (association = neighbours)."""
    sampling_color: float = Field(default=0.1, ge=0.0)
    """The same for colour channels, 0..1."""
    sampling_opacity: float = Field(default=1.0, ge=0.0)
    """The same for opacity logits."""
    unobserved_below: float = Field(default=1e-6, gt=0.0)
    """Directions with less than this share of a block's largest information count as unobserved: float32 noise."""
    explained_m: float = Field(default=0.10, ge=0.0)
    """A neighbour's Gaussian this far behind a surface that an own keyframe measured still counts as explained..."""
    explained_relative: float = Field(default=0.03, ge=0.0)
    """... plus this share of its depth."""
    explained_px: int = Field(default=4, ge=0)
    """The farthest surface within so many pixels decides: at outlines the two robots' poses and depths never agree."""
    explained_opacity: float = Field(default=0.5, ge=0.0, le=1.0)
    """Where a keyframe has no depth but the own map renders more opaque than this, the rendered depth stands in."""
    added_need_information: bool = True
    """Take over only Gaussians on whose position their owner's pixels said something."""
    refine: RefineConfig = RefineConfig()
    max_added: int | None = Field(default=None, ge=0)
    """At most so many Gaussians of neighbours are taken over, those of most position information first."""
