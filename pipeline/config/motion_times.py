"""Configuration of times that the images of a log tell of themselves: how late depth is, how long rows are read."""

from __future__ import annotations

from pydantic import Field

from duagc.pipeline.config.base import Config


class MotionTimeConfig(Config):
    """A time that is found by motions which parts of the images see for themselves."""

    enabled: bool = True
    """Look for it."""
    pairs: int = Field(default=40, ge=1)
    """Pairs of frames that are compared."""
    min_pairs: int = Field(default=30, ge=8)
    """Pairs that it needs: a log of a second does not tell it."""
    sigmas: float = Field(default=3.0, ge=0.0)
    """Times its standard deviation from which it is certain."""
    most_sigma_s: float = Field(default=0.01, gt=0.0)
    """Largest standard deviation with which it may be certain: at an even speed the noise of velocities may look like a
    long time, with a standard deviation that is long too."""
    least_s: float = Field(default=0.01, ge=0.0)
    """Shorter ones are left: depth in coarse steps errs alike in near views, which may pass for some milliseconds."""
    cameras_m: float = Field(default=0.01, gt=0.0)
    """Standard deviation of where one camera, or half of an image, stands relative to what the log says."""
    cameras_rad: float = Field(default=0.01, gt=0.0)
    """The same of how it is turned."""


class DelayConfig(MotionTimeConfig):
    """Delay of depth that its stamps do not show, by motions that color and depth see for themselves."""


class ReadoutConfig(MotionTimeConfig):
    """How long images are read, row after row, where the log does not say, by motions that their halves see."""

    least_s: float = Field(default=0.005, ge=0.0)
    """Shorter ones are left."""
    least_move: float = Field(default=0.0004, ge=0.0)
    """Least move of the rows of the median frame, in its median pixel, as a share of the width of the image; less is
    left."""
    move_to_track_again: float = Field(default=0.0016, ge=0.0)
    """The same from which on frames are tracked once more, with their rows in one time; a stated readout counts."""
    rounds: int = Field(default=2, ge=1)
    """How often it is looked for, each time in images that what was found has made still; once where rows cannot move
    that far."""
