"""Settings of training Gaussians: losses and learning rates."""

from __future__ import annotations

from typing import Literal, TypeAlias

from pydantic import Field

from duagc.pipeline.config.base import Config

DepthKind: TypeAlias = Literal["blended", "ray_plane"]
"""Depth of a Gaussian at a pixel: that of its center, or of its mean along the ray (a flat disc: of its plane)."""


class LossConfig(Config):
    """Weights of the mapping loss; every term is a mean over its pixels."""

    color_huber: float = Field(default=0.1, ge=1e-9, le=1e9)
    """Color residual (0..1) where the loss turns from quadratic to linear; the slope beyond is 1."""
    depth_weight: float = Field(default=1.0, ge=0.0, le=1e9)
    """Weight of one meter of depth error against one unit of color."""
    depth_huber_m: float = Field(default=0.02, ge=1e-9, le=1e9)
    """Depth residual in meters where the loss turns from quadratic to linear; the slope beyond is 1."""
    alpha_weight: float = Field(default=0.04, ge=0.0, le=1e9)
    """Weight of missing opacity (1 - alpha) where a surface was measured."""
    surface_weight: float = Field(default=0.0, ge=0.0, le=1e9)
    """Weight of one meter between a Gaussian's own depth and the measured one, by its share in the pixel."""
    depth_sigma_quadratic_per_m: float = Field(default=0.0019, ge=0.0)
    """Noise of depth of which the log states none, by the square of the distance; 0: none."""


class SurfaceLossConfig(LossConfig):
    """The same where depth is exact: every single Gaussian belongs on the surface."""

    depth_weight: float = Field(default=0.25, ge=0.0, le=1e9)
    """Weight of one meter of depth error against one unit of color."""
    depth_huber_m: float = Field(default=0.01, ge=1e-9, le=1e9)
    """Depth residual in meters where the loss turns from quadratic to linear; the slope beyond is 1."""
    alpha_weight: float = Field(default=0.02, ge=0.0, le=1e9)
    """Weight of missing opacity (1 - alpha) where a surface was measured."""
    surface_weight: float = Field(default=0.5, ge=0.0, le=1e9)
    """Weight of one meter between a Gaussian's own depth and the measured one, by its share in the pixel."""
    depth_sigma_quadratic_per_m: float = Field(default=0.0, ge=0.0)
    """Noise of depth of which the log states none, by the square of the distance; 0: none."""


class MapLossConfig(Config):
    """The loss of a map, by the depth that its Gaussians are drawn with."""

    blended: LossConfig = LossConfig()
    """Of Gaussians that are drawn with the depth of their centers."""
    ray_plane: SurfaceLossConfig = SurfaceLossConfig()
    """Of Gaussians that are drawn with the depth of their planes."""

    def of(self, depth: DepthKind) -> LossConfig:
        """The loss of maps of a kind.

        Args:
            depth: kind of depth that the Gaussians are drawn with.
        """
        return self.ray_plane if depth == "ray_plane" else self.blended


class SparseStepsConfig(Config):
    """What the steps of a training leave out."""

    checkerboard: bool = True
    """Look at every second block of 4x4 pixels, and at the others when the view comes again."""
    closing: float = Field(default=0.005, ge=0.0, le=0.5)
    """The Gaussian that takes the light at a pixel below this share stops all that is left; 0: blend to the end."""
    closing_until: float = Field(default=0.85, ge=0.0, le=1.0)
    """Share of the steps that do so; the others blend as maps are drawn."""
    moving_from: float = Field(default=0.7, ge=0.0, le=1.0)
    """Share of the steps after which views whose camera moves while its shutter is open are drawn from several places,
    and by half of their blocks; 1: never."""


class LearningRates(Config):
    """Step lengths of Adam: about the change of a parameter per step while its gradient keeps its sign."""

    means: float = 0.06
    """Share of the Gaussian's size, the geometric mean of its larger two deviations."""
    quats_wxyz: float = 2e-2
    """Of a unit quaternion."""
    log_scales: float = 0.08
    """Logarithms of the scales in meters."""
    colors: float = 2e-2
    """RGB in 0..1."""
    opacity_logits: float = 6e-2
    """Logits of the opacity."""

    def times(self, factor: float) -> LearningRates:
        """All rates scaled.

        Args:
            factor: on all rates.
        """
        return LearningRates(**{name: rate * factor for name, rate in self.model_dump().items()})
