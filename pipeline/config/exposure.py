"""Settings of the exposures of single frames."""

from typing import Literal

from pydantic import Field

from duagc.pipeline.config.base import Config


class ExposureConfig(Config):
    """Gain and offset of each channel of each frame that the map may be made of."""

    mode: Literal["auto", "on", "off"] = "auto"
    """`auto`: only where frames differ."""
    min_share: float = Field(default=0.1, ge=0.0, le=1.0)
    """Share of compared pairs that must differ."""
    min_sigmas: float = Field(default=3.0, gt=0.0)
    """By how many standard deviations of color."""
    width_px: int = Field(default=80, ge=8)
    """Columns of the block means that are compared."""
    sigma_gain: float = Field(default=0.02, gt=0.0)
    """Least standard deviation of a pair's log gain, by contrast."""
    sigma_color: float = Field(default=0.005, gt=0.0)
    """Least standard deviation of a pair's mean color."""
    prior_gain: float = Field(default=0.2, gt=0.0)
    """Standard deviation of a frame's log gain, a priori."""
    prior_offset: float = Field(default=0.01, gt=0.0)
    """The same of its offset."""
