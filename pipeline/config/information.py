"""Configuration of the information stage."""

from typing import Literal

from pydantic import Field

from duagc.pipeline.config.base import Config


class InformationConfig(Config):
    """Which views are summed, and the noise of the sensor that their residuals are measured in."""

    window: Literal["all", "rolling", "per_gaussian"] = "all"
    """Keyframes that count: all; the last `window_length`; for each Gaussian the last `window_length` that saw it."""
    window_length: int = Field(default=10, ge=1)
    """Keyframes of the windows `rolling` and `per_gaussian`."""
    color_sigma_floor: float = 0.01
    """Least standard deviation of a color channel (0..1), whatever the residuals say."""
    depth_sigma_base_m: float = 0.0012
    """Depth noise at 0.4 m; sigma(z) = base + quadratic (z - 0.4)^2, times a factor. Defaults: Kinect v1."""
    depth_sigma_quadratic_per_m: float = 0.0019
    """Growth of the depth noise with the square of the distance beyond 0.4 m."""
    depth_factor_from_residuals: bool = True
    """Scale sigma(z) by the robust spread of the map's own depth residuals; recorded with the result."""
    depth_factor_min: float = 0.25
    """Least factor on sigma(z) by the residuals."""
    depth_factor_max: float = Field(default=10.0, gt=0.0)
    """Greatest factor on sigma(z) by the residuals."""
    correlation_px: int = Field(default=4, ge=0)
    """Residuals of pixels this far apart in u and v are correlated with each other: about the reach of a Gaussian. What
    they share counts once; 0 takes every pixel for independent."""
    deviation_frames: int = Field(default=24, ge=0)
    """Most frames between keyframes, evenly spread over the log and none held out, whose depth shows, besides that of
    keyframes, how far Gaussians are from the surface."""
    deviation_gate_m: float = Field(default=0.1, gt=0.0)
    """A surface measured farther than this from a Gaussian is another one's."""
